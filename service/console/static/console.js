import{a as Y}from"./chunk-G5J5RKOX.js";import{A as G,B as q,C as L,D as V,E as ye,F as Se,G as we,H as d,I as R,J as $,K as j,L as w,M as W,N as h,O as S,P as m,Q as k,R as K,S as ne,T as se,U as re,V as i,W as f,X as M,Y as Q,a as me,b as u,c as I,e as ue,f as A,g as he,h as fe,i as be,j as J,k as ge,m as y,o as ve,p as g,q as C,s as D,t as E,u as l,v as z,x as H,y as O,z as t}from"./chunk-BOYWA4GL.js";function F({load:e,name:o,of:n}){let[s,r]=u(null),[a,c]=u(null);return I(()=>{e().then(_=>r({show:_[o]}),_=>c(j(_)))},[]),a?t`<${w} problem=${a} />`:s?t`<${s.show} ...${n} />`:t`<p class="muted" aria-busy="true">Loading …</p>`}var ae=200,Ie={active:"Not ended",failed:"Failed",all:"All"};function _e(){let[e,o]=u("all"),n=G.value,r=[...n?.values()??[]].sort((a,c)=>c.created_at.localeCompare(a.created_at)).filter(a=>e==="active"?!L(a):e==="failed"?a.state==="FAILED":!0);return t`<${S} title="Jobs">
      <div class="choice" role="group" aria-label="Jobs to show">
        ${Object.entries(Ie).map(([a,c])=>t`<button type="button" aria-pressed=${e===a} onClick=${()=>o(a)}>${c}</button>`)}
      </div>
    <//>
    ${n===null&&t`<p class="muted" aria-busy="true">Loading …</p>`}
    ${n!==null&&r.length===0&&t`<${m}>${e==="all"?"No job yet. Upload a drive and start its reconstruction.":"No such job."}<//>`}
    ${r.length>0&&t`<${ie} jobs=${r.slice(0,ae)} />`}
    ${r.length>ae&&t`<p class="muted">The newest ${ae} of ${r.length} jobs are shown.</p>`}`}function ie({jobs:e}){let o=$(n=>C("v1/drives",n),"names of drives");return t`<div class="scroll" tabindex="0" role="region" aria-label="Jobs"><table>
    <thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col">Stage</th><th scope="col">Time left</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(n=>t`<tr key=${n.id}>
          <td><a href=${d("jobs",n.id)}>${ne[n.kind]}</a><div class="muted small">${Ae(n,o.value)}</div></td>
          <td><${k} state=${n.state} /></td>
          <td><${K} percent=${n.progress.percent} label="done" /></td>
          <td>${L(n)?"–":re(n)}</td>
          <td class="number">${L(n)?"–":se(n)}</td>
          <td><${f} at=${n.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ae(e,o){return e.members&&e.members.length>0?e.members.map(n=>n.name).join(", "):o?.find(n=>n.id===e.drive_id)?.name??e.drive_id??e.id}function ke({id:e}){let o=$(r=>g(`v1/jobs/${e}`,r),e),s=G.value?.get(e)??o.value;return s?t`<${S} title=${ne[s.kind]} kind="Job"><${Ve} job=${s} /><//>
    <div class="row"><${k} state=${s.state} />${s.cancel_requested&&!L(s)&&t`<span class="badge warn">stopping</span>`}
      <${K} percent=${s.progress.percent} label="done" /></div>
    <dl class="tiles" aria-live="polite">
      <${i} label=${L(s)?"Last stage":"Stage"}>${s.state==="SUCCEEDED"?"all done":re(s)}<//>
      <${i} label=${L(s)?"Took":"Time left"}>${L(s)?Je(s):se(s)}<//>
      <${i} label="Created"><${f} at=${s.created_at} /><//>
      <${i} label="Started"><${f} at=${s.started_at} /><//>
      <${i} label="Heartbeat"><${f} at=${s.heartbeat_at} /><//>
    </dl>
    ${s.problem&&t`<${w} problem=${s.problem} />`}
    <${Be} job=${s} />
    <${Ge} job=${s} />
    <${Ue} job=${s} />
    <h2>Details</h2>
    <dl class="facts">
      <dt>Id</dt><dd><code>${s.id}</code></dd>
      ${s.drive_id&&t`<dt>Drive</dt><dd><a href=${d("drives",s.drive_id)}>${s.drive_id}</a></dd>`}
      ${s.parent_id&&t`<dt>Part of</dt><dd><a href=${d("jobs",s.parent_id)}>${s.parent_id}</a></dd>`}
      ${s.retry_of&&t`<dt>Repeats</dt><dd><a href=${d("jobs",s.retry_of)}>${s.retry_of}</a></dd>`}
      <dt>Reused stages</dt><dd>${s.progress.reused_stages?.join(", ")||"none"}</dd>
      <dt>Settings</dt><dd><pre tabindex="0">${JSON.stringify(s.settings,null,1)}</pre></dd>
    </dl>`:t`<${S} title="Job" /><${h} of=${o}>${()=>null}<//>`}function Je(e){return!e.finished_at||!e.started_at?"did not start":z((Date.parse(e.finished_at)-Date.parse(e.started_at))/1e3)}function Ve({job:e}){let o=async()=>{let r=await y("POST",`v1/jobs/${e.id}:cancel`);V(await r.json())},n=async()=>{let a=await(await y("POST",`v1/jobs/${e.id}:retry`)).json();V(a),R("jobs",a.id)},s=e.kind!=="SUBMAP"&&(e.state==="FAILED"||e.state==="CANCELLED");return t`${!L(e)&&!e.cancel_requested&&t`<${M} label="Cancel" ask="Cancel this job?" run=${o} danger />`}
  ${s&&t`<${M} label="Retry" ask="Do it again? Finished stages are reused." run=${n} />`}`}function Be({job:e}){return e.scene_id?t`<p><a class="button primary" href=${d("scenes",e.scene_id)}>Open the scene</a></p>`:e.map_id&&e.map_version?t`<p><a class="button primary" href=${d("maps",e.map_id)}>Open the map</a></p>`:e.export_id?t`<${He} id=${e.export_id} />`:null}function He({id:e}){let o=$(n=>g(`v1/exports/${e}`,n),`export ${e}`,!1);return t`<${h} of=${o}>${({scene_id:n,map_id:s,formats:r})=>t`<p>Formats: ${r.join(", ")}.</p>
    <p><a class="button primary" href=${n?d("scenes",n,"files"):d("maps",s??"","files")}>Open the exports of the ${n?"scene":"map"}</a></p>`}<//>`}function Ge({job:e}){let o=(e.members??[]).map(r=>({label:r.name,state:r.scene_id?"SUCCEEDED":r.state,percent:r.percent,jobId:r.job_id,note:r.problem?r.problem.detail:r.job_id?"":"its scene was there"})),n=(e.submaps??[]).map(r=>({label:`Sub-map ${r.number}: units ${r.first_unit} to ${r.last_unit}`,state:r.state,percent:r.percent,jobId:r.job_id,note:r.problem?.detail??""})),s=[...o,...n];return s.length===0?null:t`<h2>${o.length>0?"Drives of this map":"Sub-maps"}</h2>
    <ul class="tree">
      ${s.map(r=>t`<li key=${r.label}>
          <span class="label">${r.jobId?t`<a href=${d("jobs",r.jobId)}>${r.label}</a>`:r.label}</span>
          ${r.state&&t`<${k} state=${r.state} />`}
          <${K} percent=${r.percent} label=${`${r.label} done`} />
          ${r.note&&t`<span class="muted small">${r.note}</span>`}
        </li>`)}
    </ul>`}function Ue({job:e}){return e.attempts.length===0?null:t`<h2>Attempts</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Attempts"><table>
      <thead><tr><th scope="col" class="number">Attempt</th><th scope="col">Worker</th><th scope="col">Started</th><th scope="col">Finished</th><th scope="col">Outcome</th></tr></thead>
      <tbody>
        ${e.attempts.map(o=>t`<tr>
            <td class="number">${o.attempt}</td><td><code>${o.worker}</code></td>
            <td><${f} at=${o.started_at} /></td><td><${f} at=${o.finished_at} /></td>
            <td>${o.outcome??"runs"}${o.problem&&t`<div class="small">${o.problem.detail}</div>`}</td>
          </tr>`)}
      </tbody>
    </table></div>`}function xe(){let e=$(r=>C("v1/drives",r),"drives"),[o,n]=u([]),s=(r,a)=>n(a?[...o,r]:o.filter(c=>c!==r));return t`<${S} title="Drives"><a class="button primary" href=${d("upload")}>Upload a drive</a><//>
    <${h} of=${e}>${r=>r.length===0?t`<${m}><p>No drive yet.</p><p>A drive is a folder with <code>drive.json</code> and its images.
            <a href=${d("upload")}>Upload one here</a>, or with <code>mrasfm upload FOLDER</code>.</p><//>`:t`${o.length>1&&t`<${qe} drives=${r.filter(a=>o.includes(a.id))} />`}
            <${ze} drives=${r} chosen=${o} choose=${s} />`}<//>`}function ze({drives:e,chosen:o,choose:n}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Drives"><table>
    <thead><tr><th scope="col"><span class="hidden">Choose for a map</span></th><th scope="col">Drive</th><th scope="col">State</th><th scope="col">Check</th>
      <th scope="col" class="number">Cameras</th><th scope="col" class="number">Frames</th><th scope="col" class="number">Files</th><th scope="col" class="number">Size</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(s=>t`<tr key=${s.id}>
          <td><input type="checkbox" aria-label=${`choose ${s.name} for a map`} disabled=${s.state!=="COMMITTED"}
            checked=${o.includes(s.id)} onChange=${r=>n(s.id,r.target.checked)} /></td>
          <td><a href=${d("drives",s.id)}>${s.name}</a>${s.vehicle&&t`<div class="muted small">${s.vehicle}</div>`}</td>
          <td><${k} state=${s.state} /></td>
          <td><${k} state=${s.preflight} /><div class="muted small">${We(s)}</div></td>
          <td class="number">${s.cameras}</td>
          <td class="number">${l(s.frames)}</td>
          <td class="number">${l(s.files_stored)} of ${l(s.files_expected)}</td>
          <td class="number">${E(s.bytes_stored)}</td>
          <td><${f} at=${s.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function qe({drives:e}){let[o,n]=u("map"),[s,r]=u(null),a=async c=>{c.preventDefault();try{let P=await(await y("POST","v1/aggregations",{json:{drives:e.map(p=>p.id),name:o}})).json();V(P),R("jobs",P.id)}catch(_){r(j(_))}};return t`<form class="box inline" onSubmit=${c=>{a(c)}}>
    <label>Name of the map <input required maxlength="200" value=${o} onInput=${c=>n(c.target.value)} /></label>
    <button class="primary">Make a map of ${e.length} drives</button>
    ${s&&t`<${w} problem=${s} />`}
  </form>`}function Ee({id:e}){let o=$(s=>g(`v1/drives/${e}`,s),e),n=o.value;return t`<${S} title=${n?.name??"Drive"} kind="Drive">${n&&t`<${Qe} drive=${n} />`}<//>
    <${h} of=${o}>${s=>t`<${Ke} drive=${s} />`}<//>
    ${n&&t`<${Ye} drive=${n} /><${Xe} drive=${n} /><${Ze} drive=${n} />`}`}function We(e){return[[e.preflight_errors,"error"],[e.preflight_warnings,"warning"]].filter(([n])=>n>0).map(([n,s])=>O(n,s)).join(", ")}function Ke({drive:e}){return t`<dl class="tiles">
    <${i} label="State"><${k} state=${e.state} /><//>
    <${i} label="Files">${l(e.files_stored)} of ${l(e.files_expected)}<//>
    <${i} label="Size">${E(e.bytes_stored)}<//>
    <${i} label="Cameras">${e.cameras}<//>
    <${i} label="Frames">${l(e.frames)}<//>
    <${i} label="GNSS">${e.has_gnss?"yes":"no"}<//>
    <${i} label="Vehicle">${e.vehicle??"not named"}<//>
    <${i} label="Created"><${f} at=${e.created_at} /><//>
  </dl><p class="muted small"><code>${e.id}</code></p>`}function Qe({drive:e}){let o=async()=>{let r=await(await y("POST","v1/reconstructions",{json:{drive_id:e.id}})).json();V(r),R("jobs",r.id)},n=async()=>{await y("DELETE",`v1/drives/${e.id}`),R("drives")};return t`${e.state==="COMMITTED"?t`<${M} label="Reconstruct" ask="Start a reconstruction?" run=${o} />`:t`<a class="button primary" href=${d("upload")}>Continue the upload</a>`}
    <${M} label="Delete" ask="Delete this drive and its images?" run=${n} danger />`}function Ye({drive:e}){let o=$(n=>g(`v1/drives/${e.id}/preflight`,n),`preflight ${e.id}`);return e.state!=="COMMITTED"?null:t`<h2>Check of the drive</h2>
    <${h} of=${o}>${n=>t`<p><${k} state=${n.state} /> ${n.findings.length===0?n.state==="PENDING"?"The images are being checked.":"No finding.":O(n.findings.length,"finding")}</p><${W} findings=${n.findings} />`}<//>`}function Xe({drive:e}){let o=$(n=>C(`v1/scenes?drive_id=${e.id}`,n),`scenes ${e.id}`);return t`<h2>Scenes</h2><${h} of=${o}>${n=>n.length===0?t`<${m}>No scene of this drive yet.<//>`:t`<${le} scenes=${n} />`}<//>`}function le({scenes:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col" class="number">Units registered</th><th scope="col" class="number">Images registered</th><th scope="col" class="number">Points</th><th scope="col">Georeferenced</th><th scope="col" class="number">Warnings</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(o=>t`<tr key=${o.id}>
          <td><a href=${d("scenes",o.id)}>${o.name}</a></td>
          <td class="number">${l(o.summary.registered_units)} of ${l(o.summary.units)}</td>
          <td class="number">${l(o.summary.registered_images)} of ${l(o.summary.images)}</td>
          <td class="number">${l(o.summary.points)}</td>
          <td>${o.summary.georeferenced?"yes":"no"}</td>
          <td class="number">${o.summary.warnings}</td>
          <td><${f} at=${o.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ze({drive:e}){let o=[...G.value?.values()??[]].filter(n=>n.drive_id===e.id);return o.sort((n,s)=>s.created_at.localeCompare(n.created_at)),t`<h2>Jobs</h2>${o.length===0?t`<${m}>No job of this drive yet.<//>`:t`<${ie} jobs=${o} />`}`}function Pe(){let[e,o]=u(null),[n,s]=u(!1),r=async a=>{a.preventDefault();let c=a.currentTarget.elements.namedItem("key"),_=c.value.trim();s(!0),o(null);try{let P=await y("POST","v1/session",{headers:{Authorization:`Bearer ${_}`}});c.value="",J(await P.json())}catch(P){o(j(P))}s(!1)};return t`<main class="login" id="main">
    <h1>MRASfM</h1>
    <p>Maps from the cameras of vehicles.</p>
    <form method="post" onSubmit=${a=>{r(a)}}>
      <label for="key">API key</label>
      <input id="key" name="key" type="password" required autocomplete="off" spellcheck=${!1} autofocus placeholder="mrasfm_…" aria-describedby="key-help" />
      <p id="key-help" class="muted">The key is exchanged for a cookie that lasts 12 hours; it is not kept in the browser.
      An operator makes keys with <code>mrasfm keys create</code>.</p>
      <button class="primary" disabled=${n}>${n?"Logging in …":"Log in"}</button>
    </form>
    ${e&&t`<${w} problem=${e} />`}
  </main>`}var et=[[/^report\.html$/,"the report, for people: opens without the internet"],[/^report\.json$/,"findings, time and counts of every stage, uncertainty"],[/^points\.copc\.laz$/,"the points for GIS programs, cloud-optimised"],[/^points\.ply$/,"the points with colours, for any viewer"],[/^poses\.json$/,"poses of units and images with sigmas"],[/^poses\.tum$/,"poses of the vehicle"],[/^trajectory\.gpkg$/,"positions as a GeoPackage"],[/^calibration(\.json|\/)/,"every camera as given and as refined"],[/^frame\.json$/,"the coordinate frame and its place on the earth"],[/^view\.json$/,"trajectory and frusta for this console"],[/^features\.db$/,"keypoints and matches as a COLMAP database"],[/^model\//,"cameras, rig, images and points in COLMAP's format"],[/^rigs?\//,"the calibration for Kalibr, ROS and URDF"],[/^autoware\//,"the points for Autoware"],[/^pictures\/birds_eye_/,"the road from above, all cameras, before and after calibration"],[/^pictures\/road_(before|after)/,"points of the road, before and after those off its surface were dropped"],[/^pictures\/road\.tif$/,"the road from above as a GeoTIFF, the best view of each place"],[/^pictures\/road\.pgw$/,"the place of road.png on the earth (world file)"],[/^pictures\/road\.png$/,"the road from above, the best view of each place"],[/^pictures\/seam-/,"points of two scenes at their seam, before and after"],[/^pictures\//,"a picture"],[/^road\.json$/,"the surface of the road"],[/^map\.json$/,"scenes, seams and verdicts"],[/^manifest\.json$/,"the drive's manifest, in the engine's axes"],[/^(scenes|seams)\//,"data for the map's next version"],[/^own_car\//,"where the camera shows its own car"],[/^components\//,"of a part of the drive that nothing links to the rest"]];function X({files:e}){let[o,n]=u(""),s=e.filter(a=>a.path.toLowerCase().includes(o.toLowerCase())),r=e.reduce((a,c)=>a+c.size_bytes,0);return t`<h2>Files</h2>
    <p class="muted">${O(e.length,"file")}, ${E(r)} together.</p>
    <label class="filter">Find a file <input type="search" value=${o} onInput=${a=>n(a.target.value)} /></label>
    ${s.length===0?t`<${m}>No file of this name.<//>`:t`<${de} files=${s} label="Files" />`}`}function de({files:e,label:o}){return t`<div class="scroll" tabindex="0" role="region" aria-label=${o}><table>
    <thead><tr><th scope="col">File</th><th scope="col" class="number">Size</th><th scope="col">Content</th></tr></thead>
    <tbody>${e.map(n=>t`<tr key=${n.path}><td><a href=${n.url.replace(/^\//,"")} download>${n.path}</a></td>
        <td class="number">${E(n.size_bytes)}</td><td>${et.find(([s])=>s.test(n.path))?.[1]??""}</td></tr>`)}</tbody></table></div>`}var Te={colmap:"COLMAP, 3D Gaussian Splatting: pinhole images, masks, model",nerfstudio:"nerfstudio: transforms.json, images, masks",nuscenes:"nuScenes: its tables and images",mcap:"MCAP for Foxglove, Lichtblick, rerun",copc:"points in a coordinate reference system (COPC)",geopackage:"positions in a coordinate reference system (GeoPackage)",geotiff:"picture of the road in a coordinate reference system (GeoTIFF)",kitti:"poses as in KITTI odometry",geojson:"positions for web maps (GeoJSON)"},tt="EPSG:[0-9]{4,6}(\\+[0-9]{4,6})?";function Z(e){return A.value?.session_expires_at?t`<${ot} ...${e} />`:null}function ot({base:e,components:o=[]}){let n=$(s=>C(`${e}/exports`,s),`exports ${e}`);return t`<h2>Exports</h2>
    <p class="muted">Formats that have the images in them, or a coordinate reference system of your choice, are made by a job.</p>
    <${st} base=${e} components=${o} asked=${n.again} />
    <${h} of=${n}>${s=>s.length===0?t`<${m}>No export yet.<//>`:s.map(r=>t`<${rt} key=${r.id} export=${r} changed=${n.again} />`)}<//>`}function nt(e){return e.flatMap(o=>{let n=/^components\/(\d+)$/.exec(o.folder);return n?[[Number(n[1]),o]]:[]})}function st({base:e,components:o,asked:n}){let[s,r]=u([]),[a,c]=u(0),[_,P]=u(""),[p,T]=u(null),B=nt(o),b=(v,x)=>r(x?[...s,v]:s.filter(oe=>oe!==v)),U=async v=>{v.preventDefault(),T(null);let x={formats:[...s],crs:_||null,component:a||null};try{await y("POST",`${e}/exports`,{json:x}),n()}catch(oe){T(j(oe))}};return t`<form class="box" onSubmit=${v=>{U(v)}}>
    <fieldset class="options"><legend>Formats</legend>
      ${Object.keys(Te).map(v=>t`<label><input type="checkbox" checked=${s.includes(v)} onChange=${x=>b(v,x.target.checked)} /> ${Te[v]}</label>`)}</fieldset>
    <div class="inline">
      ${B.length>0&&t`<label>Part of the drive
        <select value=${a} onChange=${v=>c(Number(v.target.value))}>
          <option value="0">The scene itself</option>
          ${B.map(([v,x])=>t`<option value=${v}>Component ${x.component}: ${O(x.registered_units,"unit")}</option>`)}</select></label>`}
      <label>Coordinate reference system <input size="12" placeholder="the format's own" pattern=${tt} title="as EPSG:25832" value=${_} onInput=${v=>P(v.target.value.trim())} /></label>
      <button class="primary" disabled=${s.length===0}>Export</button>
    </div>
    ${p&&t`<${w} problem=${p} />`}
  </form>`}function rt({export:e,changed:o}){let n=async()=>{await y("DELETE",`v1/exports/${e.id}`),o()},s=[e.component&&`component ${e.component}`,e.crs,e.image_size_px&&`images of at most ${e.image_size_px} px`],r=e.state==="SUCCEEDED";return t`<section class="box" data-export=${e.id}><h3>${[e.formats.join(", "),...s.filter(Boolean)].join(" · ")}</h3>
    <p><${k} state=${e.state} /> <a href=${d("jobs",e.job_id)}>Its job</a> · <${f} at=${e.created_at} /></p>
    ${e.problem&&t`<${w} problem=${e.problem} />`}
    ${e.results.map(a=>t`<p><strong>${a.format}</strong>: ${a.withheld?t`withheld: ${a.withheld}`:`${O(a.files,"file")}, ${E(a.size_bytes)}`}</p>
        ${(a.notes??[]).length>0&&t`<ul>${(a.notes??[]).map(c=>t`<li>${c}</li>`)}</ul>`}`)}
    ${r&&t`<${at} id=${e.id} />`}
    ${(r||e.state==="FAILED"||e.state==="CANCELLED")&&t`<${M} label="Delete" ask="Delete this export and its files?" run=${n} danger />`}
  </section>`}function at({id:e}){let[o,n]=u(!1);return t`<details onToggle=${s=>n(s.target.open)}><summary>Files</summary>
    ${o&&t`<${it} id=${e} />`}</details>`}var ce=200;function it({id:e}){let o=$(n=>g(`v1/exports/${e}`,n),`export ${e}`,!1);return t`<${h} of=${o}>${({files:n})=>t`<${de} files=${n.slice(0,ce)} label="Files of the export" />
    ${n.length>ce&&t`<p class="muted">The first ${ce} of ${l(n.length)} files. All of them come with <code>mrasfm-client download ${e} --out DIR</code>.</p>`}`}<//>`}function Ce(){let e=$(o=>C("v1/scenes",o),"scenes");return t`<${S} title="Scenes" /><${h} of=${e}>${o=>o.length===0?t`<${m}>No scene yet. A reconstruction makes a scene of a <a href=${d("drives")}>drive</a>.<//>`:t`<${le} scenes=${o} />`}<//>`}var lt=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"calibration",label:"Calibration"},{name:"files",label:"Files"}];function Me({id:e,tab:o}){let n=$(a=>g(`v1/scenes/${e}`,a),e,!1),s=n.value,r=async()=>{await y("DELETE",`v1/scenes/${e}`),R("scenes")};return t`<${S} title=${s?.name??"Scene"} kind="Scene">
      ${s&&N(s,"report.html")&&t`<a class="button" href=${D(`v1/scenes/${e}`,"report.html")} download>Download the report</a>`}
      ${A.value?.session_expires_at&&t`<${M} label="Delete" ask="Delete this scene and its files?" run=${r} danger />`}
    <//>
    <${Q} base=${["scenes",e]} tabs=${lt} current=${o} />
    <${h} of=${n}>${a=>dt(a,o)}<//>`}function N(e,o){return e.files.some(n=>n.path===o)}function dt(e,o){let n=`v1/scenes/${e.id}`;return o==="3d"?N(e,"view.json")?t`<${F} load=${()=>import("./page-YFWVUMLB.js")} name="Viewer" of=${{base:n,driveOf:{[e.name]:e.drive_id},onlyDrive:e.drive_id}} />`:t`<${m}>This scene has no view.json: it was made by an older version, or its points could not be written. Reconstruct it again.<//>`:o==="place"?N(e,"view.json")?e.summary.georeferenced?t`<${F} load=${()=>import("./page-KXPQAW3T.js")} name="Place" of=${{base:n}} />`:t`<${m}>This scene has no place on the earth: its drive has no GNSS that could be used.<//>`:t`<${m}>This scene has no view.json: it was made by an older version. Reconstruct it again.<//>`:o==="calibration"?t`<${F} load=${()=>import("./page-DMSP63PN.js")} name="CalibrationPage" of=${{base:n,driveId:e.drive_id,hasPictures:N(e,"pictures/birds_eye_before.png")}} />`:o==="files"?t`<${X} files=${e.files} /><${Z} base=${n} components=${e.summary.components??[]} />`:t`<${ct} scene=${e} />`}function ct({scene:e}){let o=`v1/scenes/${e.id}`,n=$(r=>g(D(o,"report.json"),r),`report ${e.id}`,!1),{summary:s}=e;return t`<dl class="tiles">
      <${i} label="Units registered">${l(s.registered_units)} of ${l(s.units)}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Place on the earth">${s.georeferenced?"by GNSS":"none"}<//>
      <${i} label="Warnings">${s.warnings}<//>
      <${i} label="Made"><${f} at=${e.created_at} /><//>
    </dl>
    <p><a href=${d("drives",e.drive_id)}>The drive</a> · <a href=${d("jobs",e.job_id)}>the job</a> · engine ${s.engine_version}</p>
    <${h} of=${n}>${r=>t`<${pe} report=${r} />`}<//>
    ${(s.components??[]).length>1&&t`<h2>Components</h2><p>Nothing links some parts of this drive with the rest: each is a scene of its own.</p>
      <ul>${(s.components??[]).map(r=>t`<li>Component ${r.component} in <code>${r.folder}</code>: ${l(r.registered_units)} units, ${l(r.points)} points</li>`)}</ul>`}
    ${N(e,"pictures/road_before.png")&&t`<h2>Points of the road</h2>
      <${Y} before=${D(o,"pictures/road_before.png")} after=${D(o,"pictures/road_after.png")} label="Before and after points off its surface were dropped" />`}`}function pe({report:e}){let o=e.summary.mean_reprojection_error_px;return t`<h2>Findings</h2>
    ${(e.findings??[]).length===0?t`<p>None.</p>`:t`<${W} findings=${e.findings} />`}
    ${typeof o=="number"&&t`<p>Mean reprojection error <span data-exact=${o}>${H(o,3)} px</span>.</p>`}
    <h2>Time by stage</h2>
    <${pt} stages=${e.stages} />`}function pt({stages:e}){let o=Math.max(...e.map(n=>n.seconds),1e-9);return t`<table class="bars"><thead class="hidden"><tr><th scope="col">Stage</th><th scope="col">Share</th><th scope="col">Time</th></tr></thead><tbody>${e.map(n=>t`<tr><th scope="row">${n.stage.replaceAll("-"," ")}</th>
      <td><progress max=${o} value=${n.seconds} aria-label=${`time of ${n.stage}`}></progress></td>
      <td class="number">${z(n.seconds)}${n.reused?" (reused)":""}</td></tr>`)}</tbody></table>`}function De(){let e=$(o=>C("v1/maps",o),"maps");return t`<${S} title="Maps" /><${h} of=${e}>${o=>o.length===0?t`<${m}>No map yet. Choose two or more <a href=${d("drives")}>drives</a> to make one.<//>`:t`<div class="scroll" tabindex="0" role="region" aria-label="Maps"><table>
          <thead><tr><th scope="col">Map</th><th scope="col" class="number">Version</th><th scope="col" class="number">Scenes connected</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col">Created</th></tr></thead>
          <tbody>${o.map(n=>t`<tr key=${n.id}><td><a href=${d("maps",n.id)}>${n.name}</a></td>${$t(n)}<td><${f} at=${n.created_at} /></td></tr>`)}</tbody></table></div>`}<//>`}function $t(e){let o=e.version?.summary;return o?t`<td class="number">${e.current_version}</td><td class="number">${o.connected} of ${o.scenes}</td><td class="number">${o.seams}</td><td class="number">${l(o.points)}</td>`:t`<td colspan="4" class="muted">${e.job_id?t`<a href=${d("jobs",e.job_id)}>being made</a>`:"no version yet"}</td>`}var mt=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"seams",label:"Seams"},{name:"calibration",label:"Calibration"},{name:"versions",label:"Versions"},{name:"files",label:"Files"}];function je({id:e,tab:o}){let n=$(r=>g(`v1/maps/${e}`,r),e),s=n.value;return t`<${S} title=${s?.name??"Map"} kind="Map" />
    <${Q} base=${["maps",e]} tabs=${mt} current=${o} />
    <${h} of=${n}>${r=>o==="versions"?t`<${yt} map=${r} changed=${n.again} />`:r.version?t`<${ut} key=${r.version.number} map=${r} number=${r.version.number} tab=${o} />`:t`<${m}>This map has no version yet.${r.job_id&&t` <a href=${d("jobs",r.job_id)}>Its job</a>`}<//>`}<//>`}function ut({map:e,number:o,tab:n}){let s=`v1/maps/${e.id}/versions/${o}`,r=$(a=>g(s,a),s,!1);return t`<${h} of=${r}>${a=>ht(a,s,n)}<//>`}function ht(e,o,n){if(n==="files")return t`<${X} files=${e.files} /><${Z} base=${o} />`;if(n==="seams")return t`<${gt} version=${e} base=${o} />`;if(n==="calibration"){let s=e.files.map(r=>r.path).filter(r=>/^calibration\/[^/]+\.json$/.test(r));return s.length===0?t`<${m}>This version has no calibration of its drives. Each scene has its own.<//>`:t`<${F} load=${()=>import("./page-DMSP63PN.js")} name="MapCalibration" of=${{base:o,files:s}} />`}if(n==="3d"){if(!N(e,"view.json"))return t`<${m}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;let s=Object.fromEntries(e.scenes.map(r=>[r.name,r.drive_id]));return t`<${F} load=${()=>import("./page-YFWVUMLB.js")} name="Viewer" of=${{base:o,driveOf:s}} />`}return n==="place"?N(e,"view.json")?e.summary.georeferenced?t`<${F} load=${()=>import("./page-KXPQAW3T.js")} name="Place" of=${{base:o}} />`:t`<${m}>This map has no place on the earth: none of its drives has GNSS that could be used.<//>`:t`<${m}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`:t`<${ft} version=${e} base=${o} />`}function ft({version:e,base:o}){let n=$(r=>g(D(o,"report.json"),r),`report ${o}`,!1),{summary:s}=e;return t`${N(e,"report.html")&&t`<p><a class="button" href=${D(o,"report.html")} download>Download the report</a></p>`}
    <dl class="tiles">
      <${i} label="Version">${e.number}<//>
      <${i} label="Scenes connected">${s.connected} of ${s.scenes}<//>
      <${i} label="Seams">${s.seams}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Made"><${f} at=${e.created_at} /><//>
    </dl>
    <h2>Scenes</h2><${bt} version=${e} />
    ${e.failed.length>0&&t`<h2>Drives without a scene</h2>${e.failed.map(r=>t`<p><a href=${d("drives",r.drive_id)}>${r.name}</a></p><${w} problem=${r.problem} />`)}`}
    <${h} of=${n}>${r=>t`<${pe} report=${r} />`}<//>`}function bt({version:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes of the map"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col">Connected</th><th scope="col">Drive</th></tr></thead>
    <tbody>${e.scenes.map(o=>t`<tr><td><a href=${d("scenes",o.scene_id)}>${o.name}</a></td>
        <td>${o.connected?t`<span class="badge good">connected</span>`:t`<span class="badge warn">placed by positions only</span>`}</td>
        <td><a href=${d("drives",o.drive_id)}><code>${o.drive_id}</code></a></td></tr>`)}</tbody></table></div>`}function gt({version:e,base:o}){let n=$(s=>g(D(o,"map.json"),s),`map ${o}`,!1);return t`<${h} of=${n}>${s=>t`
    ${s.seams.length===0&&t`<${m}>No two scenes of this map were close enough to look for a seam.<//>`}
    ${s.seams.map(r=>t`<${vt} seam=${r} base=${o} version=${e} />`)}
    ${e.unconnected.length>0&&t`<h2>Not connected</h2><p>No seam in use connects these scenes with the others; positions place them: ${e.unconnected.join(", ")}.</p>`}`}<//>`}function vt({seam:e,base:o}){let n=`${e.a} – ${e.b}`,s=(r,a,c)=>a===void 0?null:t`<${i} label=${r}><span data-exact=${a}>${H(a,3)} ${c}</span><//>`;return t`<section class="box"><h2>${n}</h2>
    <p>${e.accepted?t`<span class="badge good">accepted</span>`:t`<span class="badge warn">rejected</span> ${e.reason??"the evidence does not suffice"}`}</p>
    <dl class="tiles">
      ${e.units_tried!==void 0&&t`<${i} label="Units that agree">${e.units_agreeing??0} of ${e.units_tried}<//>`}
      ${e.inliers!==void 0&&t`<${i} label="Shared points">${l(e.inliers)}<//>`}
      ${s("Residual before",e.residual_before_px,"px")}
      ${s("Residual after",e.residual_after_px,"px")}
      ${s("Sigma of the translation before the last adjustment",e.sigma_translation_m,"m")}
      ${s("Sigma of the rotation before the last adjustment",e.sigma_rotation_deg,"deg")}
      ${e.scale!==void 0&&t`<${i} label="Difference of scale"><span data-exact=${e.scale}>${H(100*(e.scale-1),3)} %</span><//>`}
    </dl>
    ${e.pictures?t`<${Y} before=${D(o,e.pictures.before)} after=${D(o,e.pictures.after)} label="Points of both scenes from above" />`:t`<p class="muted">${e.accepted?"There are no pictures: they were switched off.":"There are no pictures, because the seam is not used."}</p>`}
  </section>`}function yt({map:e,changed:o}){let n=$(s=>C(`v1/maps/${e.id}/versions`,s),`versions ${e.id} ${e.current_version}`);return t`<${h} of=${n}>${s=>s.length===0?t`<${m}>No version yet.<//>`:t`<${St} map=${e} versions=${s} loaded=${n} changed=${o} />`}<//>`}function St({map:e,versions:o,changed:n}){let s=o.map(b=>b.number),[r,a]=u(s[1]??s[0]),[c,_]=u(s[0]),P=async b=>{await y("PUT",`v1/maps/${e.id}/current-version`,{json:{version:b}}),n()},p=(b,U,v)=>t`<label>${b}
    <select value=${U} onChange=${x=>v(Number(x.target.value))}>
      ${s.map(x=>t`<option value=${x} selected=${x===U}>Version ${x}</option>`)}</select></label>`,[T,B]=[o.find(b=>b.number===r),o.find(b=>b.number===c)];return t`<div class="scroll" tabindex="0" role="region" aria-label="Versions"><table>
      <thead><tr><th scope="col" class="number">Version</th><th scope="col">Made</th><th scope="col" class="number">Scenes</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col"></th></tr></thead>
      <tbody>${o.map(b=>t`<tr key=${b.number}><td class="number">${b.number}</td><td><${f} at=${b.created_at} /></td>
          <td class="number">${b.summary.scenes}</td><td class="number">${b.summary.seams}</td><td class="number">${l(b.summary.points)}</td>
          <td>${b.is_current?t`<${k} state="current" />`:t`<${M} label="Make it current" ask=${`Show version ${b.number}?`} run=${()=>P(b.number)} />`}</td></tr>`)}</tbody></table></div>
    <h2>Compare</h2>
    ${s.length<2?t`<p class="muted">There is one version only. An aggregation into this map makes the next.</p>`:t`<div class="inline">${p("From",r,a)} ${p("To",c,_)}</div>${T&&B&&t`<${_t} a=${T} b=${B} />`}`}`}var wt=["scenes","connected","seams","registered_units","registered_images","points","warnings"];function _t({a:e,b:o}){let n=p=>new Map(p.scenes.map(T=>[T.name,T.connected])),[s,r]=[n(e),n(o)],a=[...r.keys()].filter(p=>!s.has(p)),c=[...s.keys()].filter(p=>!r.has(p)),_=[...r].filter(([p,T])=>s.has(p)&&s.get(p)!==T),P=p=>p>0?`+${l(p)}`:p<0?`−${l(-p)}`:"same";return t`<table><thead><tr><th scope="col">Figure</th><th scope="col" class="number">Version ${e.number}</th><th scope="col" class="number">Version ${o.number}</th><th scope="col" class="number">Change</th></tr></thead>
      <tbody>${wt.map(p=>t`<tr><th scope="row">${p.replaceAll("_"," ")}</th><td class="number">${l(e.summary[p])}</td><td class="number">${l(o.summary[p])}</td><td class="number">${P(o.summary[p]-e.summary[p])}</td></tr>`)}</tbody></table>
    <ul>
      <li>Scenes added: ${a.join(", ")||"none"}</li>
      <li>Scenes removed: ${c.join(", ")||"none"}</li>
      <li>Connection changed: ${_.map(([p,T])=>`${p} (${T?"connected now":"not connected any more"})`).join(", ")||"none"}</li>
    </ul>`}var kt=5e3;function Fe(){let e=$(o=>g("v1/status",o),"status");return I(()=>{let o=setInterval(()=>document.hidden||e.again(),kt);return()=>clearInterval(o)},[]),t`<${S} title="Status" /><${h} of=${e}>${o=>t`<${xt} status=${o} />`}<//>`}function xt({status:e}){let[o,n]=[e.workers.filter(r=>r.online),e.workers.filter(r=>!r.online)],s=1-e.disk.free_bytes/e.disk.total_bytes;return t`<p><${k} state=${e.status} /> Version ${e.version}</p>
    ${e.reasons.length>0&&t`<ul class="findings">${e.reasons.map(r=>t`<li class="warn">${r}</li>`)}</ul>`}
    <dl class="tiles">
      <${i} label="Jobs that wait">${l(e.queue.queued)}<//>
      <${i} label="Jobs that run">${l(e.queue.running)}<//>
      <${i} label="Stalled jobs">${l(e.queue.stalled)}<//>
      <${i} label="Broker">${e.broker?"answers":"does not answer"}<//>
      <${i} label="Disk">${E(e.disk.free_bytes)} free of ${E(e.disk.total_bytes)}
        <progress max="1" value=${s} aria-label="disk in use"></progress><//>
      <${i} label="Uploads">${e.disk.accepts_uploads?"are taken":"are refused: the disk is full"}<//>
    </dl>
    <h2>Workers</h2>
    ${o.length===0?t`<${m}>No worker is online. Jobs are accepted and wait.<//>`:t`<${Oe} workers=${o} label="Workers" />`}
    ${n.length>0&&t`<details class="box"><summary>${O(n.length,"worker")} that ended within the last day</summary><${Oe} workers=${n} label="Workers that ended" /></details>`}
    <p><a href="docs">Description of the API</a></p>`}function Oe({workers:e,label:o}){return t`<div class="scroll" tabindex="0" role="region" aria-label=${o}><table>
    <thead><tr><th scope="col">Worker</th><th scope="col">Online</th><th scope="col">Queues</th><th scope="col" class="number">Jobs at one time</th><th scope="col">Last report</th></tr></thead>
    <tbody>${e.map(n=>t`<tr><td><code>${n.name}</code></td><td><span class=${`badge ${n.online?"good":"plain"}`}>${n.online?"online":"offline"}</span></td>
        <td>${n.queues.join(", ")}</td><td class="number">${n.concurrency}</td><td><${f} at=${n.seen_at} /></td></tr>`)}</tbody></table></div>`}function Le(){let e=$(o=>g("v1/session",o),"session");return t`<${S} title="Key and project" /><${h} of=${e}>${o=>t`
    <dl class="tiles">
      <${i} label="Project">${o.project}<//>
      <${i} label="Key">${o.key_name}<//>
      <${i} label="Key made"><${f} at=${o.key_created_at} /><//>
      <${i} label="Session ends"><${f} at=${o.session_expires_at} /><//>
      <${i} label="Stored">${E(o.used_bytes)} of ${E(o.max_bytes)}
        <progress max=${o.max_bytes} value=${o.used_bytes} aria-label="storage in use"></progress><//>
      <${i} label="Active jobs">at most ${l(o.max_active_jobs)}<//>
      <${i} label="Drives">at most ${l(o.max_drives)}<//>
    </dl>
    <p class="muted small"><code>${o.key_id}</code></p>
    <h2>More keys</h2>
    <p>Keys are made and revoked on the service's machine. A revoked key ends its sessions within seconds.</p>
    <pre tabindex="0">mrasfm keys create --name NAME
mrasfm keys revoke ${o.key_id}</pre>`}<//>
    <p><a href=${d("status")}>Status of the service</a></p>`}async function Ne(){await y("DELETE","v1/session"),J(null)}var Re=[["drives","Drives"],["jobs","Jobs"],["scenes","Scenes"],["maps","Maps"],["status","Status"],["keys","Key"]],Et={connecting:"connecting …",live:"live",polling:"polling",offline:"offline, tries again"},Pt=3e3,Tt=/^\w[\w.-]*$/,Ct={title:"There is no such page",detail:"The address names no page of the console.",remedy:"Check the end of the address, or choose a page above."},te=ue(null);function Mt(e){let[o="drives",n,s=""]=e;return o!=="upload"&&!Re.some(([r])=>r===o)||n!==void 0&&!Tt.test(n)?t`<${S} title="No such page" /><${w} problem=${Ct} />`:o==="upload"?t`<${F} key="upload" load=${()=>import("./page-RFRZZCBT.js")} name="UploadPage" of=${{}} />`:o==="jobs"?n?t`<${ke} key=${n} id=${n} />`:t`<${_e} />`:o==="scenes"?n?t`<${Me} key=${`${n} ${s}`} id=${n} tab=${s} />`:t`<${Ce} />`:o==="maps"?n?t`<${je} key=${`${n} ${s}`} id=${n} tab=${s} />`:t`<${De} />`:o==="status"?t`<${Fe} />`:o==="keys"?t`<${Le} />`:n?t`<${Ee} key=${n} id=${n} />`:t`<${xe} />`}function Dt(){let e=we.value,[o,n]=u(null),s=e[0]==="upload"?"drives":e[0]??"drives";I(()=>{document.querySelector("main h1")?.focus({preventScroll:!0}),window.scrollTo(0,0)},[e.slice(0,2).join("/")]);let r=()=>{n(null),Ne().catch(a=>n({...j(a),title:"The session goes on",remedy:"Log out again once the service answers."}))};return t`<a class="skip" href="#main" onClick=${jt}>Skip to the content</a>
    <header>
      <a class="brand" href=${d("drives")}>MRASfM</a>
      <nav aria-label="Pages">${Re.filter(([a])=>!ee()||a==="scenes"||a==="maps").map(([a,c])=>t`<a href=${d(a)} aria-current=${s===a?"page":void 0}>${c}</a>`)}</nav>
      <div class="session">${!ee()&&t`<span class=${`connection ${q.value}`} role="status" data-connection=${q.value}>${Et[q.value]}</span>`}
        <span class="muted project">${A.value?.project}</span>
        ${!ee()&&t`<button type="button" onClick=${r}>Log out</button>`}</div>
    </header>
    <main id="main">${o&&t`<${w} problem=${o} />`}${Mt(e)}</main>`}function jt(e){e.preventDefault(),document.querySelector("main h1")?.focus()}function Ot(){let e=A.value,o=he(e);return I(()=>{if(o)return ye(),Se},[o]),e===void 0?t`<main class="login">${te.value?t`<${w} problem=${te.value} />`:t`<p class="muted" aria-busy="true">Loading …</p>`}</main>`:e===null?t`<${Pe} />`:t`<${Dt} key=${o} />`}function ee(){return document.querySelector("meta[name=mrasfm-session]")?.getAttribute("content")==="open"}async function $e(){try{J(ee()||be()?await g("v1/session"):null),te.value=null}catch(e){if(!(e instanceof ge&&ve(e)))return J(null);te.value=j(e),setTimeout(()=>{$e()},Pt)}}me(t`<${Ot} />`,document.getElementById("app"));fe(()=>{$e()});$e();

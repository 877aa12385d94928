import{a as Y}from"./chunk-F3ZSCVIE.js";import{A as V,B as me,C as ue,D as he,E as d,F as R,G as $,H as N,I as E,J as W,K as u,L as S,M as m,N as _,O as K,P as oe,Q as ne,R as se,S as i,T as f,U as T,V as Q,a as pe,b as h,c as I,e as A,f as $e,g as J,j as y,m as g,n as M,p as D,q as t,r as x,s as l,t as z,v as H,w as j,x as G,y as q,z as F}from"./chunk-AYTI2NM3.js";function O({load:e,name:o,of:n}){let[s,r]=h(null),[a,c]=h(null);return I(()=>{e().then(w=>r({show:w[o]}),w=>c(N(w)))},[]),a?t`<${E} problem=${a} />`:s?t`<${s.show} ...${n} />`:t`<p class="muted" aria-busy="true">Loading …</p>`}var re=200,Te={active:"Not ended",failed:"Failed",all:"All"};function fe(){let[e,o]=h("all"),n=G.value,r=[...n?.values()??[]].sort((a,c)=>c.created_at.localeCompare(a.created_at)).filter(a=>e==="active"?!F(a):e==="failed"?a.state==="FAILED":!0);return t`<${S} title="Jobs">
      <div class="choice" role="group" aria-label="Jobs to show">
        ${Object.entries(Te).map(([a,c])=>t`<button type="button" aria-pressed=${e===a} onClick=${()=>o(a)}>${c}</button>`)}
      </div>
    <//>
    ${n===null&&t`<p class="muted" aria-busy="true">Loading …</p>`}
    ${n!==null&&r.length===0&&t`<${m}>${e==="all"?"No job yet. Upload a drive and start its reconstruction.":"No such job."}<//>`}
    ${r.length>0&&t`<${ae} jobs=${r.slice(0,re)} />`}
    ${r.length>re&&t`<p class="muted">The newest ${re} of ${r.length} jobs are shown.</p>`}`}function ae({jobs:e}){let o=$(n=>M("v1/drives",n),"names of drives");return t`<div class="scroll" tabindex="0" role="region" aria-label="Jobs"><table>
    <thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col">Stage</th><th scope="col">Time left</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(n=>t`<tr key=${n.id}>
          <td><a href=${d("jobs",n.id)}>${oe[n.kind]}</a><div class="muted small">${De(n,o.value)}</div></td>
          <td><${_} state=${n.state} /></td>
          <td><${K} percent=${n.progress.percent} label="done" /></td>
          <td>${F(n)?"–":se(n)}</td>
          <td class="number">${F(n)?"–":ne(n)}</td>
          <td><${f} at=${n.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function De(e,o){return e.members&&e.members.length>0?e.members.map(n=>n.name).join(", "):o?.find(n=>n.id===e.drive_id)?.name??e.drive_id??e.id}function be({id:e}){let o=$(r=>g(`v1/jobs/${e}`,r),e),s=G.value?.get(e)??o.value;return s?t`<${S} title=${oe[s.kind]} kind="Job"><${Oe} job=${s} /><//>
    <div class="row"><${_} state=${s.state} />${s.cancel_requested&&!F(s)&&t`<span class="badge warn">stopping</span>`}
      <${K} percent=${s.progress.percent} label="done" /></div>
    <dl class="tiles" aria-live="polite">
      <${i} label=${F(s)?"Last stage":"Stage"}>${s.state==="SUCCEEDED"?"all done":se(s)}<//>
      <${i} label=${F(s)?"Took":"Time left"}>${F(s)?je(s):ne(s)}<//>
      <${i} label="Created"><${f} at=${s.created_at} /><//>
      <${i} label="Started"><${f} at=${s.started_at} /><//>
      <${i} label="Heartbeat"><${f} at=${s.heartbeat_at} /><//>
    </dl>
    ${s.problem&&t`<${E} problem=${s.problem} />`}
    <${Fe} job=${s} />
    <${Re} job=${s} />
    <${Ne} job=${s} />
    <h2>Details</h2>
    <dl class="facts">
      <dt>Id</dt><dd><code>${s.id}</code></dd>
      ${s.drive_id&&t`<dt>Drive</dt><dd><a href=${d("drives",s.drive_id)}>${s.drive_id}</a></dd>`}
      ${s.parent_id&&t`<dt>Part of</dt><dd><a href=${d("jobs",s.parent_id)}>${s.parent_id}</a></dd>`}
      ${s.retry_of&&t`<dt>Repeats</dt><dd><a href=${d("jobs",s.retry_of)}>${s.retry_of}</a></dd>`}
      <dt>Reused stages</dt><dd>${s.progress.reused_stages?.join(", ")||"none"}</dd>
      <dt>Settings</dt><dd><pre tabindex="0">${JSON.stringify(s.settings,null,1)}</pre></dd>
    </dl>`:t`<${S} title="Job" /><${u} of=${o}>${()=>null}<//>`}function je(e){return!e.finished_at||!e.started_at?"did not start":z((Date.parse(e.finished_at)-Date.parse(e.started_at))/1e3)}function Oe({job:e}){let o=async()=>{let r=await y("POST",`v1/jobs/${e.id}:cancel`);V(await r.json())},n=async()=>{let a=await(await y("POST",`v1/jobs/${e.id}:retry`)).json();V(a),R("jobs",a.id)},s=e.kind!=="SUBMAP"&&(e.state==="FAILED"||e.state==="CANCELLED");return t`${!F(e)&&!e.cancel_requested&&t`<${T} label="Cancel" ask="Cancel this job?" run=${o} danger />`}
  ${s&&t`<${T} label="Retry" ask="Do it again? Finished stages are reused." run=${n} />`}`}function Fe({job:e}){return e.scene_id?t`<p><a class="button primary" href=${d("scenes",e.scene_id)}>Open the scene</a></p>`:e.map_id&&e.map_version?t`<p><a class="button primary" href=${d("maps",e.map_id)}>Open the map</a></p>`:e.export_id?t`<${Le} id=${e.export_id} />`:null}function Le({id:e}){let o=$(n=>g(`v1/exports/${e}`,n),`export ${e}`,!1);return t`<${u} of=${o}>${({scene_id:n,map_id:s,formats:r})=>t`<p>Formats: ${r.join(", ")}.</p>
    <p><a class="button primary" href=${n?d("scenes",n,"files"):d("maps",s??"","files")}>Open the exports of the ${n?"scene":"map"}</a></p>`}<//>`}function Re({job:e}){let o=(e.members??[]).map(r=>({label:r.name,state:r.scene_id?"SUCCEEDED":r.state,percent:r.percent,jobId:r.job_id,note:r.problem?r.problem.detail:r.job_id?"":"its scene was there"})),n=(e.submaps??[]).map(r=>({label:`Sub-map ${r.number}: units ${r.first_unit} to ${r.last_unit}`,state:r.state,percent:r.percent,jobId:r.job_id,note:r.problem?.detail??""})),s=[...o,...n];return s.length===0?null:t`<h2>${o.length>0?"Drives of this map":"Sub-maps"}</h2>
    <ul class="tree">
      ${s.map(r=>t`<li key=${r.label}>
          <span class="label">${r.jobId?t`<a href=${d("jobs",r.jobId)}>${r.label}</a>`:r.label}</span>
          ${r.state&&t`<${_} state=${r.state} />`}
          <${K} percent=${r.percent} label=${`${r.label} done`} />
          ${r.note&&t`<span class="muted small">${r.note}</span>`}
        </li>`)}
    </ul>`}function Ne({job:e}){return e.attempts.length===0?null:t`<h2>Attempts</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Attempts"><table>
      <thead><tr><th scope="col" class="number">Attempt</th><th scope="col">Worker</th><th scope="col">Started</th><th scope="col">Finished</th><th scope="col">Outcome</th></tr></thead>
      <tbody>
        ${e.attempts.map(o=>t`<tr>
            <td class="number">${o.attempt}</td><td><code>${o.worker}</code></td>
            <td><${f} at=${o.started_at} /></td><td><${f} at=${o.finished_at} /></td>
            <td>${o.outcome??"runs"}${o.problem&&t`<div class="small">${o.problem.detail}</div>`}</td>
          </tr>`)}
      </tbody>
    </table></div>`}function ge(){let e=$(r=>M("v1/drives",r),"drives"),[o,n]=h([]),s=(r,a)=>n(a?[...o,r]:o.filter(c=>c!==r));return t`<${S} title="Drives"><a class="button primary" href=${d("upload")}>Upload a drive</a><//>
    <${u} of=${e}>${r=>r.length===0?t`<${m}><p>No drive yet.</p><p>A drive is a folder with <code>drive.json</code> and its images.
            <a href=${d("upload")}>Upload one here</a>, or with <code>mrasfm upload FOLDER</code>.</p><//>`:t`${o.length>1&&t`<${Ae} drives=${r.filter(a=>o.includes(a.id))} />`}
            <${Ie} drives=${r} chosen=${o} choose=${s} />`}<//>`}function Ie({drives:e,chosen:o,choose:n}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Drives"><table>
    <thead><tr><th scope="col"><span class="hidden">Choose for a map</span></th><th scope="col">Drive</th><th scope="col">State</th><th scope="col">Check</th>
      <th scope="col" class="number">Cameras</th><th scope="col" class="number">Frames</th><th scope="col" class="number">Files</th><th scope="col" class="number">Size</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(s=>t`<tr key=${s.id}>
          <td><input type="checkbox" aria-label=${`choose ${s.name} for a map`} disabled=${s.state!=="COMMITTED"}
            checked=${o.includes(s.id)} onChange=${r=>n(s.id,r.target.checked)} /></td>
          <td><a href=${d("drives",s.id)}>${s.name}</a>${s.vehicle&&t`<div class="muted small">${s.vehicle}</div>`}</td>
          <td><${_} state=${s.state} /></td>
          <td><${_} state=${s.preflight} /><div class="muted small">${Je(s)}</div></td>
          <td class="number">${s.cameras}</td>
          <td class="number">${l(s.frames)}</td>
          <td class="number">${l(s.files_stored)} of ${l(s.files_expected)}</td>
          <td class="number">${x(s.bytes_stored)}</td>
          <td><${f} at=${s.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ae({drives:e}){let[o,n]=h("map"),[s,r]=h(null),a=async c=>{c.preventDefault();try{let C=await(await y("POST","v1/aggregations",{json:{drives:e.map(p=>p.id),name:o}})).json();V(C),R("jobs",C.id)}catch(w){r(N(w))}};return t`<form class="box inline" onSubmit=${c=>{a(c)}}>
    <label>Name of the map <input required maxlength="200" value=${o} onInput=${c=>n(c.target.value)} /></label>
    <button class="primary">Make a map of ${e.length} drives</button>
    ${s&&t`<${E} problem=${s} />`}
  </form>`}function ve({id:e}){let o=$(s=>g(`v1/drives/${e}`,s),e),n=o.value;return t`<${S} title=${n?.name??"Drive"} kind="Drive">${n&&t`<${Be} drive=${n} />`}<//>
    <${u} of=${o}>${s=>t`<${Ve} drive=${s} />`}<//>
    ${n&&t`<${He} drive=${n} /><${Ge} drive=${n} /><${Ue} drive=${n} />`}`}function Je(e){return[[e.preflight_errors,"error"],[e.preflight_warnings,"warning"]].filter(([n])=>n>0).map(([n,s])=>j(n,s)).join(", ")}function Ve({drive:e}){return t`<dl class="tiles">
    <${i} label="State"><${_} state=${e.state} /><//>
    <${i} label="Files">${l(e.files_stored)} of ${l(e.files_expected)}<//>
    <${i} label="Size">${x(e.bytes_stored)}<//>
    <${i} label="Cameras">${e.cameras}<//>
    <${i} label="Frames">${l(e.frames)}<//>
    <${i} label="GNSS">${e.has_gnss?"yes":"no"}<//>
    <${i} label="Vehicle">${e.vehicle??"not named"}<//>
    <${i} label="Created"><${f} at=${e.created_at} /><//>
  </dl><p class="muted small"><code>${e.id}</code></p>`}function Be({drive:e}){let o=async()=>{let r=await(await y("POST","v1/reconstructions",{json:{drive_id:e.id}})).json();V(r),R("jobs",r.id)},n=async()=>{await y("DELETE",`v1/drives/${e.id}`),R("drives")};return t`${e.state==="COMMITTED"?t`<${T} label="Reconstruct" ask="Start a reconstruction?" run=${o} />`:t`<a class="button primary" href=${d("upload")}>Continue the upload</a>`}
    <${T} label="Delete" ask="Delete this drive and its images?" run=${n} danger />`}function He({drive:e}){let o=$(n=>g(`v1/drives/${e.id}/preflight`,n),`preflight ${e.id}`);return e.state!=="COMMITTED"?null:t`<h2>Check of the drive</h2>
    <${u} of=${o}>${n=>t`<p><${_} state=${n.state} /> ${n.findings.length===0?n.state==="PENDING"?"The images are being checked.":"No finding.":j(n.findings.length,"finding")}</p><${W} findings=${n.findings} />`}<//>`}function Ge({drive:e}){let o=$(n=>M(`v1/scenes?drive_id=${e.id}`,n),`scenes ${e.id}`);return t`<h2>Scenes</h2><${u} of=${o}>${n=>n.length===0?t`<${m}>No scene of this drive yet.<//>`:t`<${ie} scenes=${n} />`}<//>`}function ie({scenes:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes"><table>
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
  </table></div>`}function Ue({drive:e}){let o=[...G.value?.values()??[]].filter(n=>n.drive_id===e.id);return o.sort((n,s)=>s.created_at.localeCompare(n.created_at)),t`<h2>Jobs</h2>${o.length===0?t`<${m}>No job of this drive yet.<//>`:t`<${ae} jobs=${o} />`}`}function ye(){let[e,o]=h(null),[n,s]=h(!1),r=async a=>{a.preventDefault();let c=a.currentTarget.elements.namedItem("key"),w=c.value.trim();s(!0),o(null);try{let C=await y("POST","v1/session",{headers:{Authorization:`Bearer ${w}`}});c.value="",J(await C.json())}catch(C){o(N(C))}s(!1)};return t`<main class="login" id="main">
    <h1>MRASfM</h1>
    <p>Maps from the cameras of vehicles.</p>
    <form method="post" onSubmit=${a=>{r(a)}}>
      <label for="key">API key</label>
      <input id="key" name="key" type="password" required autocomplete="off" spellcheck=${!1} autofocus placeholder="mrasfm_…" aria-describedby="key-help" />
      <p id="key-help" class="muted">The key is exchanged for a cookie that lasts 12 hours; it is not kept in the browser.
      An operator makes keys with <code>mrasfm keys create</code>.</p>
      <button class="primary" disabled=${n}>${n?"Logging in …":"Log in"}</button>
    </form>
    ${e&&t`<${E} problem=${e} />`}
  </main>`}var ze=[[/^report\.html$/,"the report, for people: opens without the internet"],[/^report\.json$/,"findings, time and counts of every stage, uncertainty"],[/^points\.copc\.laz$/,"the points for GIS programs, cloud-optimised"],[/^points\.ply$/,"the points with colours, for any viewer"],[/^poses\.json$/,"poses of units and images with sigmas"],[/^poses\.tum$/,"poses of the vehicle"],[/^trajectory\.gpkg$/,"positions as a GeoPackage"],[/^calibration(\.json|\/)/,"every camera as given and as refined"],[/^frame\.json$/,"the coordinate frame and its place on the earth"],[/^view\.json$/,"trajectory and frusta for this console"],[/^features\.db$/,"keypoints and matches as a COLMAP database"],[/^model\//,"cameras, rig, images and points in COLMAP's format"],[/^rigs?\//,"the calibration for Kalibr, ROS and URDF"],[/^autoware\//,"the points for Autoware"],[/^pictures\/birds_eye_/,"the road from above, all cameras, before and after calibration"],[/^pictures\/road_(before|after)/,"points of the road, before and after those off its surface were dropped"],[/^pictures\/road\.tif$/,"the road from above as a GeoTIFF, the best view of each place"],[/^pictures\/road\.pgw$/,"the place of road.png on the earth (world file)"],[/^pictures\/road\.png$/,"the road from above, the best view of each place"],[/^pictures\/seam-/,"points of two scenes at their seam, before and after"],[/^pictures\//,"a picture"],[/^road\.json$/,"the surface of the road"],[/^map\.json$/,"scenes, seams and verdicts"],[/^manifest\.json$/,"the drive's manifest, in the engine's axes"],[/^(scenes|seams)\//,"data for the map's next version"],[/^own_car\//,"where the camera shows its own car"],[/^components\//,"of a part of the drive that nothing links to the rest"]];function X({files:e}){let[o,n]=h(""),s=e.filter(a=>a.path.toLowerCase().includes(o.toLowerCase())),r=e.reduce((a,c)=>a+c.size_bytes,0);return t`<h2>Files</h2>
    <p class="muted">${j(e.length,"file")}, ${x(r)} together.</p>
    <label class="filter">Find a file <input type="search" value=${o} onInput=${a=>n(a.target.value)} /></label>
    ${s.length===0?t`<${m}>No file of this name.<//>`:t`<${le} files=${s} label="Files" />`}`}function le({files:e,label:o}){return t`<div class="scroll" tabindex="0" role="region" aria-label=${o}><table>
    <thead><tr><th scope="col">File</th><th scope="col" class="number">Size</th><th scope="col">Content</th></tr></thead>
    <tbody>${e.map(n=>t`<tr key=${n.path}><td><a href=${n.url.replace(/^\//,"")} download>${n.path}</a></td>
        <td class="number">${x(n.size_bytes)}</td><td>${ze.find(([s])=>s.test(n.path))?.[1]??""}</td></tr>`)}</tbody></table></div>`}var Se={colmap:"COLMAP, 3D Gaussian Splatting: pinhole images, masks, model",nerfstudio:"nerfstudio: transforms.json, images, masks",nuscenes:"nuScenes: its tables and images",mcap:"MCAP for Foxglove, Lichtblick, rerun",copc:"points in a coordinate reference system (COPC)",geopackage:"positions in a coordinate reference system (GeoPackage)",geotiff:"picture of the road in a coordinate reference system (GeoTIFF)",kitti:"poses as in KITTI odometry",geojson:"positions for web maps (GeoJSON)"},qe="EPSG:[0-9]{4,6}(\\+[0-9]{4,6})?";function Z(e){return A.value?.session_expires_at?t`<${We} ...${e} />`:null}function We({base:e,components:o=[]}){let n=$(s=>M(`${e}/exports`,s),`exports ${e}`);return t`<h2>Exports</h2>
    <p class="muted">Formats that have the images in them, or a coordinate reference system of your choice, are made by a job.</p>
    <${Qe} base=${e} components=${o} asked=${n.again} />
    <${u} of=${n}>${s=>s.length===0?t`<${m}>No export yet.<//>`:s.map(r=>t`<${Ye} key=${r.id} export=${r} changed=${n.again} />`)}<//>`}function Ke(e){return e.flatMap(o=>{let n=/^components\/(\d+)$/.exec(o.folder);return n?[[Number(n[1]),o]]:[]})}function Qe({base:e,components:o,asked:n}){let[s,r]=h([]),[a,c]=h(0),[w,C]=h(""),[p,P]=h(null),B=Ke(o),b=(v,k)=>r(k?[...s,v]:s.filter(te=>te!==v)),U=async v=>{v.preventDefault(),P(null);let k={formats:[...s],crs:w||null,component:a||null};try{await y("POST",`${e}/exports`,{json:k}),n()}catch(te){P(N(te))}};return t`<form class="box" onSubmit=${v=>{U(v)}}>
    <fieldset class="options"><legend>Formats</legend>
      ${Object.keys(Se).map(v=>t`<label><input type="checkbox" checked=${s.includes(v)} onChange=${k=>b(v,k.target.checked)} /> ${Se[v]}</label>`)}</fieldset>
    <div class="inline">
      ${B.length>0&&t`<label>Part of the drive
        <select value=${a} onChange=${v=>c(Number(v.target.value))}>
          <option value="0">The scene itself</option>
          ${B.map(([v,k])=>t`<option value=${v}>Component ${k.component}: ${j(k.registered_units,"unit")}</option>`)}</select></label>`}
      <label>Coordinate reference system <input size="12" placeholder="the format's own" pattern=${qe} title="as EPSG:25832" value=${w} onInput=${v=>C(v.target.value.trim())} /></label>
      <button class="primary" disabled=${s.length===0}>Export</button>
    </div>
    ${p&&t`<${E} problem=${p} />`}
  </form>`}function Ye({export:e,changed:o}){let n=async()=>{await y("DELETE",`v1/exports/${e.id}`),o()},s=[e.component&&`component ${e.component}`,e.crs,e.image_size_px&&`images of at most ${e.image_size_px} px`],r=e.state==="SUCCEEDED";return t`<section class="box" data-export=${e.id}><h3>${[e.formats.join(", "),...s.filter(Boolean)].join(" · ")}</h3>
    <p><${_} state=${e.state} /> <a href=${d("jobs",e.job_id)}>Its job</a> · <${f} at=${e.created_at} /></p>
    ${e.problem&&t`<${E} problem=${e.problem} />`}
    ${e.results.map(a=>t`<p><strong>${a.format}</strong>: ${a.withheld?t`withheld: ${a.withheld}`:`${j(a.files,"file")}, ${x(a.size_bytes)}`}</p>
        ${(a.notes??[]).length>0&&t`<ul>${(a.notes??[]).map(c=>t`<li>${c}</li>`)}</ul>`}`)}
    ${r&&t`<${Xe} id=${e.id} />`}
    ${(r||e.state==="FAILED"||e.state==="CANCELLED")&&t`<${T} label="Delete" ask="Delete this export and its files?" run=${n} danger />`}
  </section>`}function Xe({id:e}){let[o,n]=h(!1);return t`<details onToggle=${s=>n(s.target.open)}><summary>Files</summary>
    ${o&&t`<${Ze} id=${e} />`}</details>`}var de=200;function Ze({id:e}){let o=$(n=>g(`v1/exports/${e}`,n),`export ${e}`,!1);return t`<${u} of=${o}>${({files:n})=>t`<${le} files=${n.slice(0,de)} label="Files of the export" />
    ${n.length>de&&t`<p class="muted">The first ${de} of ${l(n.length)} files. All of them come with <code>mrasfm-client download ${e} --out DIR</code>.</p>`}`}<//>`}function we(){let e=$(o=>M("v1/scenes",o),"scenes");return t`<${S} title="Scenes" /><${u} of=${e}>${o=>o.length===0?t`<${m}>No scene yet. A reconstruction makes a scene of a <a href=${d("drives")}>drive</a>.<//>`:t`<${ie} scenes=${o} />`}<//>`}var et=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"calibration",label:"Calibration"},{name:"files",label:"Files"}];function _e({id:e,tab:o}){let n=$(a=>g(`v1/scenes/${e}`,a),e,!1),s=n.value,r=async()=>{await y("DELETE",`v1/scenes/${e}`),R("scenes")};return t`<${S} title=${s?.name??"Scene"} kind="Scene">
      ${s&&L(s,"report.html")&&t`<a class="button" href=${D(`v1/scenes/${e}`,"report.html")} download>Download the report</a>`}
      ${A.value?.session_expires_at&&t`<${T} label="Delete" ask="Delete this scene and its files?" run=${r} danger />`}
    <//>
    <${Q} base=${["scenes",e]} tabs=${et} current=${o} />
    <${u} of=${n}>${a=>tt(a,o)}<//>`}function L(e,o){return e.files.some(n=>n.path===o)}function tt(e,o){let n=`v1/scenes/${e.id}`;return o==="3d"?L(e,"view.json")?t`<${O} load=${()=>import("./page-G2IPDNGR.js")} name="Viewer" of=${{base:n,driveOf:{[e.name]:e.drive_id},onlyDrive:e.drive_id}} />`:t`<${m}>This scene has no view.json: it was made by an older version, or its points could not be written. Reconstruct it again.<//>`:o==="place"?L(e,"view.json")?e.summary.georeferenced?t`<${O} load=${()=>import("./page-2NOVBZCY.js")} name="Place" of=${{base:n}} />`:t`<${m}>This scene has no place on the earth: its drive has no GNSS that could be used.<//>`:t`<${m}>This scene has no view.json: it was made by an older version. Reconstruct it again.<//>`:o==="calibration"?t`<${O} load=${()=>import("./page-CT2VSG4I.js")} name="CalibrationPage" of=${{base:n,driveId:e.drive_id,hasPictures:L(e,"pictures/birds_eye_before.png")}} />`:o==="files"?t`<${X} files=${e.files} /><${Z} base=${n} components=${e.summary.components??[]} />`:t`<${ot} scene=${e} />`}function ot({scene:e}){let o=`v1/scenes/${e.id}`,n=$(r=>g(D(o,"report.json"),r),`report ${e.id}`,!1),{summary:s}=e;return t`<dl class="tiles">
      <${i} label="Units registered">${l(s.registered_units)} of ${l(s.units)}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Place on the earth">${s.georeferenced?"by GNSS":"none"}<//>
      <${i} label="Warnings">${s.warnings}<//>
      <${i} label="Made"><${f} at=${e.created_at} /><//>
    </dl>
    <p><a href=${d("drives",e.drive_id)}>The drive</a> · <a href=${d("jobs",e.job_id)}>the job</a> · engine ${s.engine_version}</p>
    <${u} of=${n}>${r=>t`<${ce} report=${r} />`}<//>
    ${(s.components??[]).length>1&&t`<h2>Components</h2><p>Nothing links some parts of this drive with the rest: each is a scene of its own.</p>
      <ul>${(s.components??[]).map(r=>t`<li>Component ${r.component} in <code>${r.folder}</code>: ${l(r.registered_units)} units, ${l(r.points)} points</li>`)}</ul>`}
    ${L(e,"pictures/road_before.png")&&t`<h2>Points of the road</h2>
      <${Y} before=${D(o,"pictures/road_before.png")} after=${D(o,"pictures/road_after.png")} label="Before and after points off its surface were dropped" />`}`}function ce({report:e}){let o=e.summary.mean_reprojection_error_px;return t`<h2>Findings</h2>
    ${(e.findings??[]).length===0?t`<p>None.</p>`:t`<${W} findings=${e.findings} />`}
    ${typeof o=="number"&&t`<p>Mean reprojection error <span data-exact=${o}>${H(o,3)} px</span>.</p>`}
    <h2>Time by stage</h2>
    <${nt} stages=${e.stages} />`}function nt({stages:e}){let o=Math.max(...e.map(n=>n.seconds),1e-9);return t`<table class="bars"><thead class="hidden"><tr><th scope="col">Stage</th><th scope="col">Share</th><th scope="col">Time</th></tr></thead><tbody>${e.map(n=>t`<tr><th scope="row">${n.stage.replaceAll("-"," ")}</th>
      <td><progress max=${o} value=${n.seconds} aria-label=${`time of ${n.stage}`}></progress></td>
      <td class="number">${z(n.seconds)}${n.reused?" (reused)":""}</td></tr>`)}</tbody></table>`}function ke(){let e=$(o=>M("v1/maps",o),"maps");return t`<${S} title="Maps" /><${u} of=${e}>${o=>o.length===0?t`<${m}>No map yet. Choose two or more <a href=${d("drives")}>drives</a> to make one.<//>`:t`<div class="scroll" tabindex="0" role="region" aria-label="Maps"><table>
          <thead><tr><th scope="col">Map</th><th scope="col" class="number">Version</th><th scope="col" class="number">Scenes connected</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col">Created</th></tr></thead>
          <tbody>${o.map(n=>t`<tr key=${n.id}><td><a href=${d("maps",n.id)}>${n.name}</a></td>${st(n)}<td><${f} at=${n.created_at} /></td></tr>`)}</tbody></table></div>`}<//>`}function st(e){let o=e.version?.summary;return o?t`<td class="number">${e.current_version}</td><td class="number">${o.connected} of ${o.scenes}</td><td class="number">${o.seams}</td><td class="number">${l(o.points)}</td>`:t`<td colspan="4" class="muted">${e.job_id?t`<a href=${d("jobs",e.job_id)}>being made</a>`:"no version yet"}</td>`}var rt=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"seams",label:"Seams"},{name:"calibration",label:"Calibration"},{name:"versions",label:"Versions"},{name:"files",label:"Files"}];function xe({id:e,tab:o}){let n=$(r=>g(`v1/maps/${e}`,r),e),s=n.value;return t`<${S} title=${s?.name??"Map"} kind="Map" />
    <${Q} base=${["maps",e]} tabs=${rt} current=${o} />
    <${u} of=${n}>${r=>o==="versions"?t`<${$t} map=${r} changed=${n.again} />`:r.version?t`<${at} key=${r.version.number} map=${r} number=${r.version.number} tab=${o} />`:t`<${m}>This map has no version yet.${r.job_id&&t` <a href=${d("jobs",r.job_id)}>Its job</a>`}<//>`}<//>`}function at({map:e,number:o,tab:n}){let s=`v1/maps/${e.id}/versions/${o}`,r=$(a=>g(s,a),s,!1);return t`<${u} of=${r}>${a=>it(a,s,n)}<//>`}function it(e,o,n){if(n==="files")return t`<${X} files=${e.files} /><${Z} base=${o} />`;if(n==="seams")return t`<${ct} version=${e} base=${o} />`;if(n==="calibration"){let s=e.files.map(r=>r.path).filter(r=>/^calibration\/[^/]+\.json$/.test(r));return s.length===0?t`<${m}>This version has no calibration of its drives. Each scene has its own.<//>`:t`<${O} load=${()=>import("./page-CT2VSG4I.js")} name="MapCalibration" of=${{base:o,files:s}} />`}if(n==="3d"){if(!L(e,"view.json"))return t`<${m}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;let s=Object.fromEntries(e.scenes.map(r=>[r.name,r.drive_id]));return t`<${O} load=${()=>import("./page-G2IPDNGR.js")} name="Viewer" of=${{base:o,driveOf:s}} />`}return n==="place"?L(e,"view.json")?e.summary.georeferenced?t`<${O} load=${()=>import("./page-2NOVBZCY.js")} name="Place" of=${{base:o}} />`:t`<${m}>This map has no place on the earth: none of its drives has GNSS that could be used.<//>`:t`<${m}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`:t`<${lt} version=${e} base=${o} />`}function lt({version:e,base:o}){let n=$(r=>g(D(o,"report.json"),r),`report ${o}`,!1),{summary:s}=e;return t`${L(e,"report.html")&&t`<p><a class="button" href=${D(o,"report.html")} download>Download the report</a></p>`}
    <dl class="tiles">
      <${i} label="Version">${e.number}<//>
      <${i} label="Scenes connected">${s.connected} of ${s.scenes}<//>
      <${i} label="Seams">${s.seams}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Made"><${f} at=${e.created_at} /><//>
    </dl>
    <h2>Scenes</h2><${dt} version=${e} />
    ${e.failed.length>0&&t`<h2>Drives without a scene</h2>${e.failed.map(r=>t`<p><a href=${d("drives",r.drive_id)}>${r.name}</a></p><${E} problem=${r.problem} />`)}`}
    <${u} of=${n}>${r=>t`<${ce} report=${r} />`}<//>`}function dt({version:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes of the map"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col">Connected</th><th scope="col">Drive</th></tr></thead>
    <tbody>${e.scenes.map(o=>t`<tr><td><a href=${d("scenes",o.scene_id)}>${o.name}</a></td>
        <td>${o.connected?t`<span class="badge good">connected</span>`:t`<span class="badge warn">placed by positions only</span>`}</td>
        <td><a href=${d("drives",o.drive_id)}><code>${o.drive_id}</code></a></td></tr>`)}</tbody></table></div>`}function ct({version:e,base:o}){let n=$(s=>g(D(o,"map.json"),s),`map ${o}`,!1);return t`<${u} of=${n}>${s=>t`
    ${s.seams.length===0&&t`<${m}>No two scenes of this map were close enough to look for a seam.<//>`}
    ${s.seams.map(r=>t`<${pt} seam=${r} base=${o} version=${e} />`)}
    ${e.unconnected.length>0&&t`<h2>Not connected</h2><p>No seam in use connects these scenes with the others; positions place them: ${e.unconnected.join(", ")}.</p>`}`}<//>`}function pt({seam:e,base:o}){let n=`${e.a} – ${e.b}`,s=(r,a,c)=>a===void 0?null:t`<${i} label=${r}><span data-exact=${a}>${H(a,3)} ${c}</span><//>`;return t`<section class="box"><h2>${n}</h2>
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
  </section>`}function $t({map:e,changed:o}){let n=$(s=>M(`v1/maps/${e.id}/versions`,s),`versions ${e.id} ${e.current_version}`);return t`<${u} of=${n}>${s=>s.length===0?t`<${m}>No version yet.<//>`:t`<${mt} map=${e} versions=${s} loaded=${n} changed=${o} />`}<//>`}function mt({map:e,versions:o,changed:n}){let s=o.map(b=>b.number),[r,a]=h(s[1]??s[0]),[c,w]=h(s[0]),C=async b=>{await y("PUT",`v1/maps/${e.id}/current-version`,{json:{version:b}}),n()},p=(b,U,v)=>t`<label>${b}
    <select value=${U} onChange=${k=>v(Number(k.target.value))}>
      ${s.map(k=>t`<option value=${k} selected=${k===U}>Version ${k}</option>`)}</select></label>`,[P,B]=[o.find(b=>b.number===r),o.find(b=>b.number===c)];return t`<div class="scroll" tabindex="0" role="region" aria-label="Versions"><table>
      <thead><tr><th scope="col" class="number">Version</th><th scope="col">Made</th><th scope="col" class="number">Scenes</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col"></th></tr></thead>
      <tbody>${o.map(b=>t`<tr key=${b.number}><td class="number">${b.number}</td><td><${f} at=${b.created_at} /></td>
          <td class="number">${b.summary.scenes}</td><td class="number">${b.summary.seams}</td><td class="number">${l(b.summary.points)}</td>
          <td>${b.is_current?t`<${_} state="current" />`:t`<${T} label="Make it current" ask=${`Show version ${b.number}?`} run=${()=>C(b.number)} />`}</td></tr>`)}</tbody></table></div>
    <h2>Compare</h2>
    ${s.length<2?t`<p class="muted">There is one version only. An aggregation into this map makes the next.</p>`:t`<div class="inline">${p("From",r,a)} ${p("To",c,w)}</div>${P&&B&&t`<${ht} a=${P} b=${B} />`}`}`}var ut=["scenes","connected","seams","registered_units","registered_images","points","warnings"];function ht({a:e,b:o}){let n=p=>new Map(p.scenes.map(P=>[P.name,P.connected])),[s,r]=[n(e),n(o)],a=[...r.keys()].filter(p=>!s.has(p)),c=[...s.keys()].filter(p=>!r.has(p)),w=[...r].filter(([p,P])=>s.has(p)&&s.get(p)!==P),C=p=>p>0?`+${l(p)}`:p<0?`−${l(-p)}`:"same";return t`<table><thead><tr><th scope="col">Figure</th><th scope="col" class="number">Version ${e.number}</th><th scope="col" class="number">Version ${o.number}</th><th scope="col" class="number">Change</th></tr></thead>
      <tbody>${ut.map(p=>t`<tr><th scope="row">${p.replaceAll("_"," ")}</th><td class="number">${l(e.summary[p])}</td><td class="number">${l(o.summary[p])}</td><td class="number">${C(o.summary[p]-e.summary[p])}</td></tr>`)}</tbody></table>
    <ul>
      <li>Scenes added: ${a.join(", ")||"none"}</li>
      <li>Scenes removed: ${c.join(", ")||"none"}</li>
      <li>Connection changed: ${w.map(([p,P])=>`${p} (${P?"connected now":"not connected any more"})`).join(", ")||"none"}</li>
    </ul>`}var ft=5e3;function Ce(){let e=$(o=>g("v1/status",o),"status");return I(()=>{let o=setInterval(()=>document.hidden||e.again(),ft);return()=>clearInterval(o)},[]),t`<${S} title="Status" /><${u} of=${e}>${o=>t`<${bt} status=${o} />`}<//>`}function bt({status:e}){let[o,n]=[e.workers.filter(r=>r.online),e.workers.filter(r=>!r.online)],s=1-e.disk.free_bytes/e.disk.total_bytes;return t`<p><${_} state=${e.status} /> Version ${e.version}</p>
    ${e.reasons.length>0&&t`<ul class="findings">${e.reasons.map(r=>t`<li class="warn">${r}</li>`)}</ul>`}
    <dl class="tiles">
      <${i} label="Jobs that wait">${l(e.queue.queued)}<//>
      <${i} label="Jobs that run">${l(e.queue.running)}<//>
      <${i} label="Stalled jobs">${l(e.queue.stalled)}<//>
      <${i} label="Broker">${e.broker?"answers":"does not answer"}<//>
      <${i} label="Disk">${x(e.disk.free_bytes)} free of ${x(e.disk.total_bytes)}
        <progress max="1" value=${s} aria-label="disk in use"></progress><//>
      <${i} label="Uploads">${e.disk.accepts_uploads?"are taken":"are refused: the disk is full"}<//>
    </dl>
    <h2>Workers</h2>
    ${o.length===0?t`<${m}>No worker is online. Jobs are accepted and wait.<//>`:t`<${Ee} workers=${o} label="Workers" />`}
    ${n.length>0&&t`<details class="box"><summary>${j(n.length,"worker")} that ended within the last day</summary><${Ee} workers=${n} label="Workers that ended" /></details>`}
    <p><a href="docs">Description of the API</a></p>`}function Ee({workers:e,label:o}){return t`<div class="scroll" tabindex="0" role="region" aria-label=${o}><table>
    <thead><tr><th scope="col">Worker</th><th scope="col">Online</th><th scope="col">Queues</th><th scope="col" class="number">Jobs at one time</th><th scope="col">Last report</th></tr></thead>
    <tbody>${e.map(n=>t`<tr><td><code>${n.name}</code></td><td><span class=${`badge ${n.online?"good":"plain"}`}>${n.online?"online":"offline"}</span></td>
        <td>${n.queues.join(", ")}</td><td class="number">${n.concurrency}</td><td><${f} at=${n.seen_at} /></td></tr>`)}</tbody></table></div>`}function Pe(){let e=$(o=>g("v1/session",o),"session");return t`<${S} title="Key and project" /><${u} of=${e}>${o=>t`
    <dl class="tiles">
      <${i} label="Project">${o.project}<//>
      <${i} label="Key">${o.key_name}<//>
      <${i} label="Key made"><${f} at=${o.key_created_at} /><//>
      <${i} label="Session ends"><${f} at=${o.session_expires_at} /><//>
      <${i} label="Stored">${x(o.used_bytes)} of ${x(o.max_bytes)}
        <progress max=${o.max_bytes} value=${o.used_bytes} aria-label="storage in use"></progress><//>
      <${i} label="Active jobs">at most ${l(o.max_active_jobs)}<//>
      <${i} label="Drives">at most ${l(o.max_drives)}<//>
    </dl>
    <p class="muted small"><code>${o.key_id}</code></p>
    <h2>More keys</h2>
    <p>Keys are made and revoked on the service's machine. A revoked key ends its sessions within seconds.</p>
    <pre tabindex="0">mrasfm keys create --name NAME
mrasfm keys revoke ${o.key_id}</pre>`}<//>
    <p><a href=${d("status")}>Status of the service</a></p>`}async function Me(){await fetch("v1/session",{method:"DELETE"}),J(null)}var gt=[["drives","Drives"],["jobs","Jobs"],["scenes","Scenes"],["maps","Maps"],["status","Status"],["keys","Key"]],vt={connecting:"connecting …",live:"live",polling:"polling",offline:"offline, tries again"};function yt(e){let[o="drives",n,s=""]=e;return o==="upload"?t`<${O} key="upload" load=${()=>import("./page-K42RMJGG.js")} name="UploadPage" of=${{}} />`:o==="jobs"?n?t`<${be} key=${n} id=${n} />`:t`<${fe} />`:o==="scenes"?n?t`<${_e} key=${`${n} ${s}`} id=${n} tab=${s} />`:t`<${we} />`:o==="maps"?n?t`<${xe} key=${`${n} ${s}`} id=${n} tab=${s} />`:t`<${ke} />`:o==="status"?t`<${Ce} />`:o==="keys"?t`<${Pe} />`:n?t`<${ve} key=${n} id=${n} />`:t`<${ge} />`}function St(){let e=he.value,o=e[0]==="upload"?"drives":e[0]??"drives";return I(()=>{document.querySelector("main h1")?.focus({preventScroll:!0}),window.scrollTo(0,0)},[e.slice(0,2).join("/")]),t`<a class="skip" href="#main" onClick=${wt}>Skip to the content</a>
    <header>
      <a class="brand" href=${d("drives")}>MRASfM</a>
      <nav aria-label="Pages">${gt.filter(([n])=>!ee()||n==="scenes"||n==="maps").map(([n,s])=>t`<a href=${d(n)} aria-current=${o===n?"page":void 0}>${s}</a>`)}</nav>
      <div class="session">${!ee()&&t`<span class=${`connection ${q.value}`} role="status" data-connection=${q.value}>${vt[q.value]}</span>`}
        <span class="muted project">${A.value?.project}</span>
        ${!ee()&&t`<button type="button" onClick=${()=>{Me()}}>Log out</button>`}</div>
    </header>
    <main id="main">${yt(e)}</main>`}function wt(e){e.preventDefault(),document.querySelector("main h1")?.focus()}function _t(){let e=A.value,o=!!e;return I(()=>{o?me():ue()},[o]),e===void 0?t`<main class="login"><p class="muted" aria-busy="true">Loading …</p></main>`:e===null?t`<${ye} />`:t`<${St} />`}function ee(){return document.querySelector("meta[name=mrasfm-session]")?.getAttribute("content")==="open"}async function kt(){try{J(ee()||$e()?await g("v1/session"):null)}catch{J(null)}}pe(t`<${_t} />`,document.getElementById("app"));kt();

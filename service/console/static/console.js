import{a as X}from"./chunk-Y3GPSS3G.js";import{A as z,B as W,C as F,D as G,E as we,F as _e,G as ke,H as d,I as R,J as m,K as D,L as S,M as K,N as h,O as y,P as u,Q as x,R as Q,S as re,T as ae,U as ie,V as i,W as f,X as T,Y,a as he,b as $,c as A,e as fe,f as J,g as be,h as ge,i as ve,j as B,k as ye,m as v,o as Se,p as g,q as C,s as M,t as P,u as l,v as H,x as q,y as j,z as t}from"./chunk-5IVFLYQX.js";function O({load:e,name:o,of:n}){let[s,r]=$(null),[a,p]=$(null);return A(()=>{e().then(E=>r({show:E[o]}),E=>p(D(E)))},[]),a?t`<${S} problem=${a} />`:s?t`<${s.show} ...${n} />`:t`<p class="muted" aria-busy="true">Loading …</p>`}var le=200,xe=5,Be={active:"Not ended",failed:"Failed",all:"All"};function Ee(){let[e,o]=$("all"),n=z.value,r=[...n?.values()??[]].sort((a,p)=>p.created_at.localeCompare(a.created_at)).filter(a=>e==="active"?!F(a):e==="failed"?a.state==="FAILED":!0);return t`<${y} title="Jobs">
      <div class="choice" role="group" aria-label="Jobs to show">
        ${Object.entries(Be).map(([a,p])=>t`<button type="button" aria-pressed=${e===a} onClick=${()=>o(a)}>${p}</button>`)}
      </div>
    <//>
    ${n===null&&t`<p class="muted" aria-busy="true">Loading …</p>`}
    ${n!==null&&r.length===0&&t`<${u}>${e==="all"?"No job yet. Upload a drive and start its reconstruction.":"No such job."}<//>`}
    ${r.length>0&&t`<${de} jobs=${r.slice(0,le)} />`}
    ${r.length>le&&t`<p class="muted">The newest ${le} of ${r.length} jobs are shown.</p>`}`}function de({jobs:e}){let o=m(n=>C("v1/drives",n),"names of drives");return t`<div class="scroll" tabindex="0" role="region" aria-label="Jobs"><table>
    <thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col">Stage</th><th scope="col">Time left</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(n=>t`<tr key=${n.id}>
          <td><a href=${d("jobs",n.id)}>${re[n.kind]}</a><div class="muted small">${Ve(n,o.value)}</div></td>
          <td><${x} state=${n.state} /></td>
          <td><${Q} percent=${n.progress.percent} label="done" /></td>
          <td>${F(n)?"–":ie(n)}</td>
          <td class="number">${F(n)?"–":ae(n)}</td>
          <td><${f} at=${n.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ve(e,o){let n=(e.members??[]).map(r=>r.name),s=n.length-xe;return n.length>0?n.slice(0,xe).join(", ")+(s>0?` and ${s} more`:""):o?.find(r=>r.id===e.drive_id)?.name??e.drive_id??e.id}function Pe({id:e}){let o=m(r=>g(`v1/jobs/${e}`,r),e),s=z.value?.get(e)??o.value;return s?t`<${y} title=${re[s.kind]} kind="Job"><${Ge} job=${s} /><//>
    <div class="row"><${x} state=${s.state} />${s.cancel_requested&&!F(s)&&t`<span class="badge warn">stopping</span>`}
      <${Q} percent=${s.progress.percent} label="done" /></div>
    <dl class="tiles" aria-live="polite">
      <${i} label=${F(s)?"Last stage":"Stage"}>${s.state==="SUCCEEDED"?"all done":ie(s)}<//>
      <${i} label=${F(s)?"Took":"Time left"}>${F(s)?He(s):ae(s)}<//>
      <${i} label="Created"><${f} at=${s.created_at} /><//>
      <${i} label="Started"><${f} at=${s.started_at} /><//>
      <${i} label="Heartbeat"><${f} at=${s.heartbeat_at} /><//>
    </dl>
    ${s.problem&&t`<${S} problem=${s.problem} />`}
    <${Ue} job=${s} />
    <${ze} job=${s} />
    <${We} job=${s} />
    <h2>Details</h2>
    <dl class="facts">
      <dt>Id</dt><dd><code>${s.id}</code></dd>
      ${s.drive_id&&t`<dt>Drive</dt><dd><a href=${d("drives",s.drive_id)}>${s.drive_id}</a></dd>`}
      ${s.parent_id&&t`<dt>Part of</dt><dd><a href=${d("jobs",s.parent_id)}>${s.parent_id}</a></dd>`}
      ${s.retry_of&&t`<dt>Repeats</dt><dd><a href=${d("jobs",s.retry_of)}>${s.retry_of}</a></dd>`}
      <dt>Reused stages</dt><dd>${s.progress.reused_stages?.join(", ")||"none"}</dd>
      <dt>Settings</dt><dd><pre tabindex="0">${JSON.stringify(s.settings,null,1)}</pre></dd>
    </dl>`:t`<${y} title="Job" /><${h} of=${o}>${()=>null}<//>`}function He(e){return!e.finished_at||!e.started_at?"did not start":H((Date.parse(e.finished_at)-Date.parse(e.started_at))/1e3)}function Ge({job:e}){let o=async()=>{let r=await v("POST",`v1/jobs/${e.id}:cancel`);G(await r.json())},n=async()=>{let a=await(await v("POST",`v1/jobs/${e.id}:retry`)).json();G(a),R("jobs",a.id)},s=e.kind!=="SUBMAP"&&(e.state==="FAILED"||e.state==="CANCELLED");return t`${!F(e)&&!e.cancel_requested&&t`<${T} label="Cancel" ask="Cancel this job?" run=${o} danger />`}
  ${s&&t`<${T} label="Retry" ask="Do it again? Finished stages are reused." run=${n} />`}`}function Ue({job:e}){return e.scene_id?t`<p><a class="button primary" href=${d("scenes",e.scene_id)}>Open the scene</a></p>`:e.map_id&&e.map_version?t`<p><a class="button primary" href=${d("maps",e.map_id)}>Open the map</a></p>`:e.export_id?t`<${qe} id=${e.export_id} />`:null}function qe({id:e}){let o=m(n=>g(`v1/exports/${e}`,n),`export ${e}`,!1);return t`<${h} of=${o}>${({scene_id:n,map_id:s,formats:r})=>t`<p>Formats: ${r.join(", ")}.</p>
    <p><a class="button primary" href=${n?d("scenes",n,"files"):d("maps",s??"","files")}>Open the exports of the ${n?"scene":"map"}</a></p>`}<//>`}function ze({job:e}){let o=(e.members??[]).map(r=>({label:r.name,state:r.scene_id?"SUCCEEDED":r.state,percent:r.percent,jobId:r.job_id,note:r.problem?r.problem.detail:r.job_id?"":"its scene was there"})),n=(e.submaps??[]).map(r=>({label:`Sub-map ${r.number}: units ${r.first_unit} to ${r.last_unit}`,state:r.state,percent:r.percent,jobId:r.job_id,note:r.problem?.detail??""})),s=[...o,...n];return s.length===0?null:t`<h2>${o.length>0?"Drives of this map":"Sub-maps"}</h2>
    <ul class="tree">
      ${s.map(r=>t`<li key=${r.label}>
          <span class="label">${r.jobId?t`<a href=${d("jobs",r.jobId)}>${r.label}</a>`:r.label}</span>
          ${r.state&&t`<${x} state=${r.state} />`}
          <${Q} percent=${r.percent} label=${`${r.label} done`} />
          ${r.note&&t`<span class="muted small">${r.note}</span>`}
        </li>`)}
    </ul>`}function We({job:e}){return e.attempts.length===0?null:t`<h2>Attempts</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Attempts"><table>
      <thead><tr><th scope="col" class="number">Attempt</th><th scope="col">Worker</th><th scope="col">Started</th><th scope="col">Finished</th><th scope="col">Outcome</th></tr></thead>
      <tbody>
        ${e.attempts.map(o=>t`<tr>
            <td class="number">${o.attempt}</td><td><code>${o.worker}</code></td>
            <td><${f} at=${o.started_at} /></td><td><${f} at=${o.finished_at} /></td>
            <td>${o.outcome??"runs"}${o.problem&&t`<div class="small">${o.problem.detail}</div>`}</td>
          </tr>`)}
      </tbody>
    </table></div>`}function Ce(){let e=m(r=>C("v1/drives",r),"drives"),[o,n]=$([]),s=(r,a)=>n(a?[...o,r]:o.filter(p=>p!==r));return t`<${y} title="Drives"><a class="button primary" href=${d("upload")}>Upload a drive</a><//>
    <${h} of=${e}>${r=>r.length===0?t`<${u}><p>No drive yet.</p><p>A drive is a folder with <code>drive.json</code> and its images.
            <a href=${d("upload")}>Upload one here</a>, or with <code>mrasfm upload FOLDER</code>.</p><//>`:t`<${Qe} drives=${r.filter(a=>o.includes(a.id))} />
            <${Ke} drives=${r} chosen=${o} choose=${s} />`}<//>`}function Ke({drives:e,chosen:o,choose:n}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Drives"><table>
    <thead><tr><th scope="col"><span class="hidden">Choose for a map</span></th><th scope="col">Drive</th><th scope="col">State</th><th scope="col">Check</th>
      <th scope="col" class="number">Cameras</th><th scope="col" class="number">Frames</th><th scope="col" class="number">Files</th><th scope="col" class="number">Size</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(s=>t`<tr key=${s.id}>
          <td><input type="checkbox" aria-label=${`choose ${s.name} for a map`} disabled=${s.state!=="COMMITTED"}
            checked=${o.includes(s.id)} onChange=${r=>n(s.id,r.target.checked)} /></td>
          <td><a href=${d("drives",s.id)}>${s.name}</a>${s.vehicle&&t`<div class="muted small">${s.vehicle}</div>`}</td>
          <td><${x} state=${s.state} /></td>
          <td><${x} state=${s.preflight} /><div class="muted small">${Xe(s)}</div></td>
          <td class="number">${s.cameras}</td>
          <td class="number">${l(s.frames)}</td>
          <td class="number">${l(s.files_stored)} of ${l(s.files_expected)}</td>
          <td class="number">${P(s.bytes_stored)}</td>
          <td><${f} at=${s.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Qe({drives:e}){return e.length>1?t`<${Ye} drives=${e} />`:null}function Ye({drives:e}){let[o,n]=$("map"),[s,r]=$(null),[a,p]=$(!1),E=async _=>{_.preventDefault(),p(!0),r(null);try{let k=await(await v("POST","v1/aggregations",{json:{drives:e.map(V=>V.id),name:o}})).json();G(k),R("jobs",k.id)}catch(c){r(D(c))}p(!1)};return t`<form class="box inline" onSubmit=${_=>{E(_)}}>
    <label>Name of the map <input required maxlength="200" value=${o} onInput=${_=>n(_.target.value)} /></label>
    <button class="primary" disabled=${a}>Make a map of ${e.length} drives</button>
    ${s&&t`<${S} problem=${s} />`}
  </form>`}function Te({id:e}){let o=m(s=>g(`v1/drives/${e}`,s),e),n=o.value;return t`<${y} title=${n?.name??"Drive"} kind="Drive">${n&&t`<${et} drive=${n} />`}<//>
    <${h} of=${o}>${s=>t`<${Ze} drive=${s} />`}<//>
    ${n&&t`<${tt} drive=${n} /><${ot} drive=${n} /><${nt} drive=${n} />`}`}function Xe(e){return[[e.preflight_errors,"error"],[e.preflight_warnings,"warning"]].filter(([n])=>n>0).map(([n,s])=>j(n,s)).join(", ")}function Ze({drive:e}){return t`<dl class="tiles">
    <${i} label="State"><${x} state=${e.state} /><//>
    <${i} label="Files">${l(e.files_stored)} of ${l(e.files_expected)}<//>
    <${i} label="Size">${P(e.bytes_stored)}<//>
    <${i} label="Cameras">${e.cameras}<//>
    <${i} label="Frames">${l(e.frames)}<//>
    <${i} label="GNSS">${e.has_gnss?"yes":"no"}<//>
    <${i} label="Vehicle">${e.vehicle??"not named"}<//>
    <${i} label="Created"><${f} at=${e.created_at} /><//>
  </dl><p class="muted small"><code>${e.id}</code></p>`}function et({drive:e}){let o=async()=>{let r=await(await v("POST","v1/reconstructions",{json:{drive_id:e.id}})).json();G(r),R("jobs",r.id)},n=async()=>{await v("DELETE",`v1/drives/${e.id}`),R("drives")};return t`${e.state==="COMMITTED"?t`<${T} label="Reconstruct" ask="Start a reconstruction?" run=${o} />`:t`<a class="button primary" href=${d("upload")}>Continue the upload</a>`}
    <${T} label="Delete" ask="Delete this drive and its images?" run=${n} danger />`}function tt({drive:e}){let o=m(n=>g(`v1/drives/${e.id}/preflight`,n),`preflight ${e.id}`);return e.state!=="COMMITTED"?null:t`<h2>Check of the drive</h2>
    <${h} of=${o}>${n=>t`<p><${x} state=${n.state} /> ${n.findings.length===0?n.state==="PENDING"?"The images are being checked.":"No finding.":j(n.findings.length,"finding")}</p><${K} findings=${n.findings} />`}<//>`}function ot({drive:e}){let o=m(n=>C(`v1/scenes?drive_id=${e.id}`,n),`scenes ${e.id}`);return t`<h2>Scenes</h2><${h} of=${o}>${n=>n.length===0?t`<${u}>No scene of this drive yet.<//>`:t`<${ce} scenes=${n} />`}<//>`}function ce({scenes:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes"><table>
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
  </table></div>`}function nt({drive:e}){let o=[...z.value?.values()??[]].filter(n=>n.drive_id===e.id);return o.sort((n,s)=>s.created_at.localeCompare(n.created_at)),t`<h2>Jobs</h2>${o.length===0?t`<${u}>No job of this drive yet.<//>`:t`<${de} jobs=${o} />`}`}function Me(){let[e,o]=$(null),[n,s]=$(!1),r=async a=>{a.preventDefault();let p=a.currentTarget.elements.namedItem("key"),E=p.value.trim();s(!0),o(null);try{let _=await v("POST","v1/session",{headers:{Authorization:`Bearer ${E}`}});p.value="",B(await _.json())}catch(_){o(D(_))}s(!1)};return t`<main class="login" id="main">
    <h1>MRASfM</h1>
    <p>Maps from the cameras of vehicles.</p>
    <form method="post" onSubmit=${a=>{r(a)}}>
      <label for="key">API key</label>
      <input id="key" name="key" type="password" required autocomplete="off" spellcheck=${!1} autofocus placeholder="mrasfm_…" aria-describedby="key-help" />
      <p id="key-help" class="muted">The key is exchanged for a cookie that lasts 12 hours; it is not kept in the browser.
      An operator makes keys with <code>mrasfm keys create</code>.</p>
      <button class="primary" disabled=${n}>${n?"Logging in …":"Log in"}</button>
    </form>
    ${e&&t`<${S} problem=${e} />`}
  </main>`}var st=[[/^report\.html$/,"the report, for people: opens without the internet"],[/^report\.json$/,"findings, time and counts of every stage, uncertainty"],[/^points\.copc\.laz$/,"the points for GIS programs, cloud-optimised"],[/^points\.ply$/,"the points with colours, for any viewer"],[/^poses\.json$/,"poses of units and images with sigmas"],[/^poses\.tum$/,"poses of the vehicle"],[/^trajectory\.gpkg$/,"positions as a GeoPackage"],[/^calibration(\.json|\/)/,"every camera as given and as refined"],[/^frame\.json$/,"the coordinate frame and its place on the earth"],[/^view\.json$/,"trajectory and frusta for this console"],[/^features\.db$/,"keypoints and matches as a COLMAP database"],[/^model\//,"cameras, rig, images and points in COLMAP's format"],[/^rigs?\//,"the calibration for Kalibr, ROS and URDF"],[/^autoware\//,"the points for Autoware"],[/^pictures\/birds_eye_/,"the road from above, all cameras, before and after calibration"],[/^pictures\/road_(before|after)/,"points of the road, before and after those off its surface were dropped"],[/^pictures\/road\.tif$/,"the road from above as a GeoTIFF, the best view of each place"],[/^pictures\/road\.pgw$/,"the place of road.png on the earth (world file)"],[/^pictures\/road\.png$/,"the road from above, the best view of each place"],[/^pictures\/seam-/,"points of two scenes at their seam, before and after"],[/^pictures\//,"a picture"],[/^road\.json$/,"the surface of the road"],[/^map\.json$/,"scenes, seams and verdicts"],[/^manifest\.json$/,"the drive's manifest, in the engine's axes"],[/^(scenes|seams)\//,"data for the map's next version"],[/^own_car\//,"where the camera shows its own car"],[/^components\//,"of a part of the drive that nothing links to the rest"]];function Z({files:e}){let[o,n]=$(""),s=e.filter(a=>a.path.toLowerCase().includes(o.toLowerCase())),r=e.reduce((a,p)=>a+p.size_bytes,0);return t`<h2>Files</h2>
    <p class="muted">${j(e.length,"file")}, ${P(r)} together.</p>
    <label class="filter">Find a file <input type="search" value=${o} onInput=${a=>n(a.target.value)} /></label>
    ${s.length===0?t`<${u}>No file of this name.<//>`:t`<${pe} files=${s} label="Files" />`}`}function pe({files:e,label:o}){return t`<div class="scroll" tabindex="0" role="region" aria-label=${o}><table>
    <thead><tr><th scope="col">File</th><th scope="col" class="number">Size</th><th scope="col">Content</th></tr></thead>
    <tbody>${e.map(n=>t`<tr key=${n.path}><td><a href=${n.url.replace(/^\//,"")} download>${n.path}</a></td>
        <td class="number">${P(n.size_bytes)}</td><td>${st.find(([s])=>s.test(n.path))?.[1]??""}</td></tr>`)}</tbody></table></div>`}var De={colmap:"COLMAP, 3D Gaussian Splatting: pinhole images, masks, model",nerfstudio:"nerfstudio: transforms.json, images, masks",nuscenes:"nuScenes: its tables and images",mcap:"MCAP for Foxglove, Lichtblick, rerun",copc:"points in a coordinate reference system (COPC)",geopackage:"positions in a coordinate reference system (GeoPackage)",geotiff:"picture of the road in a coordinate reference system (GeoTIFF)",kitti:"poses as in KITTI odometry",geojson:"positions for web maps (GeoJSON)"},rt="EPSG:[0-9]{4,6}(\\+[0-9]{4,6})?";function ee(e){return J.value?.session_expires_at?t`<${at} ...${e} />`:null}function at({base:e,components:o=[]}){let n=m(s=>C(`${e}/exports`,s),`exports ${e}`);return t`<h2>Exports</h2>
    <p class="muted">Formats that have the images in them, or a coordinate reference system of your choice, are made by a job.</p>
    <${lt} base=${e} components=${o} asked=${n.again} />
    <${h} of=${n}>${s=>s.length===0?t`<${u}>No export yet.<//>`:s.map(r=>t`<${dt} key=${r.id} export=${r} changed=${n.again} />`)}<//>`}function it(e){return e.flatMap(o=>{let n=/^components\/(\d+)$/.exec(o.folder);return n?[[Number(n[1]),o]]:[]})}function lt({base:e,components:o,asked:n}){let[s,r]=$([]),[a,p]=$(0),[E,_]=$(""),[c,k]=$(null),[V,b]=$(!1),U=it(o),ne=(w,N)=>r(N?[...s,w]:s.filter(se=>se!==w)),I=async w=>{w.preventDefault(),b(!0),k(null);let N={formats:[...s],crs:E||null,component:a||null};try{await v("POST",`${e}/exports`,{json:N}),n()}catch(se){k(D(se))}b(!1)};return t`<form class="box" onSubmit=${w=>{I(w)}}>
    <fieldset class="options"><legend>Formats</legend>
      ${Object.keys(De).map(w=>t`<label><input type="checkbox" checked=${s.includes(w)} onChange=${N=>ne(w,N.target.checked)} /> ${De[w]}</label>`)}</fieldset>
    <div class="inline">
      ${U.length>0&&t`<label>Part of the drive
        <select value=${a} onChange=${w=>p(Number(w.target.value))}>
          <option value="0">The scene itself</option>
          ${U.map(([w,N])=>t`<option value=${w}>Component ${N.component}: ${j(N.registered_units,"unit")}</option>`)}</select></label>`}
      <label>Coordinate reference system <input size="12" placeholder="the format's own" pattern=${rt} title="as EPSG:25832" value=${E} onInput=${w=>_(w.target.value.trim())} /></label>
      <button class="primary" disabled=${s.length===0||V}>Export</button>
    </div>
    ${c&&t`<${S} problem=${c} />`}
  </form>`}function dt({export:e,changed:o}){let n=async()=>{await v("DELETE",`v1/exports/${e.id}`),o()},s=[e.component&&`component ${e.component}`,e.crs,e.image_size_px&&`images of at most ${e.image_size_px} px`],r=e.state==="SUCCEEDED";return t`<section class="box" data-export=${e.id}><h3>${[e.formats.join(", "),...s.filter(Boolean)].join(" · ")}</h3>
    <p><${x} state=${e.state} /> <a href=${d("jobs",e.job_id)}>Its job</a> · <${f} at=${e.created_at} /></p>
    ${e.problem&&t`<${S} problem=${e.problem} />`}
    ${e.results.map(a=>t`<p><strong>${a.format}</strong>: ${a.withheld?t`withheld: ${a.withheld}`:`${j(a.files,"file")}, ${P(a.size_bytes)}`}</p>
        ${(a.notes??[]).length>0&&t`<ul>${(a.notes??[]).map(p=>t`<li>${p}</li>`)}</ul>`}`)}
    ${r&&t`<${ct} id=${e.id} />`}
    ${(r||e.state==="FAILED"||e.state==="CANCELLED")&&t`<${T} label="Delete" ask="Delete this export and its files?" run=${n} danger />`}
  </section>`}function ct({id:e}){let[o,n]=$(!1);return t`<details onToggle=${s=>n(s.target.open)}><summary>Files</summary>
    ${o&&t`<${pt} id=${e} />`}</details>`}var $e=200;function pt({id:e}){let o=m(n=>g(`v1/exports/${e}`,n),`export ${e}`,!1);return t`<${h} of=${o}>${({files:n})=>t`<${pe} files=${n.slice(0,$e)} label="Files of the export" />
    ${n.length>$e&&t`<p class="muted">The first ${$e} of ${l(n.length)} files. All of them come with <code>mrasfm-client download ${e} --out DIR</code>.</p>`}`}<//>`}function je(){let e=m(o=>C("v1/scenes",o),"scenes");return t`<${y} title="Scenes" /><${h} of=${e}>${o=>o.length===0?t`<${u}>No scene yet. A reconstruction makes a scene of a <a href=${d("drives")}>drive</a>.<//>`:t`<${ce} scenes=${o} />`}<//>`}var $t=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"calibration",label:"Calibration"},{name:"files",label:"Files"}];function Oe({id:e,tab:o}){let n=m(a=>g(`v1/scenes/${e}`,a),e,!1),s=n.value,r=async()=>{await v("DELETE",`v1/scenes/${e}`),R("scenes")};return t`<${y} title=${s?.name??"Scene"} kind="Scene">
      ${s&&L(s,"report.html")&&t`<a class="button" href=${M(`v1/scenes/${e}`,"report.html")} download>Download the report</a>`}
      ${J.value?.session_expires_at&&t`<${T} label="Delete" ask="Delete this scene and its files?" run=${r} danger />`}
    <//>
    <${Y} base=${["scenes",e]} tabs=${$t} current=${o} />
    <${h} of=${n}>${a=>mt(a,o)}<//>`}function L(e,o){return e.files.some(n=>n.path===o)}function mt(e,o){let n=`v1/scenes/${e.id}`;return o==="3d"?L(e,"view.json")?t`<${O} load=${()=>import("./page-WVTH7G2T.js")} name="Viewer" of=${{base:n,driveOf:{[e.name]:e.drive_id},onlyDrive:e.drive_id}} />`:t`<${u}>This scene has no view.json: it was made by an older version, or its points could not be written. Reconstruct it again.<//>`:o==="place"?L(e,"view.json")?e.summary.georeferenced?t`<${O} load=${()=>import("./page-XEOQFXPV.js")} name="Place" of=${{base:n}} />`:t`<${u}>This scene has no place on the earth: its drive has no GNSS that could be used.<//>`:t`<${u}>This scene has no view.json: it was made by an older version. Reconstruct it again.<//>`:o==="calibration"?t`<${O} load=${()=>import("./page-VMFO37A7.js")} name="CalibrationPage" of=${{base:n,driveId:e.drive_id,hasPictures:L(e,"pictures/birds_eye_before.png")}} />`:o==="files"?t`<${Z} files=${e.files} /><${ee} base=${n} components=${e.summary.components??[]} />`:t`<${ut} scene=${e} />`}function ut({scene:e}){let o=`v1/scenes/${e.id}`,n=m(r=>g(M(o,"report.json"),r),`report ${e.id}`,!1),{summary:s}=e;return t`<dl class="tiles">
      <${i} label="Units registered">${l(s.registered_units)} of ${l(s.units)}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Place on the earth">${s.georeferenced?"by GNSS":"none"}<//>
      <${i} label="Warnings">${s.warnings}<//>
      <${i} label="Made"><${f} at=${e.created_at} /><//>
    </dl>
    <p><a href=${d("drives",e.drive_id)}>The drive</a> · <a href=${d("jobs",e.job_id)}>the job</a> · engine ${s.engine_version}</p>
    <${h} of=${n}>${r=>t`<${me} report=${r} />`}<//>
    ${(s.components??[]).length>1&&t`<h2>Components</h2><p>Nothing links some parts of this drive with the rest: each is a scene of its own.</p>
      <ul>${(s.components??[]).map(r=>t`<li>Component ${r.component} in <code>${r.folder}</code>: ${l(r.registered_units)} units, ${l(r.points)} points</li>`)}</ul>`}
    ${L(e,"pictures/road_before.png")&&t`<h2>Points of the road</h2>
      <${X} before=${M(o,"pictures/road_before.png")} after=${M(o,"pictures/road_after.png")} label="Before and after points off its surface were dropped" />`}`}function me({report:e}){let o=e.summary.mean_reprojection_error_px;return t`<h2>Findings</h2>
    ${(e.findings??[]).length===0?t`<p>None.</p>`:t`<${K} findings=${e.findings} />`}
    ${typeof o=="number"&&t`<p>Mean reprojection error <span data-exact=${o}>${q(o,3)} px</span>.</p>`}
    <h2>Time by stage</h2>
    <${ht} stages=${e.stages} />`}function ht({stages:e}){let o=Math.max(...e.map(n=>n.seconds),1e-9);return t`<table class="bars"><thead class="hidden"><tr><th scope="col">Stage</th><th scope="col">Share</th><th scope="col">Time</th></tr></thead><tbody>${e.map(n=>t`<tr><th scope="row">${n.stage.replaceAll("-"," ")}</th>
      <td><progress max=${o} value=${n.seconds} aria-label=${`time of ${n.stage}`}></progress></td>
      <td class="number">${H(n.seconds)}${n.reused?" (reused)":""}</td></tr>`)}</tbody></table>`}function Fe(){let e=m(o=>C("v1/maps",o),"maps");return t`<${y} title="Maps" /><${h} of=${e}>${o=>o.length===0?t`<${u}>No map yet. Choose two or more <a href=${d("drives")}>drives</a> to make one.<//>`:t`<div class="scroll" tabindex="0" role="region" aria-label="Maps"><table>
          <thead><tr><th scope="col">Map</th><th scope="col" class="number">Version</th><th scope="col" class="number">Scenes connected</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col">Created</th></tr></thead>
          <tbody>${o.map(n=>t`<tr key=${n.id}><td><a href=${d("maps",n.id)}>${n.name}</a></td>${ft(n)}<td><${f} at=${n.created_at} /></td></tr>`)}</tbody></table></div>`}<//>`}function ft(e){let o=e.version?.summary;return o?t`<td class="number">${e.current_version}</td><td class="number">${o.connected} of ${o.scenes}</td><td class="number">${o.seams}</td><td class="number">${l(o.points)}</td>`:t`<td colspan="4" class="muted">${e.job_id?t`<a href=${d("jobs",e.job_id)}>being made</a>`:"no version yet"}</td>`}var bt=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"seams",label:"Seams"},{name:"calibration",label:"Calibration"},{name:"versions",label:"Versions"},{name:"files",label:"Files"}];function Le({id:e,tab:o}){let n=m(r=>g(`v1/maps/${e}`,r),e),s=n.value;return t`<${y} title=${s?.name??"Map"} kind="Map" />
    <${Y} base=${["maps",e]} tabs=${bt} current=${o} />
    <${h} of=${n}>${r=>o==="versions"?t`<${kt} map=${r} changed=${n.again} />`:r.version?t`<${gt} key=${r.version.number} map=${r} number=${r.version.number} tab=${o} />`:t`<${u}>This map has no version yet.${r.job_id&&t` <a href=${d("jobs",r.job_id)}>Its job</a>`}<//>`}<//>`}function gt({map:e,number:o,tab:n}){let s=`v1/maps/${e.id}/versions/${o}`,r=m(a=>g(s,a),s,!1);return t`<${h} of=${r}>${a=>vt(a,s,n)}<//>`}function vt(e,o,n){if(n==="files")return t`<${Z} files=${e.files} /><${ee} base=${o} />`;if(n==="seams")return t`<${wt} version=${e} base=${o} />`;if(n==="calibration"){let s=e.files.map(r=>r.path).filter(r=>/^calibration\/[^/]+\.json$/.test(r));return s.length===0?t`<${u}>This version has no calibration of its drives. Each scene has its own.<//>`:t`<${O} load=${()=>import("./page-VMFO37A7.js")} name="MapCalibration" of=${{base:o,files:s}} />`}if(n==="3d"){if(!L(e,"view.json"))return t`<${u}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;let s=Object.fromEntries(e.scenes.map(r=>[r.name,r.drive_id]));return t`<${O} load=${()=>import("./page-WVTH7G2T.js")} name="Viewer" of=${{base:o,driveOf:s}} />`}return n==="place"?L(e,"view.json")?e.summary.georeferenced?t`<${O} load=${()=>import("./page-XEOQFXPV.js")} name="Place" of=${{base:o}} />`:t`<${u}>This map has no place on the earth: none of its drives has GNSS that could be used.<//>`:t`<${u}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`:t`<${yt} version=${e} base=${o} />`}function yt({version:e,base:o}){let n=m(r=>g(M(o,"report.json"),r),`report ${o}`,!1),{summary:s}=e;return t`${L(e,"report.html")&&t`<p><a class="button" href=${M(o,"report.html")} download>Download the report</a></p>`}
    <dl class="tiles">
      <${i} label="Version">${e.number}<//>
      <${i} label="Scenes connected">${s.connected} of ${s.scenes}<//>
      <${i} label="Seams">${s.seams}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Made"><${f} at=${e.created_at} /><//>
    </dl>
    <h2>Scenes</h2><${St} version=${e} />
    ${e.failed.length>0&&t`<h2>Drives without a scene</h2>${e.failed.map(r=>t`<p><a href=${d("drives",r.drive_id)}>${r.name}</a></p><${S} problem=${r.problem} />`)}`}
    <${h} of=${n}>${r=>t`<${me} report=${r} />`}<//>`}function St({version:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes of the map"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col">Connected</th><th scope="col">Drive</th></tr></thead>
    <tbody>${e.scenes.map(o=>t`<tr><td><a href=${d("scenes",o.scene_id)}>${o.name}</a></td>
        <td>${o.connected?t`<span class="badge good">connected</span>`:t`<span class="badge warn">placed by positions only</span>`}</td>
        <td><a href=${d("drives",o.drive_id)}><code>${o.drive_id}</code></a></td></tr>`)}</tbody></table></div>`}function wt({version:e,base:o}){let n=m(s=>g(M(o,"map.json"),s),`map ${o}`,!1);return t`<${h} of=${n}>${s=>t`
    ${s.seams.length===0&&t`<${u}>No two scenes of this map were close enough to look for a seam.<//>`}
    ${s.seams.map(r=>t`<${_t} seam=${r} base=${o} version=${e} />`)}
    ${e.unconnected.length>0&&t`<h2>Not connected</h2><p>No seam in use connects these scenes with the others; positions place them: ${e.unconnected.join(", ")}.</p>`}`}<//>`}function _t({seam:e,base:o}){let n=`${e.a} – ${e.b}`,s=(r,a,p)=>a===void 0?null:t`<${i} label=${r}><span data-exact=${a}>${q(a,3)} ${p}</span><//>`;return t`<section class="box"><h2>${n}</h2>
    <p>${e.accepted?t`<span class="badge good">accepted</span>`:t`<span class="badge warn">rejected</span> ${e.reason??"the evidence does not suffice"}`}</p>
    <dl class="tiles">
      ${e.units_tried!==void 0&&t`<${i} label="Units that agree">${e.units_agreeing??0} of ${e.units_tried}<//>`}
      ${e.inliers!==void 0&&t`<${i} label="Shared points">${l(e.inliers)}<//>`}
      ${s("Residual before",e.residual_before_px,"px")}
      ${s("Residual after",e.residual_after_px,"px")}
      ${s("Sigma of the translation before the last adjustment",e.sigma_translation_m,"m")}
      ${s("Sigma of the rotation before the last adjustment",e.sigma_rotation_deg,"deg")}
      ${e.scale!==void 0&&t`<${i} label="Difference of scale"><span data-exact=${e.scale}>${q(100*(e.scale-1),3)} %</span><//>`}
    </dl>
    ${e.pictures?t`<${X} before=${M(o,e.pictures.before)} after=${M(o,e.pictures.after)} label="Points of both scenes from above" />`:t`<p class="muted">${e.accepted?"There are no pictures: they were switched off.":"There are no pictures, because the seam is not used."}</p>`}
  </section>`}function kt({map:e,changed:o}){let n=m(s=>C(`v1/maps/${e.id}/versions`,s),`versions ${e.id} ${e.current_version}`);return t`<${h} of=${n}>${s=>s.length===0?t`<${u}>No version yet.<//>`:t`<${xt} map=${e} versions=${s} loaded=${n} changed=${o} />`}<//>`}function xt({map:e,versions:o,changed:n}){let s=o.map(b=>b.number),[r,a]=$(s[1]??s[0]),[p,E]=$(s[0]),_=async b=>{await v("PUT",`v1/maps/${e.id}/current-version`,{json:{version:b}}),n()},c=(b,U,ne)=>t`<label>${b}
    <select value=${U} onChange=${I=>ne(Number(I.target.value))}>
      ${s.map(I=>t`<option value=${I} selected=${I===U}>Version ${I}</option>`)}</select></label>`,[k,V]=[o.find(b=>b.number===r),o.find(b=>b.number===p)];return t`<div class="scroll" tabindex="0" role="region" aria-label="Versions"><table>
      <thead><tr><th scope="col" class="number">Version</th><th scope="col">Made</th><th scope="col" class="number">Scenes</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col"></th></tr></thead>
      <tbody>${o.map(b=>t`<tr key=${b.number}><td class="number">${b.number}</td><td><${f} at=${b.created_at} /></td>
          <td class="number">${b.summary.scenes}</td><td class="number">${b.summary.seams}</td><td class="number">${l(b.summary.points)}</td>
          <td>${b.is_current?t`<${x} state="current" />`:t`<${T} label="Make it current" ask=${`Show version ${b.number}?`} run=${()=>_(b.number)} />`}</td></tr>`)}</tbody></table></div>
    <h2>Compare</h2>
    ${s.length<2?t`<p class="muted">There is one version only. An aggregation into this map makes the next.</p>`:t`<div class="inline">${c("From",r,a)} ${c("To",p,E)}</div>${k&&V&&t`<${Pt} a=${k} b=${V} />`}`}`}var Et=["scenes","connected","seams","registered_units","registered_images","points","warnings"];function Pt({a:e,b:o}){let n=c=>new Map(c.scenes.map(k=>[k.name,k.connected])),[s,r]=[n(e),n(o)],a=[...r.keys()].filter(c=>!s.has(c)),p=[...s.keys()].filter(c=>!r.has(c)),E=[...r].filter(([c,k])=>s.has(c)&&s.get(c)!==k),_=c=>c>0?`+${l(c)}`:c<0?`−${l(-c)}`:"same";return t`<table><thead><tr><th scope="col">Figure</th><th scope="col" class="number">Version ${e.number}</th><th scope="col" class="number">Version ${o.number}</th><th scope="col" class="number">Change</th></tr></thead>
      <tbody>${Et.map(c=>t`<tr><th scope="row">${c.replaceAll("_"," ")}</th><td class="number">${l(e.summary[c])}</td><td class="number">${l(o.summary[c])}</td><td class="number">${_(o.summary[c]-e.summary[c])}</td></tr>`)}</tbody></table>
    <ul>
      <li>Scenes added: ${a.join(", ")||"none"}</li>
      <li>Scenes removed: ${p.join(", ")||"none"}</li>
      <li>Connection changed: ${E.map(([c,k])=>`${c} (${k?"connected now":"not connected any more"})`).join(", ")||"none"}</li>
    </ul>`}var Ct=5e3;function Re(){let e=m(o=>g("v1/status",o),"status");return A(()=>{let o=setInterval(()=>document.hidden||e.again(),Ct);return()=>clearInterval(o)},[]),t`<${y} title="Status" /><${h} of=${e}>${o=>t`<${Tt} status=${o} />`}<//>`}function Tt({status:e}){let[o,n]=[e.workers.filter(r=>r.online),e.workers.filter(r=>!r.online)],s=1-e.disk.free_bytes/e.disk.total_bytes;return t`<p><${x} state=${e.status} /> Version ${e.version}</p>
    ${e.reasons.length>0&&t`<ul class="findings">${e.reasons.map(r=>t`<li class="warn">${r}</li>`)}</ul>`}
    <dl class="tiles">
      <${i} label="Jobs that wait">${l(e.queue.queued)}<//>
      <${i} label="Jobs that run">${l(e.queue.running)}<//>
      <${i} label="Stalled jobs">${l(e.queue.stalled)}<//>
      <${i} label="Longest wait">${e.queue.longest_wait_seconds>0?H(e.queue.longest_wait_seconds):"none"}<//>
      <${i} label="Broker">${e.broker?"answers":"does not answer"}<//>
      <${i} label="Reconciler">${e.reconciler?"runs":"does not run"}<//>
      <${i} label="Disk">${P(e.disk.free_bytes)} free of ${P(e.disk.total_bytes)}
        <progress max="1" value=${s} aria-label="disk in use"></progress><//>
      <${i} label="Uploads">${e.disk.accepts_uploads?"are taken":"are refused: the disk is full"}<//>
    </dl>
    <h2>Workers</h2>
    ${o.length===0?t`<${u}>No worker is online. Jobs are accepted and wait.<//>`:t`<${Ne} workers=${o} label="Workers" />`}
    ${n.length>0&&t`<details class="box"><summary>${j(n.length,"worker")} that have been silent since</summary><${Ne} workers=${n} label="Silent workers" /></details>`}
    <p><a href="docs">Description of the API</a></p>`}function Ne({workers:e,label:o}){return t`<div class="scroll" tabindex="0" role="region" aria-label=${o}><table>
    <thead><tr><th scope="col">Worker</th><th scope="col">Online</th><th scope="col">Queues</th><th scope="col" class="number">Jobs at one time</th><th scope="col">Last report</th></tr></thead>
    <tbody>${e.map(n=>t`<tr><td><code>${n.name}</code></td><td><span class=${`badge ${n.online?"good":"plain"}`}>${n.online?"online":"offline"}</span></td>
        <td>${n.queues.join(", ")}</td><td class="number">${n.concurrency}</td><td><${f} at=${n.seen_at} /></td></tr>`)}</tbody></table></div>`}function Ie(){let e=m(o=>g("v1/session",o),"session");return t`<${y} title="Key and project" /><${h} of=${e}>${o=>t`
    <dl class="tiles">
      <${i} label="Project">${o.project}<//>
      <${i} label="Key">${o.key_name}<//>
      <${i} label="Key made"><${f} at=${o.key_created_at} /><//>
      <${i} label="Session ends"><${f} at=${o.session_expires_at} /><//>
      <${i} label="Stored">${P(o.used_bytes)} of ${P(o.max_bytes)}
        <progress max=${o.max_bytes} value=${o.used_bytes} aria-label="storage in use"></progress><//>
      <${i} label="Active jobs">at most ${l(o.max_active_jobs)}<//>
      <${i} label="Drives">at most ${l(o.max_drives)}<//>
    </dl>
    <p class="muted small"><code>${o.key_id}</code></p>
    <h2>More keys</h2>
    <p>Keys are made and revoked on the service's machine. A revoked key ends its sessions within seconds.</p>
    <pre tabindex="0">mrasfm keys create --name NAME
mrasfm keys revoke ${o.key_id}</pre>`}<//>
    <p><a href=${d("status")}>Status of the service</a></p>`}async function Ae(){await v("DELETE","v1/session"),B(null)}var Je=[["drives","Drives"],["jobs","Jobs"],["scenes","Scenes"],["maps","Maps"],["status","Status"],["keys","Key"]],Mt={connecting:"connecting …",live:"live",polling:"polling",offline:"offline, tries again"},Dt=3e3,jt=/^\w[\w.-]*$/,Ot={title:"There is no such page",detail:"The address names no page of the console.",remedy:"Check the end of the address, or choose a page above."},oe=fe(null);function Ft(e){let[o="drives",n,s=""]=e;return o!=="upload"&&!Je.some(([r])=>r===o)||n!==void 0&&!jt.test(n)?t`<${y} title="No such page" /><${S} problem=${Ot} />`:o==="upload"?t`<${O} key="upload" load=${()=>import("./page-EINLTIDA.js")} name="UploadPage" of=${{}} />`:o==="jobs"?n?t`<${Pe} key=${n} id=${n} />`:t`<${Ee} />`:o==="scenes"?n?t`<${Oe} key=${`${n} ${s}`} id=${n} tab=${s} />`:t`<${je} />`:o==="maps"?n?t`<${Le} key=${`${n} ${s}`} id=${n} tab=${s} />`:t`<${Fe} />`:o==="status"?t`<${Re} />`:o==="keys"?t`<${Ie} />`:n?t`<${Te} key=${n} id=${n} />`:t`<${Ce} />`}function Lt(){let e=ke.value,[o,n]=$(null),s=e[0]==="upload"?"drives":e[0]??"drives";A(()=>{document.querySelector("main h1")?.focus({preventScroll:!0}),window.scrollTo(0,0)},[e.slice(0,2).join("/")]);let r=()=>{n(null),Ae().catch(a=>n({...D(a),title:"The session goes on",remedy:"Log out again once the service answers."}))};return t`<a class="skip" href="#main" onClick=${Nt}>Skip to the content</a>
    <header>
      <a class="brand" href=${d("drives")}>MRASfM</a>
      <nav aria-label="Pages">${Je.filter(([a])=>!te()||a==="scenes"||a==="maps").map(([a,p])=>t`<a href=${d(a)} aria-current=${s===a?"page":void 0}>${p}</a>`)}</nav>
      <div class="session">${!te()&&t`<span class=${`connection ${W.value}`} role="status" data-connection=${W.value}>${Mt[W.value]}</span>`}
        <span class="muted project">${J.value?.project}</span>
        ${!te()&&t`<button type="button" onClick=${r}>Log out</button>`}</div>
    </header>
    <main id="main">${o&&t`<${S} problem=${o} />`}${Ft(e)}</main>`}function Nt(e){e.preventDefault(),document.querySelector("main h1")?.focus()}function Rt(){let e=J.value,o=be(e);return A(()=>{if(o)return we(),_e},[o]),e===void 0?t`<main class="login">${oe.value?t`<${S} problem=${oe.value} />`:t`<p class="muted" aria-busy="true">Loading …</p>`}</main>`:e===null?t`<${Me} />`:t`<${Lt} key=${o} />`}function te(){return document.querySelector("meta[name=mrasfm-session]")?.getAttribute("content")==="open"}async function ue(){try{B(te()||ve()?await g("v1/session"):null),oe.value=null}catch(e){if(!(e instanceof ye&&Se(e)))return B(null);oe.value=D(e),setTimeout(()=>{ue()},Dt)}}he(t`<${Rt} />`,document.getElementById("app"));ge(()=>{ue()});ue();

import{a as W}from"./chunk-YRTGMMNF.js";import{A as d,B as O,C as m,D as I,E as T,F as q,G as u,H as v,I as p,J as S,K as G,L as Y,M as X,N as Z,O as i,P as h,Q as D,R as z,a as ae,b as g,c as R,e as J,f as ie,g as L,i as y,j as b,k as P,l as _,m as t,n as k,o as l,p as U,r as V,s as N,t as B,u as H,v as x,w as A,x as le,y as de,z as ce}from"./chunk-LFCE7I7Z.js";function j({load:e,name:o,of:s}){let[n,r]=g(null),[a,c]=g(null);return R(()=>{e().then(w=>r({show:w[o]}),w=>c(I(w)))},[]),a?t`<${T} problem=${a} />`:n?t`<${n.show} ...${s} />`:t`<p class="muted" aria-busy="true">Loading …</p>`}var ee=200,Me={active:"Not ended",failed:"Failed",all:"All"};function $e(){let[e,o]=g("all"),s=B.value,r=[...s?.values()??[]].sort((a,c)=>c.created_at.localeCompare(a.created_at)).filter(a=>e==="active"?!x(a):e==="failed"?a.state==="FAILED":!0);return t`<${v} title="Jobs">
      <div class="choice" role="group" aria-label="Jobs to show">
        ${Object.entries(Me).map(([a,c])=>t`<button type="button" aria-pressed=${e===a} onClick=${()=>o(a)}>${c}</button>`)}
      </div>
    <//>
    ${s===null&&t`<p class="muted" aria-busy="true">Loading …</p>`}
    ${s!==null&&r.length===0&&t`<${p}>${e==="all"?"No job yet. Upload a drive and start its reconstruction.":"No such job."}<//>`}
    ${r.length>0&&t`<${te} jobs=${r.slice(0,ee)} />`}
    ${r.length>ee&&t`<p class="muted">The newest ${ee} of ${r.length} jobs are shown.</p>`}`}function te({jobs:e}){let o=m(s=>P("v1/drives",s),"names of drives");return t`<div class="scroll" tabindex="0" role="region" aria-label="Jobs"><table>
    <thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col">Stage</th><th scope="col">Time left</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(s=>t`<tr key=${s.id}>
          <td><a href=${d("jobs",s.id)}>${Y[s.kind]}</a><div class="muted small">${Pe(s,o.value)}</div></td>
          <td><${S} state=${s.state} /></td>
          <td><${G} percent=${s.progress.percent} label="done" /></td>
          <td>${x(s)?"–":Z(s)}</td>
          <td class="number">${x(s)?"–":X(s)}</td>
          <td><${h} at=${s.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Pe(e,o){return e.members&&e.members.length>0?e.members.map(s=>s.name).join(", "):o?.find(s=>s.id===e.drive_id)?.name??e.drive_id??e.id}function pe({id:e}){let o=m(r=>b(`v1/jobs/${e}`,r),e),n=B.value?.get(e)??o.value;return n?t`<${v} title=${Y[n.kind]} kind="Job"><${De} job=${n} /><//>
    <div class="row"><${S} state=${n.state} />${n.cancel_requested&&!x(n)&&t`<span class="badge warn">stopping</span>`}
      <${G} percent=${n.progress.percent} label="done" /></div>
    <dl class="tiles" aria-live="polite">
      <${i} label=${x(n)?"Last stage":"Stage"}>${n.state==="SUCCEEDED"?"all done":Z(n)}<//>
      <${i} label=${x(n)?"Took":"Time left"}>${x(n)?Te(n):X(n)}<//>
      <${i} label="Created"><${h} at=${n.created_at} /><//>
      <${i} label="Started"><${h} at=${n.started_at} /><//>
      <${i} label="Heartbeat"><${h} at=${n.heartbeat_at} /><//>
    </dl>
    ${n.problem&&t`<${T} problem=${n.problem} />`}
    <${je} job=${n} />
    <${Ce} job=${n} />
    <${xe} job=${n} />
    <h2>Details</h2>
    <dl class="facts">
      <dt>Id</dt><dd><code>${n.id}</code></dd>
      ${n.drive_id&&t`<dt>Drive</dt><dd><a href=${d("drives",n.drive_id)}>${n.drive_id}</a></dd>`}
      ${n.parent_id&&t`<dt>Part of</dt><dd><a href=${d("jobs",n.parent_id)}>${n.parent_id}</a></dd>`}
      ${n.retry_of&&t`<dt>Repeats</dt><dd><a href=${d("jobs",n.retry_of)}>${n.retry_of}</a></dd>`}
      <dt>Reused stages</dt><dd>${n.progress.reused_stages?.join(", ")||"none"}</dd>
      <dt>Settings</dt><dd><pre tabindex="0">${JSON.stringify(n.settings,null,1)}</pre></dd>
    </dl>`:t`<${v} title="Job" /><${u} of=${o}>${()=>null}<//>`}function Te(e){return!e.finished_at||!e.started_at?"did not start":U((Date.parse(e.finished_at)-Date.parse(e.started_at))/1e3)}function De({job:e}){let o=async()=>{let r=await y("POST",`v1/jobs/${e.id}:cancel`);A(await r.json())},s=async()=>{let a=await(await y("POST",`v1/jobs/${e.id}:retry`)).json();A(a),O("jobs",a.id)},n=e.kind!=="SUBMAP"&&(e.state==="FAILED"||e.state==="CANCELLED");return t`${!x(e)&&!e.cancel_requested&&t`<${D} label="Cancel" ask="Cancel this job?" run=${o} danger />`}
  ${n&&t`<${D} label="Retry" ask="Do it again? Finished stages are reused." run=${s} />`}`}function je({job:e}){return e.scene_id?t`<p><a class="button primary" href=${d("scenes",e.scene_id)}>Open the scene</a></p>`:e.map_id&&e.map_version?t`<p><a class="button primary" href=${d("maps",e.map_id)}>Open the map</a></p>`:null}function Ce({job:e}){let o=(e.members??[]).map(r=>({label:r.name,state:r.scene_id?"SUCCEEDED":r.state,percent:r.percent,jobId:r.job_id,note:r.problem?r.problem.detail:r.job_id?"":"its scene was there"})),s=(e.submaps??[]).map(r=>({label:`Sub-map ${r.number}: units ${r.first_unit} to ${r.last_unit}`,state:r.state,percent:r.percent,jobId:r.job_id,note:r.problem?.detail??""})),n=[...o,...s];return n.length===0?null:t`<h2>${o.length>0?"Drives of this map":"Sub-maps"}</h2>
    <ul class="tree">
      ${n.map(r=>t`<li key=${r.label}>
          <span class="label">${r.jobId?t`<a href=${d("jobs",r.jobId)}>${r.label}</a>`:r.label}</span>
          ${r.state&&t`<${S} state=${r.state} />`}
          <${G} percent=${r.percent} label=${`${r.label} done`} />
          ${r.note&&t`<span class="muted small">${r.note}</span>`}
        </li>`)}
    </ul>`}function xe({job:e}){return e.attempts.length===0?null:t`<h2>Attempts</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Attempts"><table>
      <thead><tr><th scope="col" class="number">Attempt</th><th scope="col">Worker</th><th scope="col">Started</th><th scope="col">Finished</th><th scope="col">Outcome</th></tr></thead>
      <tbody>
        ${e.attempts.map(o=>t`<tr>
            <td class="number">${o.attempt}</td><td><code>${o.worker}</code></td>
            <td><${h} at=${o.started_at} /></td><td><${h} at=${o.finished_at} /></td>
            <td>${o.outcome??"runs"}${o.problem&&t`<div class="small">${o.problem.detail}</div>`}</td>
          </tr>`)}
      </tbody>
    </table></div>`}function me(){let e=m(r=>P("v1/drives",r),"drives"),[o,s]=g([]),n=(r,a)=>s(a?[...o,r]:o.filter(c=>c!==r));return t`<${v} title="Drives"><a class="button primary" href=${d("upload")}>Upload a drive</a><//>
    <${u} of=${e}>${r=>r.length===0?t`<${p}><p>No drive yet.</p><p>A drive is a folder with <code>drive.json</code> and its images.
            <a href=${d("upload")}>Upload one here</a>, or with <code>mrasfm upload FOLDER</code>.</p><//>`:t`${o.length>1&&t`<${Oe} drives=${r.filter(a=>o.includes(a.id))} />`}
            <${Ee} drives=${r} chosen=${o} choose=${n} />`}<//>`}function Ee({drives:e,chosen:o,choose:s}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Drives"><table>
    <thead><tr><th scope="col"><span class="hidden">Choose for a map</span></th><th scope="col">Drive</th><th scope="col">State</th><th scope="col">Check</th>
      <th scope="col" class="number">Cameras</th><th scope="col" class="number">Frames</th><th scope="col" class="number">Files</th><th scope="col" class="number">Size</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(n=>t`<tr key=${n.id}>
          <td><input type="checkbox" aria-label=${`choose ${n.name} for a map`} disabled=${n.state!=="COMMITTED"}
            checked=${o.includes(n.id)} onChange=${r=>s(n.id,r.target.checked)} /></td>
          <td><a href=${d("drives",n.id)}>${n.name}</a>${n.vehicle&&t`<div class="muted small">${n.vehicle}</div>`}</td>
          <td><${S} state=${n.state} /></td>
          <td><${S} state=${n.preflight} /></td>
          <td class="number">${n.cameras}</td>
          <td class="number">${l(n.frames)}</td>
          <td class="number">${l(n.files_stored)} of ${l(n.files_expected)}</td>
          <td class="number">${k(n.bytes_stored)}</td>
          <td><${h} at=${n.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Oe({drives:e}){let[o,s]=g("map"),[n,r]=g(null),a=async c=>{c.preventDefault();try{let M=await(await y("POST","v1/aggregations",{json:{drives:e.map($=>$.id),name:o}})).json();A(M),O("jobs",M.id)}catch(w){r(I(w))}};return t`<form class="box inline" onSubmit=${c=>{a(c)}}>
    <label>Name of the map <input required maxlength="200" value=${o} onInput=${c=>s(c.target.value)} /></label>
    <button class="primary">Make a map of ${e.length} drives</button>
    ${n&&t`<${T} problem=${n} />`}
  </form>`}function ue({id:e}){let o=m(n=>b(`v1/drives/${e}`,n),e),s=o.value;return t`<${v} title=${s?.name??"Drive"} kind="Drive">${s&&t`<${Le} drive=${s} />`}<//>
    <${u} of=${o}>${n=>t`<${Re} drive=${n} />`}<//>
    ${s&&t`<${Ne} drive=${s} /><${Ae} drive=${s} /><${Ie} drive=${s} />`}`}function Re({drive:e}){return t`<dl class="tiles">
    <${i} label="State"><${S} state=${e.state} /><//>
    <${i} label="Files">${l(e.files_stored)} of ${l(e.files_expected)}<//>
    <${i} label="Size">${k(e.bytes_stored)}<//>
    <${i} label="Cameras">${e.cameras}<//>
    <${i} label="Frames">${l(e.frames)}<//>
    <${i} label="GNSS">${e.has_gnss?"yes":"no"}<//>
    <${i} label="Vehicle">${e.vehicle??"not named"}<//>
    <${i} label="Created"><${h} at=${e.created_at} /><//>
  </dl><p class="muted small"><code>${e.id}</code></p>`}function Le({drive:e}){let o=async()=>{let r=await(await y("POST","v1/reconstructions",{json:{drive_id:e.id}})).json();A(r),O("jobs",r.id)},s=async()=>{await y("DELETE",`v1/drives/${e.id}`),O("drives")};return t`${e.state==="COMMITTED"?t`<${D} label="Reconstruct" ask="Start a reconstruction?" run=${o} />`:t`<a class="button primary" href=${d("upload")}>Continue the upload</a>`}
    <${D} label="Delete" ask="Delete this drive and its images?" run=${s} danger />`}function Ne({drive:e}){let o=m(s=>b(`v1/drives/${e.id}/preflight`,s),`preflight ${e.id}`);return e.state!=="COMMITTED"?null:t`<h2>Check of the drive</h2>
    <${u} of=${o}>${s=>t`<p><${S} state=${s.state} /> ${s.findings.length===0?s.state==="PENDING"?"The images are being checked.":"No finding.":N(s.findings.length,"finding")}</p><${q} findings=${s.findings} />`}<//>`}function Ae({drive:e}){let o=m(s=>P(`v1/scenes?drive_id=${e.id}`,s),`scenes ${e.id}`);return t`<h2>Scenes</h2><${u} of=${o}>${s=>s.length===0?t`<${p}>No scene of this drive yet.<//>`:t`<${oe} scenes=${s} />`}<//>`}function oe({scenes:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col" class="number">Units registered</th><th scope="col" class="number">Images registered</th><th scope="col" class="number">Points</th><th scope="col">Georeferenced</th><th scope="col" class="number">Warnings</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(o=>t`<tr key=${o.id}>
          <td><a href=${d("scenes",o.id)}>${o.name}</a></td>
          <td class="number">${l(o.summary.registered_units)} of ${l(o.summary.units)}</td>
          <td class="number">${l(o.summary.registered_images)} of ${l(o.summary.images)}</td>
          <td class="number">${l(o.summary.points)}</td>
          <td>${o.summary.georeferenced?"yes":"no"}</td>
          <td class="number">${o.summary.warnings}</td>
          <td><${h} at=${o.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ie({drive:e}){let o=[...B.value?.values()??[]].filter(s=>s.drive_id===e.id);return o.sort((s,n)=>n.created_at.localeCompare(s.created_at)),t`<h2>Jobs</h2>${o.length===0?t`<${p}>No job of this drive yet.<//>`:t`<${te} jobs=${o} />`}`}function he(){let[e,o]=g(null),[s,n]=g(!1),r=async a=>{a.preventDefault();let c=a.currentTarget.elements.namedItem("key"),w=c.value.trim();n(!0),o(null);try{let M=await y("POST","v1/session",{headers:{Authorization:`Bearer ${w}`}});c.value="",L(await M.json())}catch(M){o(I(M))}n(!1)};return t`<main class="login" id="main">
    <h1>MRASfM</h1>
    <p>Maps from the cameras of vehicles.</p>
    <form method="post" onSubmit=${a=>{r(a)}}>
      <label for="key">API key</label>
      <input id="key" name="key" type="password" required autocomplete="off" spellcheck=${!1} autofocus placeholder="mrasfm_…" aria-describedby="key-help" />
      <p id="key-help" class="muted">The key is exchanged for a cookie that lasts 12 hours; it is not kept in the browser.
      An operator makes keys with <code>mrasfm keys create</code>.</p>
      <button class="primary" disabled=${s}>${s?"Logging in …":"Log in"}</button>
    </form>
    ${e&&t`<${T} problem=${e} />`}
  </main>`}var Fe=[[/^report\.html$/,"the report, for people: opens without the internet"],[/^report\.json$/,"findings, time and counts of every stage, uncertainty"],[/^points\.copc\.laz$/,"the points for GIS programs, cloud-optimised"],[/^points\.ply$/,"the points with colours, for any viewer"],[/^poses\.json$/,"poses of units and images with sigmas"],[/^poses\.tum$/,"poses of the vehicle"],[/^trajectory\.gpkg$/,"positions as a GeoPackage"],[/^calibration(\.json|\/)/,"every camera as given and as refined"],[/^frame\.json$/,"the coordinate frame and its place on the earth"],[/^view\.json$/,"trajectory and frusta for this console"],[/^features\.db$/,"keypoints and matches as a COLMAP database"],[/^model\//,"cameras, rig, images and points in COLMAP's format"],[/^rigs?\//,"the calibration for Kalibr, ROS and URDF"],[/^autoware\//,"the points for Autoware"],[/^pictures\/birds_eye_/,"the road from above, all cameras, before and after calibration"],[/^pictures\/road_(before|after)/,"points of the road, before and after those off its surface were dropped"],[/^pictures\/road\.tif$/,"the road from above as a GeoTIFF, the best view of each place"],[/^pictures\/road\.pgw$/,"the place of road.png on the earth (world file)"],[/^pictures\/road\.png$/,"the road from above, the best view of each place"],[/^pictures\/seam-/,"points of two scenes at their seam, before and after"],[/^pictures\//,"a picture"],[/^road\.json$/,"the surface of the road"],[/^map\.json$/,"scenes, seams and verdicts"],[/^manifest\.json$/,"the drive's manifest, in the engine's axes"],[/^(scenes|seams)\//,"data for the map's next version"]];function K({files:e}){let[o,s]=g(""),n=e.filter(a=>a.path.toLowerCase().includes(o.toLowerCase())),r=e.reduce((a,c)=>a+c.size_bytes,0);return t`<h2>Files</h2>
    <p class="muted">${N(e.length,"file")}, ${k(r)} together.</p>
    <label class="filter">Find a file <input type="search" value=${o} onInput=${a=>s(a.target.value)} /></label>
    ${n.length===0?t`<${p}>No file of this name.<//>`:t`<div class="scroll" tabindex="0" role="region" aria-label="Files"><table>
          <thead><tr><th scope="col">File</th><th scope="col" class="number">Size</th><th scope="col">Content</th></tr></thead>
          <tbody>${n.map(a=>t`<tr key=${a.path}><td><a href=${a.url.replace(/^\//,"")} download>${a.path}</a></td>
              <td class="number">${k(a.size_bytes)}</td><td>${Fe.find(([c])=>c.test(a.path))?.[1]??""}</td></tr>`)}</tbody></table></div>`}`}function fe(){let e=m(o=>P("v1/scenes",o),"scenes");return t`<${v} title="Scenes" /><${u} of=${e}>${o=>o.length===0?t`<${p}>No scene yet. A reconstruction makes a scene of a <a href=${d("drives")}>drive</a>.<//>`:t`<${oe} scenes=${o} />`}<//>`}var Je=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"calibration",label:"Calibration"},{name:"files",label:"Files"}];function be({id:e,tab:o}){let s=m(a=>b(`v1/scenes/${e}`,a),e,!1),n=s.value,r=async()=>{await y("DELETE",`v1/scenes/${e}`),O("scenes")};return t`<${v} title=${n?.name??"Scene"} kind="Scene">
      ${n&&E(n,"report.html")&&t`<a class="button" href=${_(`v1/scenes/${e}`,"report.html")} download>Download the report</a>`}
      ${J.value?.session_expires_at&&t`<${D} label="Delete" ask="Delete this scene and its files?" run=${r} danger />`}
    <//>
    <${z} base=${["scenes",e]} tabs=${Je} current=${o} />
    <${u} of=${s}>${a=>Ve(a,o)}<//>`}function E(e,o){return e.files.some(s=>s.path===o)}function Ve(e,o){let s=`v1/scenes/${e.id}`;return o==="3d"?E(e,"view.json")?t`<${j} load=${()=>import("./page-PBISHZHE.js")} name="Viewer" of=${{base:s,driveOf:{[e.name]:e.drive_id},onlyDrive:e.drive_id}} />`:t`<${p}>This scene has no view.json: it was made by an older version, or its points could not be written. Reconstruct it again.<//>`:o==="place"?E(e,"view.json")?e.summary.georeferenced?t`<${j} load=${()=>import("./page-P3AXOXWC.js")} name="Place" of=${{base:s}} />`:t`<${p}>This scene has no place on the earth: its drive has no GNSS that could be used.<//>`:t`<${p}>This scene has no view.json: it was made by an older version. Reconstruct it again.<//>`:o==="calibration"?t`<${j} load=${()=>import("./page-X33Q2JZB.js")} name="CalibrationPage" of=${{base:s,driveId:e.drive_id,hasPictures:E(e,"pictures/birds_eye_before.png")}} />`:o==="files"?t`<${K} files=${e.files} />`:t`<${Be} scene=${e} />`}function Be({scene:e}){let o=`v1/scenes/${e.id}`,s=m(r=>b(_(o,"report.json"),r),`report ${e.id}`,!1),{summary:n}=e;return t`<dl class="tiles">
      <${i} label="Units registered">${l(n.registered_units)} of ${l(n.units)}<//>
      <${i} label="Images registered">${l(n.registered_images)} of ${l(n.images)}<//>
      <${i} label="Points">${l(n.points)}<//>
      <${i} label="Place on the earth">${n.georeferenced?"by GNSS":"none"}<//>
      <${i} label="Warnings">${n.warnings}<//>
      <${i} label="Made"><${h} at=${e.created_at} /><//>
    </dl>
    <p><a href=${d("drives",e.drive_id)}>The drive</a> · <a href=${d("jobs",e.job_id)}>the job</a> · engine ${n.engine_version}</p>
    <${u} of=${s}>${r=>t`<${se} report=${r} />`}<//>
    ${(n.components??[]).length>1&&t`<h2>Components</h2><p>Nothing links some parts of this drive with the rest: each is a scene of its own.</p>
      <ul>${(n.components??[]).map(r=>t`<li>Component ${r.component} in <code>${r.folder}</code>: ${l(r.registered_units)} units, ${l(r.points)} points</li>`)}</ul>`}
    ${E(e,"pictures/road_before.png")&&t`<h2>Points of the road</h2>
      <${W} before=${_(o,"pictures/road_before.png")} after=${_(o,"pictures/road_after.png")} label="Before and after points off its surface were dropped" />`}`}function se({report:e}){let o=e.summary.mean_reprojection_error_px;return t`<h2>Findings</h2>
    ${(e.findings??[]).length===0?t`<p>None.</p>`:t`<${q} findings=${e.findings} />`}
    ${typeof o=="number"&&t`<p>Mean reprojection error <span data-exact=${o}>${V(o,3)} px</span>.</p>`}
    <h2>Time by stage</h2>
    <${Ue} stages=${e.stages} />`}function Ue({stages:e}){let o=Math.max(...e.map(s=>s.seconds),1e-9);return t`<table class="bars"><thead class="hidden"><tr><th scope="col">Stage</th><th scope="col">Share</th><th scope="col">Time</th></tr></thead><tbody>${e.map(s=>t`<tr><th scope="row">${s.stage.replaceAll("-"," ")}</th>
      <td><progress max=${o} value=${s.seconds} aria-label=${`time of ${s.stage}`}></progress></td>
      <td class="number">${U(s.seconds)}${s.reused?" (reused)":""}</td></tr>`)}</tbody></table>`}function ge(){let e=m(o=>P("v1/maps",o),"maps");return t`<${v} title="Maps" /><${u} of=${e}>${o=>o.length===0?t`<${p}>No map yet. Choose two or more <a href=${d("drives")}>drives</a> to make one.<//>`:t`<div class="scroll" tabindex="0" role="region" aria-label="Maps"><table>
          <thead><tr><th scope="col">Map</th><th scope="col" class="number">Version</th><th scope="col" class="number">Scenes connected</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col">Created</th></tr></thead>
          <tbody>${o.map(s=>t`<tr key=${s.id}><td><a href=${d("maps",s.id)}>${s.name}</a></td>${He(s)}<td><${h} at=${s.created_at} /></td></tr>`)}</tbody></table></div>`}<//>`}function He(e){let o=e.version?.summary;return o?t`<td class="number">${e.current_version}</td><td class="number">${o.connected} of ${o.scenes}</td><td class="number">${o.seams}</td><td class="number">${l(o.points)}</td>`:t`<td colspan="4" class="muted">${e.job_id?t`<a href=${d("jobs",e.job_id)}>being made</a>`:"no version yet"}</td>`}var qe=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"seams",label:"Seams"},{name:"calibration",label:"Calibration"},{name:"versions",label:"Versions"},{name:"files",label:"Files"}];function ve({id:e,tab:o}){let s=m(r=>b(`v1/maps/${e}`,r),e),n=s.value;return t`<${v} title=${n?.name??"Map"} kind="Map" />
    <${z} base=${["maps",e]} tabs=${qe} current=${o} />
    <${u} of=${s}>${r=>o==="versions"?t`<${Xe} map=${r} changed=${s.again} />`:r.version?t`<${Ge} key=${r.version.number} map=${r} number=${r.version.number} tab=${o} />`:t`<${p}>This map has no version yet.${r.job_id&&t` <a href=${d("jobs",r.job_id)}>Its job</a>`}<//>`}<//>`}function Ge({map:e,number:o,tab:s}){let n=`v1/maps/${e.id}/versions/${o}`,r=m(a=>b(n,a),n,!1);return t`<${u} of=${r}>${a=>ze(a,n,s)}<//>`}function ze(e,o,s){if(s==="files")return t`<${K} files=${e.files} />`;if(s==="seams")return t`<${Qe} version=${e} base=${o} />`;if(s==="calibration"){let n=e.files.map(r=>r.path).filter(r=>/^calibration\/[^/]+\.json$/.test(r));return n.length===0?t`<${p}>This version has no calibration of its drives. Each scene has its own.<//>`:t`<${j} load=${()=>import("./page-X33Q2JZB.js")} name="MapCalibration" of=${{base:o,files:n}} />`}if(s==="3d"){if(!E(e,"view.json"))return t`<${p}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;let n=Object.fromEntries(e.scenes.map(r=>[r.name,r.drive_id]));return t`<${j} load=${()=>import("./page-PBISHZHE.js")} name="Viewer" of=${{base:o,driveOf:n}} />`}return s==="place"?E(e,"view.json")?e.summary.georeferenced?t`<${j} load=${()=>import("./page-P3AXOXWC.js")} name="Place" of=${{base:o}} />`:t`<${p}>This map has no place on the earth: none of its drives has GNSS that could be used.<//>`:t`<${p}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`:t`<${We} version=${e} base=${o} />`}function We({version:e,base:o}){let s=m(r=>b(_(o,"report.json"),r),`report ${o}`,!1),{summary:n}=e;return t`${E(e,"report.html")&&t`<p><a class="button" href=${_(o,"report.html")} download>Download the report</a></p>`}
    <dl class="tiles">
      <${i} label="Version">${e.number}<//>
      <${i} label="Scenes connected">${n.connected} of ${n.scenes}<//>
      <${i} label="Seams">${n.seams}<//>
      <${i} label="Images registered">${l(n.registered_images)} of ${l(n.images)}<//>
      <${i} label="Points">${l(n.points)}<//>
      <${i} label="Made"><${h} at=${e.created_at} /><//>
    </dl>
    <h2>Scenes</h2><${Ke} version=${e} />
    ${e.failed.length>0&&t`<h2>Drives without a scene</h2>${e.failed.map(r=>t`<p><a href=${d("drives",r.drive_id)}>${r.name}</a></p><${T} problem=${r.problem} />`)}`}
    <${u} of=${s}>${r=>t`<${se} report=${r} />`}<//>`}function Ke({version:e}){return t`<div class="scroll" tabindex="0" role="region" aria-label="Scenes of the map"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col">Connected</th><th scope="col">Drive</th></tr></thead>
    <tbody>${e.scenes.map(o=>t`<tr><td><a href=${d("scenes",o.scene_id)}>${o.name}</a></td>
        <td>${o.connected?t`<span class="badge good">connected</span>`:t`<span class="badge warn">placed by positions only</span>`}</td>
        <td><a href=${d("drives",o.drive_id)}><code>${o.drive_id}</code></a></td></tr>`)}</tbody></table></div>`}function Qe({version:e,base:o}){let s=m(n=>b(_(o,"map.json"),n),`map ${o}`,!1);return t`<${u} of=${s}>${n=>t`
    ${n.seams.length===0&&t`<${p}>No two scenes of this map were close enough to look for a seam.<//>`}
    ${n.seams.map(r=>t`<${Ye} seam=${r} base=${o} version=${e} />`)}
    ${e.unconnected.length>0&&t`<h2>Not connected</h2><p>No seam in use connects these scenes with the others; positions place them: ${e.unconnected.join(", ")}.</p>`}`}<//>`}function Ye({seam:e,base:o}){let s=`${e.a} – ${e.b}`,n=(r,a,c)=>a===void 0?null:t`<${i} label=${r}><span data-exact=${a}>${V(a,3)} ${c}</span><//>`;return t`<section class="box"><h2>${s}</h2>
    <p>${e.accepted?t`<span class="badge good">accepted</span>`:t`<span class="badge warn">rejected</span> ${e.reason??"the evidence does not suffice"}`}</p>
    <dl class="tiles">
      ${e.units_tried!==void 0&&t`<${i} label="Units that agree">${e.units_agreeing??0} of ${e.units_tried}<//>`}
      ${e.inliers!==void 0&&t`<${i} label="Shared points">${l(e.inliers)}<//>`}
      ${n("Residual before",e.residual_before_px,"px")}
      ${n("Residual after",e.residual_after_px,"px")}
      ${n("Sigma of the translation",e.sigma_translation_m,"m")}
      ${n("Sigma of the rotation",e.sigma_rotation_deg,"deg")}
      ${e.scale!==void 0&&t`<${i} label="Difference of scale"><span data-exact=${e.scale}>${V(100*(e.scale-1),3)} %</span><//>`}
    </dl>
    ${e.pictures?t`<${W} before=${_(o,e.pictures.before)} after=${_(o,e.pictures.after)} label="Points of both scenes from above" />`:t`<p class="muted">${e.accepted?"There are no pictures: they were switched off.":"There are no pictures, because the seam is not used."}</p>`}
  </section>`}function Xe({map:e,changed:o}){let s=m(n=>P(`v1/maps/${e.id}/versions`,n),`versions ${e.id} ${e.current_version}`);return t`<${u} of=${s}>${n=>n.length===0?t`<${p}>No version yet.<//>`:t`<${Ze} map=${e} versions=${n} loaded=${s} changed=${o} />`}<//>`}function Ze({map:e,versions:o,changed:s}){let n=o.map(f=>f.number),[r,a]=g(n[1]??n[0]),[c,w]=g(n[0]),M=async f=>{await y("PUT",`v1/maps/${e.id}/current-version`,{json:{version:f}}),s()},$=(f,re,ke)=>t`<label>${f}
    <select value=${re} onChange=${F=>ke(Number(F.target.value))}>
      ${n.map(F=>t`<option value=${F} selected=${F===re}>Version ${F}</option>`)}</select></label>`,[C,ne]=[o.find(f=>f.number===r),o.find(f=>f.number===c)];return t`<div class="scroll" tabindex="0" role="region" aria-label="Versions"><table>
      <thead><tr><th scope="col" class="number">Version</th><th scope="col">Made</th><th scope="col" class="number">Scenes</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col"></th></tr></thead>
      <tbody>${o.map(f=>t`<tr key=${f.number}><td class="number">${f.number}</td><td><${h} at=${f.created_at} /></td>
          <td class="number">${f.summary.scenes}</td><td class="number">${f.summary.seams}</td><td class="number">${l(f.summary.points)}</td>
          <td>${f.is_current?t`<${S} state="current" />`:t`<${D} label="Make it current" ask=${`Show version ${f.number}?`} run=${()=>M(f.number)} />`}</td></tr>`)}</tbody></table></div>
    <h2>Compare</h2>
    ${n.length<2?t`<p class="muted">There is one version only. An aggregation into this map makes the next.</p>`:t`<div class="inline">${$("From",r,a)} ${$("To",c,w)}</div>${C&&ne&&t`<${tt} a=${C} b=${ne} />`}`}`}var et=["scenes","connected","seams","registered_units","registered_images","points","warnings"];function tt({a:e,b:o}){let s=$=>new Map($.scenes.map(C=>[C.name,C.connected])),[n,r]=[s(e),s(o)],a=[...r.keys()].filter($=>!n.has($)),c=[...n.keys()].filter($=>!r.has($)),w=[...r].filter(([$,C])=>n.has($)&&n.get($)!==C),M=$=>$>0?`+${l($)}`:$<0?`−${l(-$)}`:"same";return t`<table><thead><tr><th scope="col">Figure</th><th scope="col" class="number">Version ${e.number}</th><th scope="col" class="number">Version ${o.number}</th><th scope="col" class="number">Change</th></tr></thead>
      <tbody>${et.map($=>t`<tr><th scope="row">${$.replaceAll("_"," ")}</th><td class="number">${l(e.summary[$])}</td><td class="number">${l(o.summary[$])}</td><td class="number">${M(o.summary[$]-e.summary[$])}</td></tr>`)}</tbody></table>
    <ul>
      <li>Scenes added: ${a.join(", ")||"none"}</li>
      <li>Scenes removed: ${c.join(", ")||"none"}</li>
      <li>Connection changed: ${w.map(([$,C])=>`${$} (${C?"connected now":"not connected any more"})`).join(", ")||"none"}</li>
    </ul>`}var ot=5e3;function Se(){let e=m(o=>b("v1/status",o),"status");return R(()=>{let o=setInterval(()=>document.hidden||e.again(),ot);return()=>clearInterval(o)},[]),t`<${v} title="Status" /><${u} of=${e}>${o=>t`<${st} status=${o} />`}<//>`}function st({status:e}){let[o,s]=[e.workers.filter(r=>r.online),e.workers.filter(r=>!r.online)],n=1-e.disk.free_bytes/e.disk.total_bytes;return t`<p><${S} state=${e.status} /> Version ${e.version}</p>
    ${e.reasons.length>0&&t`<ul class="findings">${e.reasons.map(r=>t`<li class="warn">${r}</li>`)}</ul>`}
    <dl class="tiles">
      <${i} label="Jobs that wait">${l(e.queue.queued)}<//>
      <${i} label="Jobs that run">${l(e.queue.running)}<//>
      <${i} label="Stalled jobs">${l(e.queue.stalled)}<//>
      <${i} label="Broker">${e.broker?"answers":"does not answer"}<//>
      <${i} label="Disk">${k(e.disk.free_bytes)} free of ${k(e.disk.total_bytes)}
        <progress max="1" value=${n} aria-label="disk in use"></progress><//>
      <${i} label="Uploads">${e.disk.accepts_uploads?"are taken":"are refused: the disk is full"}<//>
    </dl>
    <h2>Workers</h2>
    ${o.length===0?t`<${p}>No worker is online. Jobs are accepted and wait.<//>`:t`<${ye} workers=${o} label="Workers" />`}
    ${s.length>0&&t`<details class="box"><summary>${N(s.length,"worker")} that ended within the last day</summary><${ye} workers=${s} label="Workers that ended" /></details>`}
    <p><a href="docs">Description of the API</a></p>`}function ye({workers:e,label:o}){return t`<div class="scroll" tabindex="0" role="region" aria-label=${o}><table>
    <thead><tr><th scope="col">Worker</th><th scope="col">Online</th><th scope="col">Queues</th><th scope="col" class="number">Jobs at one time</th><th scope="col">Last report</th></tr></thead>
    <tbody>${e.map(s=>t`<tr><td><code>${s.name}</code></td><td><span class=${`badge ${s.online?"good":"plain"}`}>${s.online?"online":"offline"}</span></td>
        <td>${s.queues.join(", ")}</td><td class="number">${s.concurrency}</td><td><${h} at=${s.seen_at} /></td></tr>`)}</tbody></table></div>`}function we(){let e=m(o=>b("v1/session",o),"session");return t`<${v} title="Key and project" /><${u} of=${e}>${o=>t`
    <dl class="tiles">
      <${i} label="Project">${o.project}<//>
      <${i} label="Key">${o.key_name}<//>
      <${i} label="Key made"><${h} at=${o.key_created_at} /><//>
      <${i} label="Session ends"><${h} at=${o.session_expires_at} /><//>
      <${i} label="Stored">${k(o.used_bytes)} of ${k(o.max_bytes)}
        <progress max=${o.max_bytes} value=${o.used_bytes} aria-label="storage in use"></progress><//>
      <${i} label="Active jobs">at most ${l(o.max_active_jobs)}<//>
      <${i} label="Drives">at most ${l(o.max_drives)}<//>
    </dl>
    <p class="muted small"><code>${o.key_id}</code></p>
    <h2>More keys</h2>
    <p>Keys are made and revoked on the service's machine. A revoked key ends its sessions within seconds.</p>
    <pre tabindex="0">mrasfm keys create --name NAME
mrasfm keys revoke ${o.key_id}</pre>`}<//>
    <p><a href=${d("status")}>Status of the service</a></p>`}async function _e(){await fetch("v1/session",{method:"DELETE"}),L(null)}var nt=[["drives","Drives"],["jobs","Jobs"],["scenes","Scenes"],["maps","Maps"],["status","Status"],["keys","Key"]],rt={connecting:"connecting …",live:"live",polling:"polling",offline:"offline, tries again"};function at(e){let[o="drives",s,n=""]=e;return o==="upload"?t`<${j} key="upload" load=${()=>import("./page-NWOO2KDX.js")} name="UploadPage" of=${{}} />`:o==="jobs"?s?t`<${pe} key=${s} id=${s} />`:t`<${$e} />`:o==="scenes"?s?t`<${be} key=${`${s} ${n}`} id=${s} tab=${n} />`:t`<${fe} />`:o==="maps"?s?t`<${ve} key=${`${s} ${n}`} id=${s} tab=${n} />`:t`<${ge} />`:o==="status"?t`<${Se} />`:o==="keys"?t`<${we} />`:s?t`<${ue} key=${s} id=${s} />`:t`<${me} />`}function it(){let e=ce.value,o=e[0]==="upload"?"drives":e[0]??"drives";return R(()=>{document.querySelector("main h1")?.focus({preventScroll:!0}),window.scrollTo(0,0)},[e.slice(0,2).join("/")]),t`<a class="skip" href="#main" onClick=${lt}>Skip to the content</a>
    <header>
      <a class="brand" href=${d("drives")}>MRASfM</a>
      <nav aria-label="Pages">${nt.filter(([s])=>!Q()||s==="scenes"||s==="maps").map(([s,n])=>t`<a href=${d(s)} aria-current=${o===s?"page":void 0}>${n}</a>`)}</nav>
      <div class="session">${!Q()&&t`<span class=${`connection ${H.value}`} role="status" data-connection=${H.value}>${rt[H.value]}</span>`}
        <span class="muted project">${J.value?.project}</span>
        ${!Q()&&t`<button type="button" onClick=${()=>{_e()}}>Log out</button>`}</div>
    </header>
    <main id="main">${at(e)}</main>`}function lt(e){e.preventDefault(),document.querySelector("main h1")?.focus()}function dt(){let e=J.value,o=!!e;return R(()=>{o?le():de()},[o]),e===void 0?t`<main class="login"><p class="muted" aria-busy="true">Loading …</p></main>`:e===null?t`<${he} />`:t`<${it} />`}function Q(){return document.querySelector("meta[name=mrasfm-session]")?.getAttribute("content")==="open"}async function ct(){try{L(Q()||ie()?await b("v1/session"):null)}catch{L(null)}}ae(t`<${dt} />`,document.getElementById("app"));ct();

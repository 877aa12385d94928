import{a as G}from"./chunk-LAIYJAYL.js";import{A as d,B as E,C as m,D as A,E as P,F as H,G as u,H as v,I as p,J as S,K as q,L as Q,M as Y,N as X,O as i,P as h,Q as T,R as z,a as re,b as g,c as R,e as W,f as ae,g as L,i as y,j as b,k as C,l as M,m as o,n as _,o as l,p as F,r as V,s as B,t as J,u as U,v as D,w as N,x as ie,y as le,z as de}from"./chunk-MCIPENF6.js";function x({load:e,name:t,of:n}){let[s,r]=g(null),[a,c]=g(null);return R(()=>{e().then(w=>r({show:w[t]}),w=>c(A(w)))},[]),a?o`<${P} problem=${a} />`:s?o`<${s.show} ...${n} />`:o`<p class="muted" aria-busy="true">Loading …</p>`}var Z=200,_e={active:"Not ended",failed:"Failed",all:"All"};function ce(){let[e,t]=g("all"),n=J.value,r=[...n?.values()??[]].sort((a,c)=>c.created_at.localeCompare(a.created_at)).filter(a=>e==="active"?!D(a):e==="failed"?a.state==="FAILED":!0);return o`<${v} title="Jobs">
      <div class="choice" role="group" aria-label="Jobs to show">
        ${Object.entries(_e).map(([a,c])=>o`<button type="button" aria-pressed=${e===a} onClick=${()=>t(a)}>${c}</button>`)}
      </div>
    <//>
    ${n===null&&o`<p class="muted" aria-busy="true">Loading …</p>`}
    ${n!==null&&r.length===0&&o`<${p}>${e==="all"?"No job yet. Upload a drive and start its reconstruction.":"No such job."}<//>`}
    ${r.length>0&&o`<${ee} jobs=${r.slice(0,Z)} />`}
    ${r.length>Z&&o`<p class="muted">The newest ${Z} of ${r.length} jobs are shown.</p>`}`}function ee({jobs:e}){return o`<div class="scroll" tabindex="0" role="region" aria-label="Jobs"><table>
    <thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col">Stage</th><th scope="col">Time left</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(t=>o`<tr key=${t.id}>
          <td><a href=${d("jobs",t.id)}>${Q[t.kind]}</a><div class="muted small">${ke(t)}</div></td>
          <td><${S} state=${t.state} /></td>
          <td><${q} percent=${t.progress.percent} label="done" /></td>
          <td>${D(t)?"–":X(t)}</td>
          <td class="number">${D(t)?"–":Y(t)}</td>
          <td><${h} at=${t.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function ke(e){return e.members&&e.members.length>0?e.members.map(t=>t.name).join(", "):e.drive_id??e.id}function $e({id:e}){let t=m(r=>b(`v1/jobs/${e}`,r),e),s=J.value?.get(e)??t.value;return s?o`<${v} title=${Q[s.kind]} kind="Job"><${Pe} job=${s} /><//>
    <div class="row"><${S} state=${s.state} />${s.cancel_requested&&!D(s)&&o`<span class="badge warn">stopping</span>`}
      <${q} percent=${s.progress.percent} label="done" /></div>
    <dl class="tiles" aria-live="polite">
      <${i} label="Stage">${X(s)}<//>
      <${i} label=${D(s)?"Took":"Time left"}>${D(s)?Me(s):Y(s)}<//>
      <${i} label="Created"><${h} at=${s.created_at} /><//>
      <${i} label="Started"><${h} at=${s.started_at} /><//>
      <${i} label="Heartbeat"><${h} at=${s.heartbeat_at} /><//>
    </dl>
    ${s.problem&&o`<${P} problem=${s.problem} />`}
    <${Te} job=${s} />
    <${je} job=${s} />
    <${xe} job=${s} />
    <h2>Details</h2>
    <dl class="facts">
      <dt>Id</dt><dd><code>${s.id}</code></dd>
      ${s.drive_id&&o`<dt>Drive</dt><dd><a href=${d("drives",s.drive_id)}>${s.drive_id}</a></dd>`}
      ${s.parent_id&&o`<dt>Part of</dt><dd><a href=${d("jobs",s.parent_id)}>${s.parent_id}</a></dd>`}
      ${s.retry_of&&o`<dt>Repeats</dt><dd><a href=${d("jobs",s.retry_of)}>${s.retry_of}</a></dd>`}
      <dt>Reused stages</dt><dd>${s.progress.reused_stages?.join(", ")||"none"}</dd>
      <dt>Settings</dt><dd><pre tabindex="0">${JSON.stringify(s.settings,null,1)}</pre></dd>
    </dl>`:o`<${v} title="Job" /><${u} of=${t}>${()=>null}<//>`}function Me(e){return!e.finished_at||!e.started_at?"did not start":F((Date.parse(e.finished_at)-Date.parse(e.started_at))/1e3)}function Pe({job:e}){let t=async()=>{let r=await y("POST",`v1/jobs/${e.id}:cancel`);N(await r.json())},n=async()=>{let a=await(await y("POST",`v1/jobs/${e.id}:retry`)).json();N(a),E("jobs",a.id)},s=e.kind!=="SUBMAP"&&(e.state==="FAILED"||e.state==="CANCELLED");return o`${!D(e)&&!e.cancel_requested&&o`<${T} label="Cancel" ask="Cancel this job?" run=${t} danger />`}
  ${s&&o`<${T} label="Retry" ask="Do it again? Finished stages are reused." run=${n} />`}`}function Te({job:e}){return e.scene_id?o`<p><a class="button primary" href=${d("scenes",e.scene_id)}>Open the scene</a></p>`:e.map_id&&e.map_version?o`<p><a class="button primary" href=${d("maps",e.map_id)}>Open the map</a></p>`:null}function je({job:e}){let t=(e.members??[]).map(r=>({label:r.name,state:r.scene_id?"SUCCEEDED":r.state,percent:r.percent,jobId:r.job_id,note:r.problem?r.problem.detail:r.job_id?"":"its scene was there"})),n=(e.submaps??[]).map(r=>({label:`Sub-map ${r.number}: units ${r.first_unit} to ${r.last_unit}`,state:r.state,percent:r.percent,jobId:r.job_id,note:r.problem?.detail??""})),s=[...t,...n];return s.length===0?null:o`<h2>${t.length>0?"Drives of this map":"Sub-maps"}</h2>
    <ul class="tree">
      ${s.map(r=>o`<li key=${r.label}>
          <span class="label">${r.jobId?o`<a href=${d("jobs",r.jobId)}>${r.label}</a>`:r.label}</span>
          ${r.state&&o`<${S} state=${r.state} />`}
          <${q} percent=${r.percent} label=${`${r.label} done`} />
          ${r.note&&o`<span class="muted small">${r.note}</span>`}
        </li>`)}
    </ul>`}function xe({job:e}){return e.attempts.length===0?null:o`<h2>Attempts</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Attempts"><table>
      <thead><tr><th scope="col" class="number">Attempt</th><th scope="col">Worker</th><th scope="col">Started</th><th scope="col">Finished</th><th scope="col">Outcome</th></tr></thead>
      <tbody>
        ${e.attempts.map(t=>o`<tr>
            <td class="number">${t.attempt}</td><td><code>${t.worker}</code></td>
            <td><${h} at=${t.started_at} /></td><td><${h} at=${t.finished_at} /></td>
            <td>${t.outcome??"runs"}${t.problem&&o`<div class="small">${t.problem.detail}</div>`}</td>
          </tr>`)}
      </tbody>
    </table></div>`}function pe(){let e=m(r=>C("v1/drives",r),"drives"),[t,n]=g([]),s=(r,a)=>n(a?[...t,r]:t.filter(c=>c!==r));return o`<${v} title="Drives"><a class="button primary" href=${d("upload")}>Upload a drive</a><//>
    <${u} of=${e}>${r=>r.length===0?o`<${p}><p>No drive yet.</p><p>A drive is a folder with <code>drive.json</code> and its images.
            <a href=${d("upload")}>Upload one here</a>, or with <code>mrasfm upload FOLDER</code>.</p><//>`:o`${t.length>1&&o`<${De} drives=${r.filter(a=>t.includes(a.id))} />`}
            <${Ce} drives=${r} chosen=${t} choose=${s} />`}<//>`}function Ce({drives:e,chosen:t,choose:n}){return o`<div class="scroll" tabindex="0" role="region" aria-label="Drives"><table>
    <thead><tr><th scope="col"><span class="hidden">Choose for a map</span></th><th scope="col">Drive</th><th scope="col">State</th><th scope="col">Check</th>
      <th scope="col" class="number">Cameras</th><th scope="col" class="number">Frames</th><th scope="col" class="number">Files</th><th scope="col" class="number">Size</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(s=>o`<tr key=${s.id}>
          <td><input type="checkbox" aria-label=${`choose ${s.name} for a map`} disabled=${s.state!=="COMMITTED"}
            checked=${t.includes(s.id)} onChange=${r=>n(s.id,r.target.checked)} /></td>
          <td><a href=${d("drives",s.id)}>${s.name}</a>${s.vehicle&&o`<div class="muted small">${s.vehicle}</div>`}</td>
          <td><${S} state=${s.state} /></td>
          <td><${S} state=${s.preflight} /></td>
          <td class="number">${s.cameras}</td>
          <td class="number">${l(s.frames)}</td>
          <td class="number">${l(s.files_stored)} of ${l(s.files_expected)}</td>
          <td class="number">${_(s.bytes_stored)}</td>
          <td><${h} at=${s.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function De({drives:e}){let[t,n]=g("map"),[s,r]=g(null),a=async c=>{c.preventDefault();try{let k=await(await y("POST","v1/aggregations",{json:{drives:e.map($=>$.id),name:t}})).json();N(k),E("jobs",k.id)}catch(w){r(A(w))}};return o`<form class="box inline" onSubmit=${c=>{a(c)}}>
    <label>Name of the map <input required maxlength="200" value=${t} onInput=${c=>n(c.target.value)} /></label>
    <button class="primary">Make a map of ${e.length} drives</button>
    ${s&&o`<${P} problem=${s} />`}
  </form>`}function me({id:e}){let t=m(s=>b(`v1/drives/${e}`,s),e),n=t.value;return o`<${v} title=${n?.name??"Drive"} kind="Drive">${n&&o`<${Oe} drive=${n} />`}<//>
    <${u} of=${t}>${s=>o`<${Ee} drive=${s} />`}<//>
    ${n&&o`<${Re} drive=${n} /><${Le} drive=${n} /><${Ne} drive=${n} />`}`}function Ee({drive:e}){return o`<dl class="tiles">
    <${i} label="State"><${S} state=${e.state} /><//>
    <${i} label="Files">${l(e.files_stored)} of ${l(e.files_expected)}<//>
    <${i} label="Size">${_(e.bytes_stored)}<//>
    <${i} label="Cameras">${e.cameras}<//>
    <${i} label="Frames">${l(e.frames)}<//>
    <${i} label="GNSS">${e.has_gnss?"yes":"no"}<//>
    <${i} label="Vehicle">${e.vehicle??"not named"}<//>
    <${i} label="Created"><${h} at=${e.created_at} /><//>
  </dl><p class="muted small"><code>${e.id}</code></p>`}function Oe({drive:e}){let t=async()=>{let r=await(await y("POST","v1/reconstructions",{json:{drive_id:e.id}})).json();N(r),E("jobs",r.id)},n=async()=>{await y("DELETE",`v1/drives/${e.id}`),E("drives")};return o`${e.state==="COMMITTED"?o`<${T} label="Reconstruct" ask="Start a reconstruction?" run=${t} />`:o`<a class="button primary" href=${d("upload")}>Continue the upload</a>`}
    <${T} label="Delete" ask="Delete this drive and its images?" run=${n} danger />`}function Re({drive:e}){let t=m(n=>b(`v1/drives/${e.id}/preflight`,n),`preflight ${e.id}`);return e.state!=="COMMITTED"?null:o`<h2>Check of the drive</h2>
    <${u} of=${t}>${n=>o`<p><${S} state=${n.state} /> ${n.findings.length===0?n.state==="PENDING"?"The images are being checked.":"No finding.":B(n.findings.length,"finding")}</p><${H} findings=${n.findings} />`}<//>`}function Le({drive:e}){let t=m(n=>C(`v1/scenes?drive_id=${e.id}`,n),`scenes ${e.id}`);return o`<h2>Scenes</h2><${u} of=${t}>${n=>n.length===0?o`<${p}>No scene of this drive yet.<//>`:o`<${te} scenes=${n} />`}<//>`}function te({scenes:e}){return o`<div class="scroll" tabindex="0" role="region" aria-label="Scenes"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col" class="number">Units registered</th><th scope="col" class="number">Images registered</th><th scope="col" class="number">Points</th><th scope="col">Georeferenced</th><th scope="col" class="number">Warnings</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(t=>o`<tr key=${t.id}>
          <td><a href=${d("scenes",t.id)}>${t.name}</a></td>
          <td class="number">${l(t.summary.registered_units)} of ${l(t.summary.units)}</td>
          <td class="number">${l(t.summary.registered_images)} of ${l(t.summary.images)}</td>
          <td class="number">${l(t.summary.points)}</td>
          <td>${t.summary.georeferenced?"yes":"no"}</td>
          <td class="number">${t.summary.warnings}</td>
          <td><${h} at=${t.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ne({drive:e}){let t=[...J.value?.values()??[]].filter(n=>n.drive_id===e.id);return t.sort((n,s)=>s.created_at.localeCompare(n.created_at)),o`<h2>Jobs</h2>${t.length===0?o`<${p}>No job of this drive yet.<//>`:o`<${ee} jobs=${t} />`}`}function ue(){let[e,t]=g(null),[n,s]=g(!1),r=async a=>{a.preventDefault();let c=a.currentTarget.elements.namedItem("key"),w=c.value.trim();s(!0),t(null);try{let k=await y("POST","v1/session",{headers:{Authorization:`Bearer ${w}`}});c.value="",L(await k.json())}catch(k){t(A(k))}s(!1)};return o`<main class="login" id="main">
    <h1>MRASfM</h1>
    <p>Maps from the cameras of vehicles.</p>
    <form method="post" onSubmit=${a=>{r(a)}}>
      <label for="key">API key</label>
      <input id="key" name="key" type="password" required autocomplete="off" spellcheck=${!1} autofocus placeholder="mrasfm_…" aria-describedby="key-help" />
      <p id="key-help" class="muted">The key is exchanged for a cookie that lasts 12 hours; it is not kept in the browser.
      An operator makes keys with <code>mrasfm keys create</code>.</p>
      <button class="primary" disabled=${n}>${n?"Logging in …":"Log in"}</button>
    </form>
    ${e&&o`<${P} problem=${e} />`}
  </main>`}var Ae=[[/^report\.html$/,"the report, for people: opens without the internet"],[/^report\.json$/,"findings, time and counts of every stage, uncertainty"],[/^points\.copc\.laz$/,"the points for GIS programs, cloud-optimised"],[/^points\.ply$/,"the points with colours, for any viewer"],[/^poses\.json$/,"poses of units and images with sigmas"],[/^poses\.tum$/,"poses of the vehicle"],[/^trajectory\.gpkg$/,"positions as a GeoPackage"],[/^calibration(\.json|\/)/,"every camera as given and as refined"],[/^frame\.json$/,"the coordinate frame and its place on the earth"],[/^view\.json$/,"trajectory and frusta for this console"],[/^features\.db$/,"keypoints and matches as a COLMAP database"],[/^model\//,"cameras, rig, images and points in COLMAP's format"],[/^rigs?\//,"the calibration for Kalibr, ROS and URDF"],[/^autoware\//,"the points for Autoware"],[/^pictures\//,"a picture"],[/^road\.json$/,"the surface of the road"],[/^map\.json$/,"scenes, seams and verdicts"],[/^manifest\.json$/,"the drive's manifest, in the engine's axes"],[/^(scenes|seams)\//,"data for the map's next version"]];function K({files:e}){let[t,n]=g(""),s=e.filter(a=>a.path.toLowerCase().includes(t.toLowerCase())),r=e.reduce((a,c)=>a+c.size_bytes,0);return o`<h2>Files</h2>
    <p class="muted">${B(e.length,"file")}, ${_(r)} together.</p>
    <label class="filter">Find a file <input type="search" value=${t} onInput=${a=>n(a.target.value)} /></label>
    ${s.length===0?o`<${p}>No file of this name.<//>`:o`<div class="scroll" tabindex="0" role="region" aria-label="Files"><table>
          <thead><tr><th scope="col">File</th><th scope="col" class="number">Size</th><th scope="col">Content</th></tr></thead>
          <tbody>${s.map(a=>o`<tr key=${a.path}><td><a href=${a.url.replace(/^\//,"")} download>${a.path}</a></td>
              <td class="number">${_(a.size_bytes)}</td><td>${Ae.find(([c])=>c.test(a.path))?.[1]??""}</td></tr>`)}</tbody></table></div>`}`}function he(){let e=m(t=>C("v1/scenes",t),"scenes");return o`<${v} title="Scenes" /><${u} of=${e}>${t=>t.length===0?o`<${p}>No scene yet. A reconstruction makes a scene of a <a href=${d("drives")}>drive</a>.<//>`:o`<${te} scenes=${t} />`}<//>`}var Ie=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"calibration",label:"Calibration"},{name:"files",label:"Files"}];function fe({id:e,tab:t}){let n=m(a=>b(`v1/scenes/${e}`,a),e,!1),s=n.value,r=async()=>{await y("DELETE",`v1/scenes/${e}`),E("scenes")};return o`<${v} title=${s?.name??"Scene"} kind="Scene">
      ${s&&O(s,"report.html")&&o`<a class="button" href=${M(`v1/scenes/${e}`,"report.html")} download>Download the report</a>`}
      <${T} label="Delete" ask="Delete this scene and its files?" run=${r} danger />
    <//>
    <${z} base=${["scenes",e]} tabs=${Ie} current=${t} />
    <${u} of=${n}>${a=>Je(a,t)}<//>`}function O(e,t){return e.files.some(n=>n.path===t)}function Je(e,t){let n=`v1/scenes/${e.id}`;return t==="3d"?O(e,"view.json")?o`<${x} load=${()=>import("./page-M35Y5GAN.js")} name="Viewer" of=${{base:n,driveOf:{[e.name]:e.drive_id},onlyDrive:e.drive_id}} />`:o`<${p}>This scene has no view.json: it was made by an older version, or its points could not be written. Reconstruct it again.<//>`:t==="place"?O(e,"view.json")?e.summary.georeferenced?o`<${x} load=${()=>import("./page-J5IQZ76I.js")} name="Place" of=${{base:n}} />`:o`<${p}>This scene has no place on the earth: its drive has no GNSS that could be used.<//>`:o`<${p}>This scene has no view.json: it was made by an older version. Reconstruct it again.<//>`:t==="calibration"?o`<${x} load=${()=>import("./page-OJBS5ZIA.js")} name="CalibrationPage" of=${{base:n,driveId:e.drive_id,hasPictures:O(e,"pictures/birds_eye_before.png")}} />`:t==="files"?o`<${K} files=${e.files} />`:o`<${Fe} scene=${e} />`}function Fe({scene:e}){let t=`v1/scenes/${e.id}`,n=m(r=>b(M(t,"report.json"),r),`report ${e.id}`,!1),{summary:s}=e;return o`<dl class="tiles">
      <${i} label="Units registered">${l(s.registered_units)} of ${l(s.units)}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Place on the earth">${s.georeferenced?"by GNSS":"none"}<//>
      <${i} label="Warnings">${s.warnings}<//>
      <${i} label="Made"><${h} at=${e.created_at} /><//>
    </dl>
    <p><a href=${d("drives",e.drive_id)}>The drive</a> · <a href=${d("jobs",e.job_id)}>the job</a> · engine ${s.engine_version}</p>
    <${u} of=${n}>${r=>o`<${oe} report=${r} />`}<//>
    ${(s.components??[]).length>1&&o`<h2>Components</h2><p>Nothing links some parts of this drive with the rest: each is a scene of its own.</p>
      <ul>${(s.components??[]).map(r=>o`<li>Component ${r.component} in <code>${r.folder}</code>: ${l(r.registered_units)} units, ${l(r.points)} points</li>`)}</ul>`}
    ${O(e,"pictures/road_before.png")&&o`<h2>Points of the road</h2>
      <${G} before=${M(t,"pictures/road_before.png")} after=${M(t,"pictures/road_after.png")} label="Before and after points off its surface were dropped" />`}`}function oe({report:e}){let t=e.summary.mean_reprojection_error_px;return o`<h2>Findings</h2>
    ${(e.findings??[]).length===0?o`<p>None.</p>`:o`<${H} findings=${e.findings} />`}
    ${typeof t=="number"&&o`<p>Mean reprojection error <span data-exact=${t}>${V(t,3)} px</span>.</p>`}
    <h2>Time by stage</h2>
    <${Ve} stages=${e.stages} />`}function Ve({stages:e}){let t=Math.max(...e.map(n=>n.seconds),1e-9);return o`<table class="bars"><thead class="hidden"><tr><th scope="col">Stage</th><th scope="col">Share</th><th scope="col">Time</th></tr></thead><tbody>${e.map(n=>o`<tr><th scope="row">${n.stage.replaceAll("-"," ")}</th>
      <td><progress max=${t} value=${n.seconds} aria-label=${`time of ${n.stage}`}></progress></td>
      <td class="number">${F(n.seconds)}${n.reused?" (reused)":""}</td></tr>`)}</tbody></table>`}function be(){let e=m(t=>C("v1/maps",t),"maps");return o`<${v} title="Maps" /><${u} of=${e}>${t=>t.length===0?o`<${p}>No map yet. Choose two or more <a href=${d("drives")}>drives</a> to make one.<//>`:o`<div class="scroll" tabindex="0" role="region" aria-label="Maps"><table>
          <thead><tr><th scope="col">Map</th><th scope="col" class="number">Version</th><th scope="col" class="number">Scenes connected</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col">Created</th></tr></thead>
          <tbody>${t.map(n=>o`<tr key=${n.id}><td><a href=${d("maps",n.id)}>${n.name}</a></td>${Be(n)}<td><${h} at=${n.created_at} /></td></tr>`)}</tbody></table></div>`}<//>`}function Be(e){let t=e.version?.summary;return t?o`<td class="number">${e.current_version}</td><td class="number">${t.connected} of ${t.scenes}</td><td class="number">${t.seams}</td><td class="number">${l(t.points)}</td>`:o`<td colspan="4" class="muted">${e.job_id?o`<a href=${d("jobs",e.job_id)}>being made</a>`:"no version yet"}</td>`}var Ue=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"seams",label:"Seams"},{name:"versions",label:"Versions"},{name:"files",label:"Files"}];function ge({id:e,tab:t}){let n=m(r=>b(`v1/maps/${e}`,r),e),s=n.value;return o`<${v} title=${s?.name??"Map"} kind="Map" />
    <${z} base=${["maps",e]} tabs=${Ue} current=${t} />
    <${u} of=${n}>${r=>t==="versions"?o`<${Qe} map=${r} changed=${n.again} />`:r.version?o`<${He} key=${r.version.number} map=${r} number=${r.version.number} tab=${t} />`:o`<${p}>This map has no version yet.${r.job_id&&o` <a href=${d("jobs",r.job_id)}>Its job</a>`}<//>`}<//>`}function He({map:e,number:t,tab:n}){let s=`v1/maps/${e.id}/versions/${t}`,r=m(a=>b(s,a),s,!1);return o`<${u} of=${r}>${a=>qe(a,s,n)}<//>`}function qe(e,t,n){if(n==="files")return o`<${K} files=${e.files} />`;if(n==="seams")return o`<${Ke} version=${e} base=${t} />`;if(n==="3d"){if(!O(e,"view.json"))return o`<${p}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;let s=Object.fromEntries(e.scenes.map(r=>[r.name,r.drive_id]));return o`<${x} load=${()=>import("./page-M35Y5GAN.js")} name="Viewer" of=${{base:t,driveOf:s}} />`}return n==="place"?O(e,"view.json")?e.summary.georeferenced?o`<${x} load=${()=>import("./page-J5IQZ76I.js")} name="Place" of=${{base:t}} />`:o`<${p}>This map has no place on the earth: none of its drives has GNSS that could be used.<//>`:o`<${p}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`:o`<${ze} version=${e} base=${t} />`}function ze({version:e,base:t}){let n=m(r=>b(M(t,"report.json"),r),`report ${t}`,!1),{summary:s}=e;return o`<dl class="tiles">
      <${i} label="Version">${e.number}<//>
      <${i} label="Scenes connected">${s.connected} of ${s.scenes}<//>
      <${i} label="Seams">${s.seams}<//>
      <${i} label="Images registered">${l(s.registered_images)} of ${l(s.images)}<//>
      <${i} label="Points">${l(s.points)}<//>
      <${i} label="Made"><${h} at=${e.created_at} /><//>
    </dl>
    <h2>Scenes</h2><${Ge} version=${e} />
    ${e.failed.length>0&&o`<h2>Drives without a scene</h2>${e.failed.map(r=>o`<p><a href=${d("drives",r.drive_id)}>${r.name}</a></p><${P} problem=${r.problem} />`)}`}
    <${u} of=${n}>${r=>o`<${oe} report=${r} />`}<//>`}function Ge({version:e}){return o`<div class="scroll" tabindex="0" role="region" aria-label="Scenes of the map"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col">Connected</th><th scope="col">Drive</th></tr></thead>
    <tbody>${e.scenes.map(t=>o`<tr><td><a href=${d("scenes",t.scene_id)}>${t.name}</a></td>
        <td>${t.connected?o`<span class="badge good">connected</span>`:o`<span class="badge warn">placed by positions only</span>`}</td>
        <td><a href=${d("drives",t.drive_id)}><code>${t.drive_id}</code></a></td></tr>`)}</tbody></table></div>`}function Ke({version:e,base:t}){let n=m(s=>b(M(t,"map.json"),s),`map ${t}`,!1);return o`<${u} of=${n}>${s=>o`
    ${s.seams.length===0&&o`<${p}>No two scenes of this map were close enough to look for a seam.<//>`}
    ${s.seams.map(r=>o`<${We} seam=${r} base=${t} version=${e} />`)}
    ${e.unconnected.length>0&&o`<h2>Not connected</h2><p>No seam in use connects these scenes with the others; positions place them: ${e.unconnected.join(", ")}.</p>`}`}<//>`}function We({seam:e,base:t}){let n=`${e.a} – ${e.b}`,s=(r,a,c)=>a===void 0?null:o`<${i} label=${r}><span data-exact=${a}>${V(a,3)} ${c}</span><//>`;return o`<section class="box"><h2>${n}</h2>
    <p>${e.accepted?o`<span class="badge good">accepted</span>`:o`<span class="badge warn">rejected</span> ${e.reason??"The evidence does not suffice."}`}</p>
    <dl class="tiles">
      ${e.units_tried!==void 0&&o`<${i} label="Units that agree">${e.units_agreeing??0} of ${e.units_tried}<//>`}
      ${e.inliers!==void 0&&o`<${i} label="Shared points">${l(e.inliers)}<//>`}
      ${s("Residual before",e.residual_before_px,"px")}
      ${s("Residual after",e.residual_after_px,"px")}
      ${s("Sigma of the translation",e.sigma_translation_m,"m")}
      ${s("Sigma of the rotation",e.sigma_rotation_deg,"deg")}
      ${s("Scale",e.scale,"")}
    </dl>
    ${e.pictures?o`<${G} before=${M(t,e.pictures.before)} after=${M(t,e.pictures.after)} label="Points of both scenes from above" />`:o`<p class="muted">${e.accepted?"There are no pictures: they were switched off, or no ground of both scenes is seen.":"There are no pictures, because the seam is not used."}</p>`}
  </section>`}function Qe({map:e,changed:t}){let n=m(s=>C(`v1/maps/${e.id}/versions`,s),`versions ${e.id} ${e.current_version}`);return o`<${u} of=${n}>${s=>s.length===0?o`<${p}>No version yet.<//>`:o`<${Ye} map=${e} versions=${s} loaded=${n} changed=${t} />`}<//>`}function Ye({map:e,versions:t,changed:n}){let s=t.map(f=>f.number),[r,a]=g(s[1]??s[0]),[c,w]=g(s[0]),k=async f=>{await y("PUT",`v1/maps/${e.id}/current-version`,{json:{version:f}}),n()},$=(f,ne,we)=>o`<label>${f}
    <select value=${ne} onChange=${I=>we(Number(I.target.value))}>
      ${s.map(I=>o`<option value=${I} selected=${I===ne}>Version ${I}</option>`)}</select></label>`,[j,se]=[t.find(f=>f.number===r),t.find(f=>f.number===c)];return o`<div class="scroll" tabindex="0" role="region" aria-label="Versions"><table>
      <thead><tr><th scope="col" class="number">Version</th><th scope="col">Made</th><th scope="col" class="number">Scenes</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col"></th></tr></thead>
      <tbody>${t.map(f=>o`<tr key=${f.number}><td class="number">${f.number}</td><td><${h} at=${f.created_at} /></td>
          <td class="number">${f.summary.scenes}</td><td class="number">${f.summary.seams}</td><td class="number">${l(f.summary.points)}</td>
          <td>${f.is_current?o`<${S} state="current" />`:o`<${T} label="Make it current" ask=${`Show version ${f.number}?`} run=${()=>k(f.number)} />`}</td></tr>`)}</tbody></table></div>
    <h2>Compare</h2>
    ${s.length<2?o`<p class="muted">There is one version only. An aggregation into this map makes the next.</p>`:o`<div class="inline">${$("From",r,a)} ${$("To",c,w)}</div>${j&&se&&o`<${Ze} a=${j} b=${se} />`}`}`}var Xe=["scenes","connected","seams","registered_units","registered_images","points","warnings"];function Ze({a:e,b:t}){let n=$=>new Map($.scenes.map(j=>[j.name,j.connected])),[s,r]=[n(e),n(t)],a=[...r.keys()].filter($=>!s.has($)),c=[...s.keys()].filter($=>!r.has($)),w=[...r].filter(([$,j])=>s.has($)&&s.get($)!==j),k=$=>$>0?`+${l($)}`:$<0?`−${l(-$)}`:"same";return o`<table><thead><tr><th scope="col">Figure</th><th scope="col" class="number">Version ${e.number}</th><th scope="col" class="number">Version ${t.number}</th><th scope="col" class="number">Change</th></tr></thead>
      <tbody>${Xe.map($=>o`<tr><th scope="row">${$.replaceAll("_"," ")}</th><td class="number">${l(e.summary[$])}</td><td class="number">${l(t.summary[$])}</td><td class="number">${k(t.summary[$]-e.summary[$])}</td></tr>`)}</tbody></table>
    <ul>
      <li>Scenes added: ${a.join(", ")||"none"}</li>
      <li>Scenes removed: ${c.join(", ")||"none"}</li>
      <li>Connection changed: ${w.map(([$,j])=>`${$} (${j?"connected now":"not connected any more"})`).join(", ")||"none"}</li>
    </ul>`}var et=5e3;function ve(){let e=m(t=>b("v1/status",t),"status");return R(()=>{let t=setInterval(()=>document.hidden||e.again(),et);return()=>clearInterval(t)},[]),o`<${v} title="Status" /><${u} of=${e}>${t=>o`<${tt} status=${t} />`}<//>`}function tt({status:e}){let t=1-e.disk.free_bytes/e.disk.total_bytes;return o`<p><${S} state=${e.status} /> Version ${e.version}</p>
    ${e.reasons.length>0&&o`<ul class="findings">${e.reasons.map(n=>o`<li class="warn">${n}</li>`)}</ul>`}
    <dl class="tiles">
      <${i} label="Jobs that wait">${l(e.queue.queued)}<//>
      <${i} label="Jobs that run">${l(e.queue.running)}<//>
      <${i} label="Stalled jobs">${l(e.queue.stalled)}<//>
      <${i} label="Broker">${e.broker?"answers":"does not answer"}<//>
      <${i} label="Disk">${_(e.disk.free_bytes)} free of ${_(e.disk.total_bytes)}
        <progress max="1" value=${t} aria-label="disk in use"></progress><//>
      <${i} label="Uploads">${e.disk.accepts_uploads?"are taken":"are refused: the disk is full"}<//>
    </dl>
    <h2>Workers</h2>
    ${e.workers.length===0?o`<${p}>No worker has reported within the last day. Jobs are accepted and wait.<//>`:o`<div class="scroll" tabindex="0" role="region" aria-label="Workers"><table>
          <thead><tr><th scope="col">Worker</th><th scope="col">Online</th><th scope="col">Queues</th><th scope="col" class="number">Jobs at one time</th><th scope="col">Last report</th></tr></thead>
          <tbody>${e.workers.map(n=>o`<tr><td><code>${n.name}</code></td><td><span class=${`badge ${n.online?"good":"bad"}`}>${n.online?"online":"offline"}</span></td>
              <td>${n.queues.join(", ")}</td><td class="number">${n.concurrency}</td><td><${h} at=${n.seen_at} /></td></tr>`)}</tbody></table></div>`}
    <p><a href="docs">Description of the API</a></p>`}function ye(){let e=m(t=>b("v1/session",t),"session");return o`<${v} title="Key and project" /><${u} of=${e}>${t=>o`
    <dl class="tiles">
      <${i} label="Project">${t.project}<//>
      <${i} label="Key">${t.key_name}<//>
      <${i} label="Key made"><${h} at=${t.key_created_at} /><//>
      <${i} label="Session ends"><${h} at=${t.session_expires_at} /><//>
      <${i} label="Stored">${_(t.used_bytes)} of ${_(t.max_bytes)}
        <progress max=${t.max_bytes} value=${t.used_bytes} aria-label="storage in use"></progress><//>
      <${i} label="Active jobs">at most ${l(t.max_active_jobs)}<//>
      <${i} label="Drives">at most ${l(t.max_drives)}<//>
    </dl>
    <p class="muted small"><code>${t.key_id}</code></p>
    <h2>More keys</h2>
    <p>Keys are made and revoked on the service's machine. A revoked key ends its sessions within seconds.</p>
    <pre tabindex="0">mrasfm keys create --name NAME
mrasfm keys revoke ${t.key_id}</pre>`}<//>
    <p><a href=${d("status")}>Status of the service</a></p>`}async function Se(){await fetch("v1/session",{method:"DELETE"}),L(null)}var ot=[["drives","Drives"],["jobs","Jobs"],["scenes","Scenes"],["maps","Maps"],["status","Status"],["keys","Key"]],st={connecting:"connecting …",live:"live",polling:"polling",offline:"offline, tries again"};function nt(e){let[t="drives",n,s=""]=e;return t==="upload"?o`<${x} key="upload" load=${()=>import("./page-LTTVPYSO.js")} name="UploadPage" of=${{}} />`:t==="jobs"?n?o`<${$e} key=${n} id=${n} />`:o`<${ce} />`:t==="scenes"?n?o`<${fe} key=${`${n} ${s}`} id=${n} tab=${s} />`:o`<${he} />`:t==="maps"?n?o`<${ge} key=${`${n} ${s}`} id=${n} tab=${s} />`:o`<${be} />`:t==="status"?o`<${ve} />`:t==="keys"?o`<${ye} />`:n?o`<${me} key=${n} id=${n} />`:o`<${pe} />`}function rt(){let e=de.value,t=e[0]==="upload"?"drives":e[0]??"drives";return R(()=>{document.querySelector("main h1")?.focus({preventScroll:!0}),window.scrollTo(0,0)},[e.slice(0,2).join("/")]),o`<a class="skip" href="#main" onClick=${at}>Skip to the content</a>
    <header>
      <a class="brand" href=${d("drives")}>MRASfM</a>
      <nav aria-label="Pages">${ot.map(([n,s])=>o`<a href=${d(n)} aria-current=${t===n?"page":void 0}>${s}</a>`)}</nav>
      <div class="session"><span class=${`connection ${U.value}`} role="status" data-connection=${U.value}>${st[U.value]}</span>
        <span class="muted project">${W.value?.project}</span>
        <button type="button" onClick=${()=>{Se()}}>Log out</button></div>
    </header>
    <main id="main">${nt(e)}</main>`}function at(e){e.preventDefault(),document.querySelector("main h1")?.focus()}function it(){let e=W.value,t=!!e;return R(()=>{t?ie():le()},[t]),e===void 0?o`<main class="login"><p class="muted" aria-busy="true">Loading …</p></main>`:e===null?o`<${ue} />`:o`<${rt} />`}async function lt(){try{L(ae()?await b("v1/session"):null)}catch{L(null)}}re(o`<${it} />`,document.getElementById("app"));lt();

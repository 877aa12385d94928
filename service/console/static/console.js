import{a as K}from"./chunk-OAFXIFNJ.js";import{A as d,B as E,C as m,D as A,E as P,F as q,G as u,H as v,I as p,J as S,K as z,L as Q,M as Y,N as X,O as i,P as h,Q as T,R as G,a as ae,b as g,c as R,e as J,f as ie,g as L,i as y,j as b,k as C,l as M,m as s,n as _,o as l,p as V,r as B,s as U,t as F,u as H,v as D,w as N,x as le,y as de,z as ce}from"./chunk-HFRQZBY7.js";function x({load:e,name:t,of:n}){let[o,r]=g(null),[a,c]=g(null);return R(()=>{e().then(w=>r({show:w[t]}),w=>c(A(w)))},[]),a?s`<${P} problem=${a} />`:o?s`<${o.show} ...${n} />`:s`<p class="muted" aria-busy="true">Loading …</p>`}var Z=200,ke={active:"Not ended",failed:"Failed",all:"All"};function $e(){let[e,t]=g("all"),n=F.value,r=[...n?.values()??[]].sort((a,c)=>c.created_at.localeCompare(a.created_at)).filter(a=>e==="active"?!D(a):e==="failed"?a.state==="FAILED":!0);return s`<${v} title="Jobs">
      <div class="choice" role="group" aria-label="Jobs to show">
        ${Object.entries(ke).map(([a,c])=>s`<button type="button" aria-pressed=${e===a} onClick=${()=>t(a)}>${c}</button>`)}
      </div>
    <//>
    ${n===null&&s`<p class="muted" aria-busy="true">Loading …</p>`}
    ${n!==null&&r.length===0&&s`<${p}>${e==="all"?"No job yet. Upload a drive and start its reconstruction.":"No such job."}<//>`}
    ${r.length>0&&s`<${ee} jobs=${r.slice(0,Z)} />`}
    ${r.length>Z&&s`<p class="muted">The newest ${Z} of ${r.length} jobs are shown.</p>`}`}function ee({jobs:e}){return s`<div class="scroll" tabindex="0" role="region" aria-label="Jobs"><table>
    <thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col">Stage</th><th scope="col">Time left</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(t=>s`<tr key=${t.id}>
          <td><a href=${d("jobs",t.id)}>${Q[t.kind]}</a><div class="muted small">${Me(t)}</div></td>
          <td><${S} state=${t.state} /></td>
          <td><${z} percent=${t.progress.percent} label="done" /></td>
          <td>${D(t)?"–":X(t)}</td>
          <td class="number">${D(t)?"–":Y(t)}</td>
          <td><${h} at=${t.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Me(e){return e.members&&e.members.length>0?e.members.map(t=>t.name).join(", "):e.drive_id??e.id}function pe({id:e}){let t=m(r=>b(`v1/jobs/${e}`,r),e),o=F.value?.get(e)??t.value;return o?s`<${v} title=${Q[o.kind]} kind="Job"><${Te} job=${o} /><//>
    <div class="row"><${S} state=${o.state} />${o.cancel_requested&&!D(o)&&s`<span class="badge warn">stopping</span>`}
      <${z} percent=${o.progress.percent} label="done" /></div>
    <dl class="tiles" aria-live="polite">
      <${i} label="Stage">${X(o)}<//>
      <${i} label=${D(o)?"Took":"Time left"}>${D(o)?Pe(o):Y(o)}<//>
      <${i} label="Created"><${h} at=${o.created_at} /><//>
      <${i} label="Started"><${h} at=${o.started_at} /><//>
      <${i} label="Heartbeat"><${h} at=${o.heartbeat_at} /><//>
    </dl>
    ${o.problem&&s`<${P} problem=${o.problem} />`}
    <${je} job=${o} />
    <${xe} job=${o} />
    <${Ce} job=${o} />
    <h2>Details</h2>
    <dl class="facts">
      <dt>Id</dt><dd><code>${o.id}</code></dd>
      ${o.drive_id&&s`<dt>Drive</dt><dd><a href=${d("drives",o.drive_id)}>${o.drive_id}</a></dd>`}
      ${o.parent_id&&s`<dt>Part of</dt><dd><a href=${d("jobs",o.parent_id)}>${o.parent_id}</a></dd>`}
      ${o.retry_of&&s`<dt>Repeats</dt><dd><a href=${d("jobs",o.retry_of)}>${o.retry_of}</a></dd>`}
      <dt>Reused stages</dt><dd>${o.progress.reused_stages?.join(", ")||"none"}</dd>
      <dt>Settings</dt><dd><pre tabindex="0">${JSON.stringify(o.settings,null,1)}</pre></dd>
    </dl>`:s`<${v} title="Job" /><${u} of=${t}>${()=>null}<//>`}function Pe(e){return!e.finished_at||!e.started_at?"did not start":V((Date.parse(e.finished_at)-Date.parse(e.started_at))/1e3)}function Te({job:e}){let t=async()=>{let r=await y("POST",`v1/jobs/${e.id}:cancel`);N(await r.json())},n=async()=>{let a=await(await y("POST",`v1/jobs/${e.id}:retry`)).json();N(a),E("jobs",a.id)},o=e.kind!=="SUBMAP"&&(e.state==="FAILED"||e.state==="CANCELLED");return s`${!D(e)&&!e.cancel_requested&&s`<${T} label="Cancel" ask="Cancel this job?" run=${t} danger />`}
  ${o&&s`<${T} label="Retry" ask="Do it again? Finished stages are reused." run=${n} />`}`}function je({job:e}){return e.scene_id?s`<p><a class="button primary" href=${d("scenes",e.scene_id)}>Open the scene</a></p>`:e.map_id&&e.map_version?s`<p><a class="button primary" href=${d("maps",e.map_id)}>Open the map</a></p>`:null}function xe({job:e}){let t=(e.members??[]).map(r=>({label:r.name,state:r.scene_id?"SUCCEEDED":r.state,percent:r.percent,jobId:r.job_id,note:r.problem?r.problem.detail:r.job_id?"":"its scene was there"})),n=(e.submaps??[]).map(r=>({label:`Sub-map ${r.number}: units ${r.first_unit} to ${r.last_unit}`,state:r.state,percent:r.percent,jobId:r.job_id,note:r.problem?.detail??""})),o=[...t,...n];return o.length===0?null:s`<h2>${t.length>0?"Drives of this map":"Sub-maps"}</h2>
    <ul class="tree">
      ${o.map(r=>s`<li key=${r.label}>
          <span class="label">${r.jobId?s`<a href=${d("jobs",r.jobId)}>${r.label}</a>`:r.label}</span>
          ${r.state&&s`<${S} state=${r.state} />`}
          <${z} percent=${r.percent} label=${`${r.label} done`} />
          ${r.note&&s`<span class="muted small">${r.note}</span>`}
        </li>`)}
    </ul>`}function Ce({job:e}){return e.attempts.length===0?null:s`<h2>Attempts</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Attempts"><table>
      <thead><tr><th scope="col" class="number">Attempt</th><th scope="col">Worker</th><th scope="col">Started</th><th scope="col">Finished</th><th scope="col">Outcome</th></tr></thead>
      <tbody>
        ${e.attempts.map(t=>s`<tr>
            <td class="number">${t.attempt}</td><td><code>${t.worker}</code></td>
            <td><${h} at=${t.started_at} /></td><td><${h} at=${t.finished_at} /></td>
            <td>${t.outcome??"runs"}${t.problem&&s`<div class="small">${t.problem.detail}</div>`}</td>
          </tr>`)}
      </tbody>
    </table></div>`}function me(){let e=m(r=>C("v1/drives",r),"drives"),[t,n]=g([]),o=(r,a)=>n(a?[...t,r]:t.filter(c=>c!==r));return s`<${v} title="Drives"><a class="button primary" href=${d("upload")}>Upload a drive</a><//>
    <${u} of=${e}>${r=>r.length===0?s`<${p}><p>No drive yet.</p><p>A drive is a folder with <code>drive.json</code> and its images.
            <a href=${d("upload")}>Upload one here</a>, or with <code>mrasfm upload FOLDER</code>.</p><//>`:s`${t.length>1&&s`<${Ee} drives=${r.filter(a=>t.includes(a.id))} />`}
            <${De} drives=${r} chosen=${t} choose=${o} />`}<//>`}function De({drives:e,chosen:t,choose:n}){return s`<div class="scroll" tabindex="0" role="region" aria-label="Drives"><table>
    <thead><tr><th scope="col"><span class="hidden">Choose for a map</span></th><th scope="col">Drive</th><th scope="col">State</th><th scope="col">Check</th>
      <th scope="col" class="number">Cameras</th><th scope="col" class="number">Frames</th><th scope="col" class="number">Files</th><th scope="col" class="number">Size</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(o=>s`<tr key=${o.id}>
          <td><input type="checkbox" aria-label=${`choose ${o.name} for a map`} disabled=${o.state!=="COMMITTED"}
            checked=${t.includes(o.id)} onChange=${r=>n(o.id,r.target.checked)} /></td>
          <td><a href=${d("drives",o.id)}>${o.name}</a>${o.vehicle&&s`<div class="muted small">${o.vehicle}</div>`}</td>
          <td><${S} state=${o.state} /></td>
          <td><${S} state=${o.preflight} /></td>
          <td class="number">${o.cameras}</td>
          <td class="number">${l(o.frames)}</td>
          <td class="number">${l(o.files_stored)} of ${l(o.files_expected)}</td>
          <td class="number">${_(o.bytes_stored)}</td>
          <td><${h} at=${o.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ee({drives:e}){let[t,n]=g("map"),[o,r]=g(null),a=async c=>{c.preventDefault();try{let k=await(await y("POST","v1/aggregations",{json:{drives:e.map($=>$.id),name:t}})).json();N(k),E("jobs",k.id)}catch(w){r(A(w))}};return s`<form class="box inline" onSubmit=${c=>{a(c)}}>
    <label>Name of the map <input required maxlength="200" value=${t} onInput=${c=>n(c.target.value)} /></label>
    <button class="primary">Make a map of ${e.length} drives</button>
    ${o&&s`<${P} problem=${o} />`}
  </form>`}function ue({id:e}){let t=m(o=>b(`v1/drives/${e}`,o),e),n=t.value;return s`<${v} title=${n?.name??"Drive"} kind="Drive">${n&&s`<${Re} drive=${n} />`}<//>
    <${u} of=${t}>${o=>s`<${Oe} drive=${o} />`}<//>
    ${n&&s`<${Le} drive=${n} /><${Ne} drive=${n} /><${Ae} drive=${n} />`}`}function Oe({drive:e}){return s`<dl class="tiles">
    <${i} label="State"><${S} state=${e.state} /><//>
    <${i} label="Files">${l(e.files_stored)} of ${l(e.files_expected)}<//>
    <${i} label="Size">${_(e.bytes_stored)}<//>
    <${i} label="Cameras">${e.cameras}<//>
    <${i} label="Frames">${l(e.frames)}<//>
    <${i} label="GNSS">${e.has_gnss?"yes":"no"}<//>
    <${i} label="Vehicle">${e.vehicle??"not named"}<//>
    <${i} label="Created"><${h} at=${e.created_at} /><//>
  </dl><p class="muted small"><code>${e.id}</code></p>`}function Re({drive:e}){let t=async()=>{let r=await(await y("POST","v1/reconstructions",{json:{drive_id:e.id}})).json();N(r),E("jobs",r.id)},n=async()=>{await y("DELETE",`v1/drives/${e.id}`),E("drives")};return s`${e.state==="COMMITTED"?s`<${T} label="Reconstruct" ask="Start a reconstruction?" run=${t} />`:s`<a class="button primary" href=${d("upload")}>Continue the upload</a>`}
    <${T} label="Delete" ask="Delete this drive and its images?" run=${n} danger />`}function Le({drive:e}){let t=m(n=>b(`v1/drives/${e.id}/preflight`,n),`preflight ${e.id}`);return e.state!=="COMMITTED"?null:s`<h2>Check of the drive</h2>
    <${u} of=${t}>${n=>s`<p><${S} state=${n.state} /> ${n.findings.length===0?n.state==="PENDING"?"The images are being checked.":"No finding.":U(n.findings.length,"finding")}</p><${q} findings=${n.findings} />`}<//>`}function Ne({drive:e}){let t=m(n=>C(`v1/scenes?drive_id=${e.id}`,n),`scenes ${e.id}`);return s`<h2>Scenes</h2><${u} of=${t}>${n=>n.length===0?s`<${p}>No scene of this drive yet.<//>`:s`<${te} scenes=${n} />`}<//>`}function te({scenes:e}){return s`<div class="scroll" tabindex="0" role="region" aria-label="Scenes"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col" class="number">Units registered</th><th scope="col" class="number">Images registered</th><th scope="col" class="number">Points</th><th scope="col">Georeferenced</th><th scope="col" class="number">Warnings</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${e.map(t=>s`<tr key=${t.id}>
          <td><a href=${d("scenes",t.id)}>${t.name}</a></td>
          <td class="number">${l(t.summary.registered_units)} of ${l(t.summary.units)}</td>
          <td class="number">${l(t.summary.registered_images)} of ${l(t.summary.images)}</td>
          <td class="number">${l(t.summary.points)}</td>
          <td>${t.summary.georeferenced?"yes":"no"}</td>
          <td class="number">${t.summary.warnings}</td>
          <td><${h} at=${t.created_at} /></td>
        </tr>`)}
    </tbody>
  </table></div>`}function Ae({drive:e}){let t=[...F.value?.values()??[]].filter(n=>n.drive_id===e.id);return t.sort((n,o)=>o.created_at.localeCompare(n.created_at)),s`<h2>Jobs</h2>${t.length===0?s`<${p}>No job of this drive yet.<//>`:s`<${ee} jobs=${t} />`}`}function he(){let[e,t]=g(null),[n,o]=g(!1),r=async a=>{a.preventDefault();let c=a.currentTarget.elements.namedItem("key"),w=c.value.trim();o(!0),t(null);try{let k=await y("POST","v1/session",{headers:{Authorization:`Bearer ${w}`}});c.value="",L(await k.json())}catch(k){t(A(k))}o(!1)};return s`<main class="login" id="main">
    <h1>MRASfM</h1>
    <p>Maps from the cameras of vehicles.</p>
    <form method="post" onSubmit=${a=>{r(a)}}>
      <label for="key">API key</label>
      <input id="key" name="key" type="password" required autocomplete="off" spellcheck=${!1} autofocus placeholder="mrasfm_…" aria-describedby="key-help" />
      <p id="key-help" class="muted">The key is exchanged for a cookie that lasts 12 hours; it is not kept in the browser.
      An operator makes keys with <code>mrasfm keys create</code>.</p>
      <button class="primary" disabled=${n}>${n?"Logging in …":"Log in"}</button>
    </form>
    ${e&&s`<${P} problem=${e} />`}
  </main>`}var Ie=[[/^report\.html$/,"the report, for people: opens without the internet"],[/^report\.json$/,"findings, time and counts of every stage, uncertainty"],[/^points\.copc\.laz$/,"the points for GIS programs, cloud-optimised"],[/^points\.ply$/,"the points with colours, for any viewer"],[/^poses\.json$/,"poses of units and images with sigmas"],[/^poses\.tum$/,"poses of the vehicle"],[/^trajectory\.gpkg$/,"positions as a GeoPackage"],[/^calibration(\.json|\/)/,"every camera as given and as refined"],[/^frame\.json$/,"the coordinate frame and its place on the earth"],[/^view\.json$/,"trajectory and frusta for this console"],[/^features\.db$/,"keypoints and matches as a COLMAP database"],[/^model\//,"cameras, rig, images and points in COLMAP's format"],[/^rigs?\//,"the calibration for Kalibr, ROS and URDF"],[/^autoware\//,"the points for Autoware"],[/^pictures\//,"a picture"],[/^road\.json$/,"the surface of the road"],[/^map\.json$/,"scenes, seams and verdicts"],[/^manifest\.json$/,"the drive's manifest, in the engine's axes"],[/^(scenes|seams)\//,"data for the map's next version"]];function W({files:e}){let[t,n]=g(""),o=e.filter(a=>a.path.toLowerCase().includes(t.toLowerCase())),r=e.reduce((a,c)=>a+c.size_bytes,0);return s`<h2>Files</h2>
    <p class="muted">${U(e.length,"file")}, ${_(r)} together.</p>
    <label class="filter">Find a file <input type="search" value=${t} onInput=${a=>n(a.target.value)} /></label>
    ${o.length===0?s`<${p}>No file of this name.<//>`:s`<div class="scroll" tabindex="0" role="region" aria-label="Files"><table>
          <thead><tr><th scope="col">File</th><th scope="col" class="number">Size</th><th scope="col">Content</th></tr></thead>
          <tbody>${o.map(a=>s`<tr key=${a.path}><td><a href=${a.url.replace(/^\//,"")} download>${a.path}</a></td>
              <td class="number">${_(a.size_bytes)}</td><td>${Ie.find(([c])=>c.test(a.path))?.[1]??""}</td></tr>`)}</tbody></table></div>`}`}function fe(){let e=m(t=>C("v1/scenes",t),"scenes");return s`<${v} title="Scenes" /><${u} of=${e}>${t=>t.length===0?s`<${p}>No scene yet. A reconstruction makes a scene of a <a href=${d("drives")}>drive</a>.<//>`:s`<${te} scenes=${t} />`}<//>`}var Je=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"calibration",label:"Calibration"},{name:"files",label:"Files"}];function be({id:e,tab:t}){let n=m(a=>b(`v1/scenes/${e}`,a),e,!1),o=n.value,r=async()=>{await y("DELETE",`v1/scenes/${e}`),E("scenes")};return s`<${v} title=${o?.name??"Scene"} kind="Scene">
      ${o&&O(o,"report.html")&&s`<a class="button" href=${M(`v1/scenes/${e}`,"report.html")} download>Download the report</a>`}
      ${J.value?.session_expires_at&&s`<${T} label="Delete" ask="Delete this scene and its files?" run=${r} danger />`}
    <//>
    <${G} base=${["scenes",e]} tabs=${Je} current=${t} />
    <${u} of=${n}>${a=>Fe(a,t)}<//>`}function O(e,t){return e.files.some(n=>n.path===t)}function Fe(e,t){let n=`v1/scenes/${e.id}`;return t==="3d"?O(e,"view.json")?s`<${x} load=${()=>import("./page-HKVMJTQO.js")} name="Viewer" of=${{base:n,driveOf:{[e.name]:e.drive_id},onlyDrive:e.drive_id}} />`:s`<${p}>This scene has no view.json: it was made by an older version, or its points could not be written. Reconstruct it again.<//>`:t==="place"?O(e,"view.json")?e.summary.georeferenced?s`<${x} load=${()=>import("./page-VI5SJ5LZ.js")} name="Place" of=${{base:n}} />`:s`<${p}>This scene has no place on the earth: its drive has no GNSS that could be used.<//>`:s`<${p}>This scene has no view.json: it was made by an older version. Reconstruct it again.<//>`:t==="calibration"?s`<${x} load=${()=>import("./page-FH5ARKJA.js")} name="CalibrationPage" of=${{base:n,driveId:e.drive_id,hasPictures:O(e,"pictures/birds_eye_before.png")}} />`:t==="files"?s`<${W} files=${e.files} />`:s`<${Ve} scene=${e} />`}function Ve({scene:e}){let t=`v1/scenes/${e.id}`,n=m(r=>b(M(t,"report.json"),r),`report ${e.id}`,!1),{summary:o}=e;return s`<dl class="tiles">
      <${i} label="Units registered">${l(o.registered_units)} of ${l(o.units)}<//>
      <${i} label="Images registered">${l(o.registered_images)} of ${l(o.images)}<//>
      <${i} label="Points">${l(o.points)}<//>
      <${i} label="Place on the earth">${o.georeferenced?"by GNSS":"none"}<//>
      <${i} label="Warnings">${o.warnings}<//>
      <${i} label="Made"><${h} at=${e.created_at} /><//>
    </dl>
    <p><a href=${d("drives",e.drive_id)}>The drive</a> · <a href=${d("jobs",e.job_id)}>the job</a> · engine ${o.engine_version}</p>
    <${u} of=${n}>${r=>s`<${se} report=${r} />`}<//>
    ${(o.components??[]).length>1&&s`<h2>Components</h2><p>Nothing links some parts of this drive with the rest: each is a scene of its own.</p>
      <ul>${(o.components??[]).map(r=>s`<li>Component ${r.component} in <code>${r.folder}</code>: ${l(r.registered_units)} units, ${l(r.points)} points</li>`)}</ul>`}
    ${O(e,"pictures/road_before.png")&&s`<h2>Points of the road</h2>
      <${K} before=${M(t,"pictures/road_before.png")} after=${M(t,"pictures/road_after.png")} label="Before and after points off its surface were dropped" />`}`}function se({report:e}){let t=e.summary.mean_reprojection_error_px;return s`<h2>Findings</h2>
    ${(e.findings??[]).length===0?s`<p>None.</p>`:s`<${q} findings=${e.findings} />`}
    ${typeof t=="number"&&s`<p>Mean reprojection error <span data-exact=${t}>${B(t,3)} px</span>.</p>`}
    <h2>Time by stage</h2>
    <${Be} stages=${e.stages} />`}function Be({stages:e}){let t=Math.max(...e.map(n=>n.seconds),1e-9);return s`<table class="bars"><thead class="hidden"><tr><th scope="col">Stage</th><th scope="col">Share</th><th scope="col">Time</th></tr></thead><tbody>${e.map(n=>s`<tr><th scope="row">${n.stage.replaceAll("-"," ")}</th>
      <td><progress max=${t} value=${n.seconds} aria-label=${`time of ${n.stage}`}></progress></td>
      <td class="number">${V(n.seconds)}${n.reused?" (reused)":""}</td></tr>`)}</tbody></table>`}function ge(){let e=m(t=>C("v1/maps",t),"maps");return s`<${v} title="Maps" /><${u} of=${e}>${t=>t.length===0?s`<${p}>No map yet. Choose two or more <a href=${d("drives")}>drives</a> to make one.<//>`:s`<div class="scroll" tabindex="0" role="region" aria-label="Maps"><table>
          <thead><tr><th scope="col">Map</th><th scope="col" class="number">Version</th><th scope="col" class="number">Scenes connected</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col">Created</th></tr></thead>
          <tbody>${t.map(n=>s`<tr key=${n.id}><td><a href=${d("maps",n.id)}>${n.name}</a></td>${Ue(n)}<td><${h} at=${n.created_at} /></td></tr>`)}</tbody></table></div>`}<//>`}function Ue(e){let t=e.version?.summary;return t?s`<td class="number">${e.current_version}</td><td class="number">${t.connected} of ${t.scenes}</td><td class="number">${t.seams}</td><td class="number">${l(t.points)}</td>`:s`<td colspan="4" class="muted">${e.job_id?s`<a href=${d("jobs",e.job_id)}>being made</a>`:"no version yet"}</td>`}var He=[{name:"",label:"Overview"},{name:"3d",label:"3D"},{name:"place",label:"Map"},{name:"seams",label:"Seams"},{name:"versions",label:"Versions"},{name:"files",label:"Files"}];function ve({id:e,tab:t}){let n=m(r=>b(`v1/maps/${e}`,r),e),o=n.value;return s`<${v} title=${o?.name??"Map"} kind="Map" />
    <${G} base=${["maps",e]} tabs=${He} current=${t} />
    <${u} of=${n}>${r=>t==="versions"?s`<${Ye} map=${r} changed=${n.again} />`:r.version?s`<${qe} key=${r.version.number} map=${r} number=${r.version.number} tab=${t} />`:s`<${p}>This map has no version yet.${r.job_id&&s` <a href=${d("jobs",r.job_id)}>Its job</a>`}<//>`}<//>`}function qe({map:e,number:t,tab:n}){let o=`v1/maps/${e.id}/versions/${t}`,r=m(a=>b(o,a),o,!1);return s`<${u} of=${r}>${a=>ze(a,o,n)}<//>`}function ze(e,t,n){if(n==="files")return s`<${W} files=${e.files} />`;if(n==="seams")return s`<${We} version=${e} base=${t} />`;if(n==="3d"){if(!O(e,"view.json"))return s`<${p}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;let o=Object.fromEntries(e.scenes.map(r=>[r.name,r.drive_id]));return s`<${x} load=${()=>import("./page-HKVMJTQO.js")} name="Viewer" of=${{base:t,driveOf:o}} />`}return n==="place"?O(e,"view.json")?e.summary.georeferenced?s`<${x} load=${()=>import("./page-VI5SJ5LZ.js")} name="Place" of=${{base:t}} />`:s`<${p}>This map has no place on the earth: none of its drives has GNSS that could be used.<//>`:s`<${p}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`:s`<${Ge} version=${e} base=${t} />`}function Ge({version:e,base:t}){let n=m(r=>b(M(t,"report.json"),r),`report ${t}`,!1),{summary:o}=e;return s`<dl class="tiles">
      <${i} label="Version">${e.number}<//>
      <${i} label="Scenes connected">${o.connected} of ${o.scenes}<//>
      <${i} label="Seams">${o.seams}<//>
      <${i} label="Images registered">${l(o.registered_images)} of ${l(o.images)}<//>
      <${i} label="Points">${l(o.points)}<//>
      <${i} label="Made"><${h} at=${e.created_at} /><//>
    </dl>
    <h2>Scenes</h2><${Ke} version=${e} />
    ${e.failed.length>0&&s`<h2>Drives without a scene</h2>${e.failed.map(r=>s`<p><a href=${d("drives",r.drive_id)}>${r.name}</a></p><${P} problem=${r.problem} />`)}`}
    <${u} of=${n}>${r=>s`<${se} report=${r} />`}<//>`}function Ke({version:e}){return s`<div class="scroll" tabindex="0" role="region" aria-label="Scenes of the map"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col">Connected</th><th scope="col">Drive</th></tr></thead>
    <tbody>${e.scenes.map(t=>s`<tr><td><a href=${d("scenes",t.scene_id)}>${t.name}</a></td>
        <td>${t.connected?s`<span class="badge good">connected</span>`:s`<span class="badge warn">placed by positions only</span>`}</td>
        <td><a href=${d("drives",t.drive_id)}><code>${t.drive_id}</code></a></td></tr>`)}</tbody></table></div>`}function We({version:e,base:t}){let n=m(o=>b(M(t,"map.json"),o),`map ${t}`,!1);return s`<${u} of=${n}>${o=>s`
    ${o.seams.length===0&&s`<${p}>No two scenes of this map were close enough to look for a seam.<//>`}
    ${o.seams.map(r=>s`<${Qe} seam=${r} base=${t} version=${e} />`)}
    ${e.unconnected.length>0&&s`<h2>Not connected</h2><p>No seam in use connects these scenes with the others; positions place them: ${e.unconnected.join(", ")}.</p>`}`}<//>`}function Qe({seam:e,base:t}){let n=`${e.a} – ${e.b}`,o=(r,a,c)=>a===void 0?null:s`<${i} label=${r}><span data-exact=${a}>${B(a,3)} ${c}</span><//>`;return s`<section class="box"><h2>${n}</h2>
    <p>${e.accepted?s`<span class="badge good">accepted</span>`:s`<span class="badge warn">rejected</span> ${e.reason??"The evidence does not suffice."}`}</p>
    <dl class="tiles">
      ${e.units_tried!==void 0&&s`<${i} label="Units that agree">${e.units_agreeing??0} of ${e.units_tried}<//>`}
      ${e.inliers!==void 0&&s`<${i} label="Shared points">${l(e.inliers)}<//>`}
      ${o("Residual before",e.residual_before_px,"px")}
      ${o("Residual after",e.residual_after_px,"px")}
      ${o("Sigma of the translation",e.sigma_translation_m,"m")}
      ${o("Sigma of the rotation",e.sigma_rotation_deg,"deg")}
      ${o("Scale",e.scale,"")}
    </dl>
    ${e.pictures?s`<${K} before=${M(t,e.pictures.before)} after=${M(t,e.pictures.after)} label="Points of both scenes from above" />`:s`<p class="muted">${e.accepted?"There are no pictures: they were switched off, or no ground of both scenes is seen.":"There are no pictures, because the seam is not used."}</p>`}
  </section>`}function Ye({map:e,changed:t}){let n=m(o=>C(`v1/maps/${e.id}/versions`,o),`versions ${e.id} ${e.current_version}`);return s`<${u} of=${n}>${o=>o.length===0?s`<${p}>No version yet.<//>`:s`<${Xe} map=${e} versions=${o} loaded=${n} changed=${t} />`}<//>`}function Xe({map:e,versions:t,changed:n}){let o=t.map(f=>f.number),[r,a]=g(o[1]??o[0]),[c,w]=g(o[0]),k=async f=>{await y("PUT",`v1/maps/${e.id}/current-version`,{json:{version:f}}),n()},$=(f,re,_e)=>s`<label>${f}
    <select value=${re} onChange=${I=>_e(Number(I.target.value))}>
      ${o.map(I=>s`<option value=${I} selected=${I===re}>Version ${I}</option>`)}</select></label>`,[j,ne]=[t.find(f=>f.number===r),t.find(f=>f.number===c)];return s`<div class="scroll" tabindex="0" role="region" aria-label="Versions"><table>
      <thead><tr><th scope="col" class="number">Version</th><th scope="col">Made</th><th scope="col" class="number">Scenes</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col"></th></tr></thead>
      <tbody>${t.map(f=>s`<tr key=${f.number}><td class="number">${f.number}</td><td><${h} at=${f.created_at} /></td>
          <td class="number">${f.summary.scenes}</td><td class="number">${f.summary.seams}</td><td class="number">${l(f.summary.points)}</td>
          <td>${f.is_current?s`<${S} state="current" />`:s`<${T} label="Make it current" ask=${`Show version ${f.number}?`} run=${()=>k(f.number)} />`}</td></tr>`)}</tbody></table></div>
    <h2>Compare</h2>
    ${o.length<2?s`<p class="muted">There is one version only. An aggregation into this map makes the next.</p>`:s`<div class="inline">${$("From",r,a)} ${$("To",c,w)}</div>${j&&ne&&s`<${et} a=${j} b=${ne} />`}`}`}var Ze=["scenes","connected","seams","registered_units","registered_images","points","warnings"];function et({a:e,b:t}){let n=$=>new Map($.scenes.map(j=>[j.name,j.connected])),[o,r]=[n(e),n(t)],a=[...r.keys()].filter($=>!o.has($)),c=[...o.keys()].filter($=>!r.has($)),w=[...r].filter(([$,j])=>o.has($)&&o.get($)!==j),k=$=>$>0?`+${l($)}`:$<0?`−${l(-$)}`:"same";return s`<table><thead><tr><th scope="col">Figure</th><th scope="col" class="number">Version ${e.number}</th><th scope="col" class="number">Version ${t.number}</th><th scope="col" class="number">Change</th></tr></thead>
      <tbody>${Ze.map($=>s`<tr><th scope="row">${$.replaceAll("_"," ")}</th><td class="number">${l(e.summary[$])}</td><td class="number">${l(t.summary[$])}</td><td class="number">${k(t.summary[$]-e.summary[$])}</td></tr>`)}</tbody></table>
    <ul>
      <li>Scenes added: ${a.join(", ")||"none"}</li>
      <li>Scenes removed: ${c.join(", ")||"none"}</li>
      <li>Connection changed: ${w.map(([$,j])=>`${$} (${j?"connected now":"not connected any more"})`).join(", ")||"none"}</li>
    </ul>`}var tt=5e3;function ye(){let e=m(t=>b("v1/status",t),"status");return R(()=>{let t=setInterval(()=>document.hidden||e.again(),tt);return()=>clearInterval(t)},[]),s`<${v} title="Status" /><${u} of=${e}>${t=>s`<${st} status=${t} />`}<//>`}function st({status:e}){let t=1-e.disk.free_bytes/e.disk.total_bytes;return s`<p><${S} state=${e.status} /> Version ${e.version}</p>
    ${e.reasons.length>0&&s`<ul class="findings">${e.reasons.map(n=>s`<li class="warn">${n}</li>`)}</ul>`}
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
    ${e.workers.length===0?s`<${p}>No worker has reported within the last day. Jobs are accepted and wait.<//>`:s`<div class="scroll" tabindex="0" role="region" aria-label="Workers"><table>
          <thead><tr><th scope="col">Worker</th><th scope="col">Online</th><th scope="col">Queues</th><th scope="col" class="number">Jobs at one time</th><th scope="col">Last report</th></tr></thead>
          <tbody>${e.workers.map(n=>s`<tr><td><code>${n.name}</code></td><td><span class=${`badge ${n.online?"good":"bad"}`}>${n.online?"online":"offline"}</span></td>
              <td>${n.queues.join(", ")}</td><td class="number">${n.concurrency}</td><td><${h} at=${n.seen_at} /></td></tr>`)}</tbody></table></div>`}
    <p><a href="docs">Description of the API</a></p>`}function Se(){let e=m(t=>b("v1/session",t),"session");return s`<${v} title="Key and project" /><${u} of=${e}>${t=>s`
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
    <p><a href=${d("status")}>Status of the service</a></p>`}async function we(){await fetch("v1/session",{method:"DELETE"}),L(null)}var ot=[["drives","Drives"],["jobs","Jobs"],["scenes","Scenes"],["maps","Maps"],["status","Status"],["keys","Key"]],nt={connecting:"connecting …",live:"live",polling:"polling",offline:"offline, tries again"};function rt(e){let[t="drives",n,o=""]=e;return t==="upload"?s`<${x} key="upload" load=${()=>import("./page-JO6KDC6R.js")} name="UploadPage" of=${{}} />`:t==="jobs"?n?s`<${pe} key=${n} id=${n} />`:s`<${$e} />`:t==="scenes"?n?s`<${be} key=${`${n} ${o}`} id=${n} tab=${o} />`:s`<${fe} />`:t==="maps"?n?s`<${ve} key=${`${n} ${o}`} id=${n} tab=${o} />`:s`<${ge} />`:t==="status"?s`<${ye} />`:t==="keys"?s`<${Se} />`:n?s`<${ue} key=${n} id=${n} />`:s`<${me} />`}function at(){let e=ce.value,t=e[0]==="upload"?"drives":e[0]??"drives";return R(()=>{document.querySelector("main h1")?.focus({preventScroll:!0}),window.scrollTo(0,0)},[e.slice(0,2).join("/")]),s`<a class="skip" href="#main" onClick=${it}>Skip to the content</a>
    <header>
      <a class="brand" href=${d("drives")}>MRASfM</a>
      <nav aria-label="Pages">${ot.filter(([n])=>!oe()||n==="scenes"||n==="maps").map(([n,o])=>s`<a href=${d(n)} aria-current=${t===n?"page":void 0}>${o}</a>`)}</nav>
      <div class="session"><span class=${`connection ${H.value}`} role="status" data-connection=${H.value}>${nt[H.value]}</span>
        <span class="muted project">${J.value?.project}</span>
        ${!oe()&&s`<button type="button" onClick=${()=>{we()}}>Log out</button>`}</div>
    </header>
    <main id="main">${rt(e)}</main>`}function it(e){e.preventDefault(),document.querySelector("main h1")?.focus()}function lt(){let e=J.value,t=!!e;return R(()=>{t?le():de()},[t]),e===void 0?s`<main class="login"><p class="muted" aria-busy="true">Loading …</p></main>`:e===null?s`<${he} />`:s`<${at} />`}function oe(){return document.querySelector("meta[name=mrasfm-session]")?.getAttribute("content")==="open"}async function dt(){try{L(oe()||ie()?await b("v1/session"):null)}catch{L(null)}}ae(s`<${lt} />`,document.getElementById("app"));dt();

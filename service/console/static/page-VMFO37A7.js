import{a as I}from"./chunk-Y3GPSS3G.js";import{J as y,N as w,P as O,f as j,p as f,q as P,s as p,w as S,x as u,z as r}from"./chunk-5IVFLYQX.js";var $=["#0b8a8a","#d1720a","#7a4fc4","#c2334d","#3f7d20","#1f6fc2","#8a6d3b","#b0479b"],[x,_,b,z,D]=[800,220,64,28,10];function E({title:e,unit:a,series:n}){let t=n.flatMap(s=>s.points),i=t.map(s=>s.x),[o,c]=[Math.min(...i),Math.max(...i)],d=Math.min(0,...t.map(s=>s.y-s.sigma)),C=Math.max(0,...t.map(s=>s.y+s.sigma)),T=(C-d||1)*.06,[M,H]=[d-T,C+T],v=s=>b+8+(s-o)/(c-o||1)*(x-b-24),m=s=>D+(1-(s-M)/(H-M))*(_-z-D);return r`<figure class="chart"><figcaption>${e}</figcaption>
    <svg viewBox=${`0 0 ${x} ${_}`} role="img" aria-label=${e}>
      ${[d,0,C].filter((s,h,l)=>l.indexOf(s)===h).map(s=>r`<g>
        <line class="axis" x1=${b} x2=${x} y1=${m(s)} y2=${m(s)} />
        <text x=${b-6} y=${m(s)+4} text-anchor="end">${u(s,2)} ${a}</text></g>`)}
      <text x=${b} y=${_-8}>${S(new Date(o).toISOString()).slice(0,16)}</text>
      <text x=${x} y=${_-8} text-anchor="end">${S(new Date(c).toISOString()).slice(0,16)}</text>
      ${n.map((s,h)=>r`<g stroke=${$[h%$.length]} fill="none" stroke-width="1.6">
        <polyline points=${s.points.map(l=>`${v(l.x)},${m(l.y)}`).join(" ")} />
        ${s.points.map(l=>r`<line x1=${v(l.x)} x2=${v(l.x)} y1=${m(l.y-l.sigma)} y2=${m(l.y+l.sigma)} /><circle cx=${v(l.x)} cy=${m(l.y)} r="3" fill=${$[h%$.length]} data-value=${l.y} />`)}
      </g>`)}
    </svg>
    <ul class="legend">${n.map((s,h)=>r`<li><span class="swatch" style=${{background:$[h%$.length]}}></span>${s.name}</li>`)}</ul>
  </figure>`}var g=["x","y","z"];function it({base:e,files:a}){let n=y(t=>Promise.all(a.map(async i=>({name:i.replace(/^calibration\/|\.json$/g,""),document:await f(p(e,i),t)}))),`calibrations ${e}`,!1);return r`<${w} of=${n}>${t=>t.map(({name:i,document:o})=>r`<section class="box" data-scene=${i}><h2>${i}</h2><${R} document=${o} /></section>`)}<//>`}function rt({base:e,driveId:a,hasPictures:n}){let t=y(i=>f(p(e,"calibration.json"),i),`calibration ${e}`,!1);return r`<${w} of=${t}>${i=>r`<${R} document=${i} />`}<//>
    ${n&&r`<h2>The ground from above</h2><${I} before=${p(e,"pictures/birds_eye_before.png")} after=${p(e,"pictures/birds_eye_after.png")} label="All cameras projected onto the road, calibration as given and as refined" />`}
    ${j.value?.session_expires_at&&r`<${V} driveId=${a} />`}`}function R({document:e}){let a=Object.entries(e.cameras).filter(([,t])=>t.wrong).map(([t])=>t),n=e.why===void 0?"The calibration is used as given":`${e.adjusted?"The calibration was refined":"The calibration was kept as given"}: ${e.why}`;return r`<p>${n}.</p>
    ${a.length>0?r`<div class="box bad" role="alert"><strong>Not mounted as given: ${a.join(", ")}</strong><p>The images contradict the calibration of ${a.length===1?"this camera":"these cameras"}. Calibrate anew, or use the refined values where their sigma suffices.</p></div>`:r`<p><span class="badge good">no single camera contradicts its calibration</span></p>`}
    <${k} document=${e} what="rotation" unit="deg" title="Correction of the rotation about the rig's axes" />
    <${k} document=${e} what="translation" unit="m" title="Correction of the position along the rig's axes" />
    <p class="muted small">± is one sigma, with what the lenses may be off by. Observed: the drive's images and positions determine this direction. Only the prior: they do not, and the value is the given one within its uncertainty.</p>
    <${B} document=${e} />
    <${G} document=${e} />`}function k({document:e,what:a,unit:n,title:t}){return r`<h2>${t}</h2>
    <div class="scroll" tabindex="0" role="region" aria-label=${t}><table data-corrections=${a}>
      <thead><tr><th scope="col">Camera</th>${g.map(i=>r`<th scope="col" class="number">${i} [${n}]</th>`)}<th scope="col">Verdict</th></tr></thead>
      <tbody>${Object.entries(e.cameras).map(([i,o])=>r`<tr class=${o.wrong?"wrong":""} data-camera=${i} data-wrong=${String(o.wrong)}>
        <th scope="row">${i}${o.wrong&&r` <span class="badge bad">wrong</span>`}</th>
        ${g.map((c,d)=>r`<td class="number">${F(o,a,d,c)}</td>`)}
        <td>${L(o,a)}</td></tr>`)}</tbody></table></div>`}function F(e,a,n,t){let i=a==="rotation"?"rotation_deg":"translation_m",o=(a==="rotation"?e.difference.rotation_vector_deg:e.difference.translation_m)[n];return A(o,e.sigma?.[i]?.[n],t)}function A(e,a,n){if(a==null)return r`<span data-axis=${n} data-value=${e}>${u(e,3)}</span>`;let t=Math.min(9,Math.max(0,2-Math.floor(Math.log10(a))));return r`<span data-axis=${n} data-value=${e} data-sigma=${a}>${e.toFixed(t)} <span class="muted">± ${a.toFixed(t)}</span></span>`}function L(e,a){let n=e.verdict?.[a]??[];return n.length===0?"not refined":new Set(n).size===1?n[0]:n.map((t,i)=>`${g[i]}: ${t}`).join("; ")}function B({document:e}){let a=Object.entries(e.cameras).filter(([,n])=>n.refined.time_offset_us!==void 0);return a.length===0?null:r`<h2>Time offset of the cameras</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Time offsets"><table data-time-offsets>
      <thead><tr><th scope="col">Camera</th><th scope="col" class="number">Offset [µs]</th><th scope="col">Verdict</th></tr></thead>
      <tbody>${a.map(([n,t])=>r`<tr data-camera=${n}><th scope="row">${n}</th>
        <td class="number">${A(t.refined.time_offset_us,t.sigma?.time_offset_us,"time_offset")}</td><td>${t.verdict?.time_offset??""}</td></tr>`)}</tbody></table></div>`}function G({document:e}){let a=Object.values(e.cameras).some(n=>n.given.params.some((t,i)=>t!==n.refined.params[i]));return r`<h2>Intrinsics</h2>
    ${!a&&r`<p class="muted">They were used as given: no setting asks to refine them.</p>`}
    <div class="scroll" tabindex="0" role="region" aria-label="Intrinsics"><table data-intrinsics>
      <thead><tr><th scope="col">Camera</th><th scope="col">Model</th><th scope="col">Parameter</th><th scope="col" class="number">Given</th><th scope="col" class="number">Refined</th></tr></thead>
      <tbody>${Object.entries(e.cameras).flatMap(([n,t])=>t.param_names.map((i,o)=>r`<tr data-camera=${n} data-param=${i}>
        ${o===0&&r`<th scope="row" rowspan=${t.param_names.length}>${n}</th><td rowspan=${t.param_names.length}>${t.model}<div class="muted small number">${t.width} × ${t.height} px</div></td>`}
        <td>${i}${/^(f|c)/.test(i)?" [px]":""}</td>
        <td class="number" data-value=${t.given.params[o]}>${u(t.given.params[o],6)}</td>
        <td class="number" data-value=${t.refined.params[o]}>${u(t.refined.params[o],6)}</td></tr>`))}</tbody></table></div>`}var N=50;async function U(e,a){let n=await f(`v1/drives/${e}`,a);if(!n.vehicle)return null;let i=(await P(`v1/drives?vehicle=${encodeURIComponent(n.vehicle)}`,a)).slice(0,N).map(async c=>{let[d]=(await f(`v1/scenes?drive_id=${c.id}&limit=1`,a)).items;return d?{at:c.created_at,calibration:await f(`v1/scenes/${d.id}/files/calibration.json`,a)}:null});return(await Promise.all(i)).filter(c=>c!==null).sort((c,d)=>c.at.localeCompare(d.at))}function V({driveId:e}){let a=y(n=>U(e,n).then(t=>({samples:t})),`history ${e}`,!1);return r`<h2>All drives of this vehicle</h2>
    <${w} of=${a}>${({samples:n})=>n===null?r`<${O}>The drive's manifest names no vehicle. With <code>vehicle</code> in it, the corrections of all its drives are plotted here.<//>`:n.length<2?r`<${O}>This is the only drive of its vehicle that has a scene.<//>`:g.map((t,i)=>r`<${E} title=${`Rotation about ${t}, correction in degrees, by date of the drive`} unit="deg" series=${W(n,i)} />`)}<//>`}function W(e,a){return[...new Set(e.flatMap(t=>Object.keys(t.calibration.cameras)))].map(t=>({name:t,points:e.flatMap(i=>{let o=i.calibration.cameras[t];if(!o)return[];let c=o.repeatability?.rotation_deg??o.sigma?.rotation_deg;return[{x:Date.parse(i.at),y:o.difference.rotation_vector_deg[a],sigma:c?.[a]??0}]})}))}export{rt as CalibrationPage,R as Cameras,it as MapCalibration};

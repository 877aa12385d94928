import{a as j}from"./chunk-LAIYJAYL.js";import{C as S,G as _,I as M,j as g,k as T,l as v,m as i,q as C,r as h}from"./chunk-MCIPENF6.js";var p=["#0b8a8a","#d1720a","#7a4fc4","#c2334d","#3f7d20","#1f6fc2","#8a6d3b","#b0479b"],[y,x,u,k,I]=[800,220,64,28,10];function D({title:e,unit:a,series:t}){let r=t.flatMap(o=>o.points),n=r.map(o=>o.x),[s,l]=[Math.min(...n),Math.max(...n)],m=Math.min(0,...r.map(o=>o.y-o.sigma)),w=Math.max(0,...r.map(o=>o.y+o.sigma)),O=(w-m||1)*.06,[P,A]=[m-O,w+O],b=o=>u+8+(o-s)/(l-s||1)*(y-u-24),d=o=>I+(1-(o-P)/(A-P))*(x-k-I);return i`<figure class="chart"><figcaption>${e}</figcaption>
    <svg viewBox=${`0 0 ${y} ${x}`} role="img" aria-label=${e}>
      ${[m,0,w].filter((o,$,c)=>c.indexOf(o)===$).map(o=>i`<g>
        <line class="axis" x1=${u} x2=${y} y1=${d(o)} y2=${d(o)} />
        <text x=${u-6} y=${d(o)+4} text-anchor="end">${h(o,2)} ${a}</text></g>`)}
      <text x=${u} y=${x-8}>${C(new Date(s).toISOString()).slice(0,16)}</text>
      <text x=${y} y=${x-8} text-anchor="end">${C(new Date(l).toISOString()).slice(0,16)}</text>
      ${t.map((o,$)=>i`<g stroke=${p[$%p.length]} fill="none" stroke-width="1.6">
        <polyline points=${o.points.map(c=>`${b(c.x)},${d(c.y)}`).join(" ")} />
        ${o.points.map(c=>i`<line x1=${b(c.x)} x2=${b(c.x)} y1=${d(c.y-c.sigma)} y2=${d(c.y+c.sigma)} /><circle cx=${b(c.x)} cy=${d(c.y)} r="3" fill=${p[$%p.length]} data-value=${c.y} />`)}
      </g>`)}
    </svg>
    <ul class="legend">${t.map((o,$)=>i`<li><span class="swatch" style=${{background:p[$%p.length]}}></span>${o.name}</li>`)}</ul>
  </figure>`}var f=["x","y","z"];function et({base:e,driveId:a,hasPictures:t}){let r=S(n=>g(v(e,"calibration.json"),n),`calibration ${e}`,!1);return i`<${_} of=${r}>${n=>i`<${R} document=${n} />`}<//>
    ${t&&i`<h2>The ground from above</h2><${j} before=${v(e,"pictures/birds_eye_before.png")} after=${v(e,"pictures/birds_eye_after.png")} label="All cameras projected onto the road, calibration as given and as refined" />`}
    <${G} driveId=${a} />`}function R({document:e}){let a=Object.entries(e.cameras).filter(([,t])=>t.wrong).map(([t])=>t);return i`<p>${e.adjusted?"The calibration was refined":"The calibration was kept as given"}: ${e.why}.</p>
    ${a.length>0?i`<div class="box bad" role="alert"><strong>Not mounted as given: ${a.join(", ")}</strong><p>The images contradict the calibration of ${a.length===1?"this camera":"these cameras"}. Calibrate anew, or use the refined values where their sigma suffices.</p></div>`:i`<p><span class="badge good">no camera contradicts its calibration</span></p>`}
    <${E} document=${e} what="rotation" unit="deg" title="Correction of the rotation about the rig's axes" />
    <${E} document=${e} what="translation" unit="m" title="Correction of the position along the rig's axes" />
    <${F} document=${e} />`}function E({document:e,what:a,unit:t,title:r}){return i`<h2>${r}</h2>
    <div class="scroll" tabindex="0" role="region" aria-label=${r}><table data-corrections=${a}>
      <thead><tr><th scope="col">Camera</th>${f.map(n=>i`<th scope="col" class="number">${n} [${t}]</th>`)}<th scope="col">Verdict</th></tr></thead>
      <tbody>${Object.entries(e.cameras).map(([n,s])=>i`<tr class=${s.wrong?"wrong":""} data-camera=${n} data-wrong=${String(s.wrong)}>
        <th scope="row">${n}${s.wrong&&i` <span class="badge bad">wrong</span>`}</th>
        ${f.map((l,m)=>i`<td class="number">${H(s,a,m,l)}</td>`)}
        <td>${z(s,a)}</td></tr>`)}</tbody></table></div>`}function H(e,a,t,r){let n=a==="rotation"?"rotation_deg":"translation_m",s=(a==="rotation"?e.difference.rotation_vector_deg:e.difference.translation_m)[t],l=e.sigma?.[n]?.[t];if(l==null)return i`<span data-axis=${r} data-value=${s}>${h(s,3)}</span>`;let m=Math.min(9,Math.max(0,2-Math.floor(Math.log10(l))));return i`<span data-axis=${r} data-value=${s} data-sigma=${l}>${s.toFixed(m)} <span class="muted">± ${l.toFixed(m)}</span></span>`}function z(e,a){let t=e.verdict?.[a]??[];return t.length===0?"not refined":new Set(t).size===1?t[0]:t.map((r,n)=>`${f[n]}: ${r}`).join("; ")}function F({document:e}){return i`<h2>Intrinsics</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Intrinsics"><table data-intrinsics>
      <thead><tr><th scope="col">Camera</th><th scope="col">Model</th><th scope="col">Parameter</th><th scope="col" class="number">Given</th><th scope="col" class="number">Refined</th></tr></thead>
      <tbody>${Object.entries(e.cameras).flatMap(([a,t])=>t.param_names.map((r,n)=>i`<tr data-camera=${a} data-param=${r}>
        ${n===0&&i`<th scope="row" rowspan=${t.param_names.length}>${a}</th><td rowspan=${t.param_names.length}>${t.model}<div class="muted small number">${t.width} × ${t.height} px</div></td>`}
        <td>${r}${/^(f|c)/.test(r)?" [px]":""}</td>
        <td class="number" data-value=${t.given.params[n]}>${h(t.given.params[n],6)}</td>
        <td class="number" data-value=${t.refined.params[n]}>${h(t.refined.params[n],6)}</td></tr>`))}</tbody></table></div>`}var L=50;async function B(e,a){let t=await g(`v1/drives/${e}`,a);if(!t.vehicle)return null;let n=(await T(`v1/drives?vehicle=${encodeURIComponent(t.vehicle)}`,a)).slice(0,L).map(async l=>{let[m]=(await g(`v1/scenes?drive_id=${l.id}&limit=1`,a)).items;return m?{at:l.created_at,calibration:await g(`v1/scenes/${m.id}/files/calibration.json`,a)}:null});return(await Promise.all(n)).filter(l=>l!==null).sort((l,m)=>l.at.localeCompare(m.at))}function G({driveId:e}){let a=S(t=>B(e,t).then(r=>({samples:r})),`history ${e}`,!1);return i`<h2>All drives of this vehicle</h2>
    <${_} of=${a}>${({samples:t})=>t===null?i`<${M}>The drive's manifest names no vehicle. With <code>vehicle</code> in it, the corrections of all its drives are plotted here.<//>`:t.length<2?i`<${M}>This is the only drive of its vehicle that has a scene.<//>`:f.map((r,n)=>i`<${D} title=${`Rotation about ${r}, correction in degrees, by date of the drive`} unit="deg" series=${N(t,n)} />`)}<//>`}function N(e,a){return[...new Set(e.flatMap(r=>Object.keys(r.calibration.cameras)))].map(r=>({name:r,points:e.flatMap(n=>{let s=n.calibration.cameras[r];return s?[{x:Date.parse(n.at),y:s.difference.rotation_vector_deg[a],sigma:s.sigma?.rotation_deg?.[a]??0}]:[]})}))}export{et as CalibrationPage,R as Cameras};

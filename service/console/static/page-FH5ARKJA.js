import{a as I}from"./chunk-OAFXIFNJ.js";import{C as S,G as _,I as M,e as T,j as g,k as j,l as v,m as r,q as C,r as h}from"./chunk-HFRQZBY7.js";var p=["#0b8a8a","#d1720a","#7a4fc4","#c2334d","#3f7d20","#1f6fc2","#8a6d3b","#b0479b"],[y,x,u,R,D]=[800,220,64,28,10];function E({title:e,unit:a,series:t}){let i=t.flatMap(o=>o.points),n=i.map(o=>o.x),[s,l]=[Math.min(...n),Math.max(...n)],m=Math.min(0,...i.map(o=>o.y-o.sigma)),w=Math.max(0,...i.map(o=>o.y+o.sigma)),O=(w-m||1)*.06,[P,k]=[m-O,w+O],b=o=>u+8+(o-s)/(l-s||1)*(y-u-24),d=o=>D+(1-(o-P)/(k-P))*(x-R-D);return r`<figure class="chart"><figcaption>${e}</figcaption>
    <svg viewBox=${`0 0 ${y} ${x}`} role="img" aria-label=${e}>
      ${[m,0,w].filter((o,$,c)=>c.indexOf(o)===$).map(o=>r`<g>
        <line class="axis" x1=${u} x2=${y} y1=${d(o)} y2=${d(o)} />
        <text x=${u-6} y=${d(o)+4} text-anchor="end">${h(o,2)} ${a}</text></g>`)}
      <text x=${u} y=${x-8}>${C(new Date(s).toISOString()).slice(0,16)}</text>
      <text x=${y} y=${x-8} text-anchor="end">${C(new Date(l).toISOString()).slice(0,16)}</text>
      ${t.map((o,$)=>r`<g stroke=${p[$%p.length]} fill="none" stroke-width="1.6">
        <polyline points=${o.points.map(c=>`${b(c.x)},${d(c.y)}`).join(" ")} />
        ${o.points.map(c=>r`<line x1=${b(c.x)} x2=${b(c.x)} y1=${d(c.y-c.sigma)} y2=${d(c.y+c.sigma)} /><circle cx=${b(c.x)} cy=${d(c.y)} r="3" fill=${p[$%p.length]} data-value=${c.y} />`)}
      </g>`)}
    </svg>
    <ul class="legend">${t.map((o,$)=>r`<li><span class="swatch" style=${{background:p[$%p.length]}}></span>${o.name}</li>`)}</ul>
  </figure>`}var f=["x","y","z"];function at({base:e,driveId:a,hasPictures:t}){let i=S(n=>g(v(e,"calibration.json"),n),`calibration ${e}`,!1);return r`<${_} of=${i}>${n=>r`<${H} document=${n} />`}<//>
    ${t&&r`<h2>The ground from above</h2><${I} before=${v(e,"pictures/birds_eye_before.png")} after=${v(e,"pictures/birds_eye_after.png")} label="All cameras projected onto the road, calibration as given and as refined" />`}
    ${T.value?.session_expires_at&&r`<${N} driveId=${a} />`}`}function H({document:e}){let a=Object.entries(e.cameras).filter(([,t])=>t.wrong).map(([t])=>t);return r`<p>${e.adjusted?"The calibration was refined":"The calibration was kept as given"}: ${e.why}.</p>
    ${a.length>0?r`<div class="box bad" role="alert"><strong>Not mounted as given: ${a.join(", ")}</strong><p>The images contradict the calibration of ${a.length===1?"this camera":"these cameras"}. Calibrate anew, or use the refined values where their sigma suffices.</p></div>`:r`<p><span class="badge good">no camera contradicts its calibration</span></p>`}
    <${A} document=${e} what="rotation" unit="deg" title="Correction of the rotation about the rig's axes" />
    <${A} document=${e} what="translation" unit="m" title="Correction of the position along the rig's axes" />
    <${L} document=${e} />`}function A({document:e,what:a,unit:t,title:i}){return r`<h2>${i}</h2>
    <div class="scroll" tabindex="0" role="region" aria-label=${i}><table data-corrections=${a}>
      <thead><tr><th scope="col">Camera</th>${f.map(n=>r`<th scope="col" class="number">${n} [${t}]</th>`)}<th scope="col">Verdict</th></tr></thead>
      <tbody>${Object.entries(e.cameras).map(([n,s])=>r`<tr class=${s.wrong?"wrong":""} data-camera=${n} data-wrong=${String(s.wrong)}>
        <th scope="row">${n}${s.wrong&&r` <span class="badge bad">wrong</span>`}</th>
        ${f.map((l,m)=>r`<td class="number">${z(s,a,m,l)}</td>`)}
        <td>${F(s,a)}</td></tr>`)}</tbody></table></div>`}function z(e,a,t,i){let n=a==="rotation"?"rotation_deg":"translation_m",s=(a==="rotation"?e.difference.rotation_vector_deg:e.difference.translation_m)[t],l=e.sigma?.[n]?.[t];if(l==null)return r`<span data-axis=${i} data-value=${s}>${h(s,3)}</span>`;let m=Math.min(9,Math.max(0,2-Math.floor(Math.log10(l))));return r`<span data-axis=${i} data-value=${s} data-sigma=${l}>${s.toFixed(m)} <span class="muted">± ${l.toFixed(m)}</span></span>`}function F(e,a){let t=e.verdict?.[a]??[];return t.length===0?"not refined":new Set(t).size===1?t[0]:t.map((i,n)=>`${f[n]}: ${i}`).join("; ")}function L({document:e}){return r`<h2>Intrinsics</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Intrinsics"><table data-intrinsics>
      <thead><tr><th scope="col">Camera</th><th scope="col">Model</th><th scope="col">Parameter</th><th scope="col" class="number">Given</th><th scope="col" class="number">Refined</th></tr></thead>
      <tbody>${Object.entries(e.cameras).flatMap(([a,t])=>t.param_names.map((i,n)=>r`<tr data-camera=${a} data-param=${i}>
        ${n===0&&r`<th scope="row" rowspan=${t.param_names.length}>${a}</th><td rowspan=${t.param_names.length}>${t.model}<div class="muted small number">${t.width} × ${t.height} px</div></td>`}
        <td>${i}${/^(f|c)/.test(i)?" [px]":""}</td>
        <td class="number" data-value=${t.given.params[n]}>${h(t.given.params[n],6)}</td>
        <td class="number" data-value=${t.refined.params[n]}>${h(t.refined.params[n],6)}</td></tr>`))}</tbody></table></div>`}var B=50;async function G(e,a){let t=await g(`v1/drives/${e}`,a);if(!t.vehicle)return null;let n=(await j(`v1/drives?vehicle=${encodeURIComponent(t.vehicle)}`,a)).slice(0,B).map(async l=>{let[m]=(await g(`v1/scenes?drive_id=${l.id}&limit=1`,a)).items;return m?{at:l.created_at,calibration:await g(`v1/scenes/${m.id}/files/calibration.json`,a)}:null});return(await Promise.all(n)).filter(l=>l!==null).sort((l,m)=>l.at.localeCompare(m.at))}function N({driveId:e}){let a=S(t=>G(e,t).then(i=>({samples:i})),`history ${e}`,!1);return r`<h2>All drives of this vehicle</h2>
    <${_} of=${a}>${({samples:t})=>t===null?r`<${M}>The drive's manifest names no vehicle. With <code>vehicle</code> in it, the corrections of all its drives are plotted here.<//>`:t.length<2?r`<${M}>This is the only drive of its vehicle that has a scene.<//>`:f.map((i,n)=>r`<${E} title=${`Rotation about ${i}, correction in degrees, by date of the drive`} unit="deg" series=${U(t,n)} />`)}<//>`}function U(e,a){return[...new Set(e.flatMap(i=>Object.keys(i.calibration.cameras)))].map(i=>({name:i,points:e.flatMap(n=>{let s=n.calibration.cameras[i];return s?[{x:Date.parse(n.at),y:s.difference.rotation_vector_deg[a],sigma:s.sigma?.rotation_deg?.[a]??0}]:[]})}))}export{at as CalibrationPage,H as Cameras};

import{b as a,z as r}from"./chunk-5IVFLYQX.js";function f({before:i,after:n,label:e}){let[t,s]=a(50);return r`<figure class="slider">
    <div class="stack">
      <img src=${i} alt=${`${e}, before`} loading="lazy" />
      <img src=${n} alt=${`${e}, after`} loading="lazy" style=${{clipPath:`inset(0 0 0 ${t}%)`}} />
      <div class="edge" style=${{left:`${t}%`}}></div>
    </div>
    <div class="edge-control"><span aria-hidden="true">before</span><input type="range" min="0" max="100" value=${t} aria-label=${`${e}: edge between before and after, in percent of the width`}
      onInput=${o=>s(Number(o.target.value))} /><span aria-hidden="true">after</span></div>
    <figcaption>${e}</figcaption>
  </figure>`}export{f as a};

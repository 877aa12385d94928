import{b as a,k as r}from"./chunk-6M3ZGUBW.js";function g({before:i,after:n,label:e}){let[t,s]=a(50);return r`<figure class="slider">
    <div class="stack">
      <img src=${i} alt=${`${e}, before`} loading="lazy" />
      <img src=${n} alt=${`${e}, after`} loading="lazy" style=${{clipPath:`inset(0 0 0 ${t}%)`}} />
      <div class="edge" style=${{left:`${t}%`}}></div>
      <span class="tag left">before</span><span class="tag right">after</span>
    </div>
    <input type="range" min="0" max="100" value=${t} aria-label=${`${e}: edge between before and after, in percent of the width`}
      onInput=${f=>s(Number(f.target.value))} />
    <figcaption>${e}: before left of the edge, after right of it</figcaption>
  </figure>`}export{g as a};

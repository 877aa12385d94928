// Two pictures of one place, one over the other; a slider moves the edge between them.
import { useState } from "preact/hooks";
import { html, type Shown } from "./html";

export function Slider({ before, after, label }: { before: string; after: string; label: string }): Shown {
  const [share, setShare] = useState(50);
  return html`<figure class="slider">
    <div class="stack">
      <img src=${before} alt=${`${label}, before`} loading="lazy" />
      <img src=${after} alt=${`${label}, after`} loading="lazy" style=${{ clipPath: `inset(0 0 0 ${share}%)` }} />
      <div class="edge" style=${{ left: `${share}%` }}></div>
    </div>
    <div class="edge-control"><span aria-hidden="true">before</span><input type="range" min="0" max="100" value=${share} aria-label=${`${label}: edge between before and after, in percent of the width`}
      onInput=${(event: Event) => setShare(Number((event.target as HTMLInputElement).value))} /><span aria-hidden="true">after</span></div>
    <figcaption>${label}</figcaption>
  </figure>`;
}

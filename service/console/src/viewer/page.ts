// The page's part with the scene in 3D, and the image of a frustum beside it.
import { useEffect, useRef, useState } from "preact/hooks";
import { fileUrl, get, type Problem } from "../client";
import { Content, ProblemBox, useLoad } from "../components";
import { bytes, count } from "../format";
import { html, type Shown } from "../html";
import { Photo } from "./photo";
import { Scene3D, type Figures, type Picked } from "./scene3d";
import type { ViewDocument } from "./document";

interface Props {
  base: string;
  driveOf: Record<string, string>;
  onlyDrive?: string;
}

export function Viewer(props: Props): Shown {
  const loaded = useLoad((abort) => get<ViewDocument>(fileUrl(props.base, "view.json"), abort), `view ${props.base}`, false);
  return html`<${Content} of=${loaded}>${(view: ViewDocument) => html`<${View} ...${props} view=${view} />`}<//>`;
}

function View({ base, driveOf, onlyDrive, view }: Props & { view: ViewDocument }): Shown {
  const canvas = useRef<HTMLCanvasElement>(null);
  const shown = useRef<Scene3D | null>(null);
  const [figures, setFigures] = useState<Figures | null>(null);
  const [picked, setPicked] = useState<Picked | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [size, setSize] = useState(2);
  const without3d = (detail: string): void => setProblem({ title: "This browser shows no 3D", detail, remedy: "Switch on hardware acceleration or take a newer browser, or open points.copc.laz in another program." });
  useEffect(() => {
    try {
      const urls = { points: new URL(fileUrl(base, view.points), location.href).href, worker: new URL("points.js", import.meta.url).href, renderer: new URL("render.js", import.meta.url).href, wasm: new URL("laz-perf.wasm", import.meta.url).href };
      shown.current = new Scene3D(canvas.current!, view, urls, {
        figures: setFigures,
        failed: (detail) => setProblem({ title: "The points cannot be shown", detail, remedy: "Load the page again; the file itself can be downloaded under Files." }),
        without3d,
        picked: (found) => choose(found, false),
      });
      // Tests and the curious ask where a position is on the screen.
      Object.assign(canvas.current!, { scene3d: shown.current });
    } catch (error) {
      without3d(error instanceof Error ? error.message : String(error));
    }
    return () => shown.current?.close();
  }, []);
  const choose = (found: Picked, look: boolean): void => {
    setPicked(found);
    shown.current?.mark(found, look);
  };
  const cameras = view.scenes.reduce((sum, scene) => sum + scene.images.length, 0);
  return html`${problem && html`<${ProblemBox} problem=${problem} />`}
    <div class="inline toolbar">
      <button type="button" onClick=${() => shown.current?.home()}>Show all</button>
      <button type="button" onClick=${() => shown.current?.above()}>From above</button>
      <label>Size of points <select value=${size} onChange=${(event: Event) => { const value = Number((event.target as HTMLSelectElement).value); setSize(value); shown.current?.setPointSize(value); }}>
        ${[1, 2, 3, 5].map((value) => html`<option value=${value} selected=${value === size}>${value} px</option>`)}</select></label>
      <label><input type="checkbox" checked onChange=${(event: Event) => shown.current?.showFrusta((event.target as HTMLInputElement).checked)} /> Cameras</label>
    </div>
    <div class=${picked ? "viewer" : "viewer wide"}>
      <div>
        <div class="canvas"><canvas ref=${canvas} tabindex="0" aria-label="The scene in 3D: drag to turn, scroll to zoom, arrow keys to move, click a camera to see its image"></canvas>
          <div class="figures" data-shown=${figures?.shown ?? 0} data-total=${figures?.total ?? 0} data-bytes=${figures?.bytes ?? 0} data-first-ms=${figures?.firstMs ?? ""} data-idle=${String(figures?.isIdle ?? false)}>
            ${figures ? `${count(figures.shown)} of ${count(figures.total)} points, ${bytes(figures.bytes)} read` : "loading the points …"}</div></div>
        <ul class="legend">${view.scenes.map((scene) => html`<li><span class="swatch" style=${{ background: scene.color }}></span>${scene.name}: ${count(scene.trajectory_m.length)} units</li>`)}
          <li>${count(cameras)} images; click the frustum of one</li><li>${view.epsg ? `EPSG:${view.epsg}, ellipsoidal heights, metres` : "local frame, metres"}</li></ul>
      </div>
      ${picked && html`<${Photo} key=${`${picked.scene.name} ${picked.image.file}`} base=${base} view=${view} picked=${picked} drive=${driveOf[picked.scene.name] ?? onlyDrive ?? ""} choose=${(found: Picked) => choose(found, true)} />`}
    </div>
    <details class="box"><summary>Choose an image without the mouse</summary><${ImageList} view=${view} choose=${(found: Picked) => choose(found, true)} /></details>`;
}

function ImageList({ view, choose }: { view: ViewDocument; choose: (picked: Picked) => void }): Shown {
  const all = view.scenes.flatMap((scene) => scene.images.map((image) => ({ scene, image })));
  const [index, setIndex] = useState(0);
  return html`<div class="inline"><label>Image <input type="number" min="1" max=${all.length} value=${index + 1} onInput=${(event: Event) => setIndex(Number((event.target as HTMLInputElement).value) - 1)} /> of ${count(all.length)}</label>
    <button type="button" disabled=${!all[index]} onClick=${() => choose(all[index]!)}>Show</button><code>${all[index]?.image.file ?? ""}</code></div>`;
}

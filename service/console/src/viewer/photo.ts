// An image of the drive with the observations of its points.
import { useEffect, useRef, useState } from "preact/hooks";
import { fileUrl, send } from "../client";
import { Empty } from "../components";
import { count } from "../format";
import { html, type Shown } from "../html";
import type { ViewDocument } from "./document";
import type { Picked } from "./scene3d";

const ROW_BYTES = 24; // x, y and the point's id
const NO_POINT = 0xffff_ffff;

interface Props {
  base: string;
  view: ViewDocument;
  picked: Picked;
  drive: string;
  choose: (picked: Picked) => void;
}

async function observed(url: string, [first, rows]: [number, number], abort: AbortSignal): Promise<Float64Array> {
  if (rows === 0) return new Float64Array(0);
  const range = `bytes=${first}-${first + rows * ROW_BYTES - 1}`;
  const answer = await send("GET", url, { headers: { Range: range }, signal: abort });
  const data = new DataView(await answer.arrayBuffer());
  const found: number[] = [];
  for (let row = 0; row < rows; row += 1) {
    const at = row * ROW_BYTES;
    const isFree = data.getUint32(at + 16, true) === NO_POINT && data.getUint32(at + 20, true) === NO_POINT;
    if (!isFree) found.push(data.getFloat64(at, true), data.getFloat64(at + 8, true));
  }
  return Float64Array.from(found);
}

export function Photo({ base, view, picked, drive, choose }: Props): Shown {
  const { image, scene } = picked;
  const overlay = useRef<HTMLCanvasElement>(null);
  const [points, setPoints] = useState<Float64Array | null>(null);
  const [isMissing, setMissing] = useState(false);
  const [isShown, setShown] = useState(true);
  useEffect(() => {
    const abort = new AbortController();
    observed(fileUrl(base, view.observations), image.observations, abort.signal).then(setPoints, () => undefined);
    return () => abort.abort();
  }, []);
  useEffect(() => {
    if (points && overlay.current) drawPoints(overlay.current, image.size_px, isShown ? points : new Float64Array(0), scene.color);
  }, [points, isShown]);
  const neighbour = (step: number): Picked | undefined => {
    const mine = scene.images.filter((other) => other.camera === image.camera);
    const found = mine[mine.indexOf(image) + step];
    return found && { scene, image: found };
  };
  const [before, after] = [neighbour(-1), neighbour(1)];
  return html`<aside class="box" aria-label="Image of the camera"><h2>${image.camera}</h2>
    <p class="small"><code>${image.file}</code><br />unit ${image.unit} of ${scene.name}</p>
    ${isMissing
      ? html`<${Empty}>The image is not here: its drive was deleted, or was not given to mrasfm view with --drive.<//>`
      : html`<div class="photo"><img src=${fileUrl(`v1/drives/${drive}`, image.file)} alt=${`Image ${image.file}`} onError=${() => setMissing(true)} /><canvas ref=${overlay}></canvas></div>`}
    <p data-observations=${points ? points.length / 2 : ""}>${points ? `${count(points.length / 2)} observations` : "reading the observations …"}, ${image.size_px[0]} × ${image.size_px[1]} px</p>
    <div class="inline"><label><input type="checkbox" checked=${isShown} onChange=${(event: Event) => setShown((event.target as HTMLInputElement).checked)} /> Observations</label>
      <button type="button" disabled=${!before} onClick=${() => before && choose(before)}>Previous image</button>
      <button type="button" disabled=${!after} onClick=${() => after && choose(after)}>Next image</button></div>
  </aside>`;
}

function drawPoints(canvas: HTMLCanvasElement, [width, height]: [number, number], points: Float64Array, color: string): void {
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d")!;
  context.clearRect(0, 0, width, height);
  context.strokeStyle = color;
  context.lineWidth = Math.max(1, width / 700);
  const radius = Math.max(2, width / 320);
  for (let at = 0; at < points.length; at += 2) {
    context.beginPath();
    context.arc(points[at]!, points[at + 1]!, radius, 0, 2 * Math.PI);
    context.stroke();
  }
}

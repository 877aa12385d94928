// Exports of a scene, one of its components, or a map's version: ask for one, and what there is.
import { useState } from "preact/hooks";
import { get, getShown, send, session, type Export, type ExportFormat, type ExportRequest, type Problem, type Scene } from "../client";
import { Badge, Confirm, Content, Empty, problemOf, ProblemBox, Time, useLoad } from "../components";
import { bytes, count, plural } from "../format";
import { html, type Shown } from "../html";
import { link } from "../router";
import { FileTable } from "./files";

// The compiler wants a line for each format of the API.
const FORMATS: Record<ExportFormat, string> = {
  colmap: "COLMAP, 3D Gaussian Splatting: pinhole images, masks, model",
  nerfstudio: "nerfstudio: transforms.json, images, masks",
  nuscenes: "nuScenes: its tables and images",
  mcap: "MCAP for Foxglove, Lichtblick, rerun",
  copc: "points in a coordinate reference system (COPC)",
  geopackage: "positions in a coordinate reference system (GeoPackage)",
  geotiff: "picture of the road in a coordinate reference system (GeoTIFF)",
  kitti: "poses as in KITTI odometry",
  geojson: "positions for web maps (GeoJSON)",
};
const CRS = "EPSG:[0-9]{4,6}(\\+[0-9]{4,6})?";
type Component = NonNullable<Scene["summary"]["components"]>[number];

interface Exported {
  base: string;
  components?: readonly Component[];
}

export function Exports(of: Exported): Shown {
  if (!session.value?.session_expires_at) return null; // a folder that is viewed: there is no service that could
  return html`<${OfService} ...${of} />`;
}

function OfService({ base, components = [] }: Exported): Shown {
  const loaded = useLoad((abort) => getShown<Export>(`${base}/exports`, abort), `exports ${base}`);
  return html`<h2>Exports</h2>
    <p class="muted">Formats that have the images in them, or a coordinate reference system of your choice, are made by a job.</p>
    <${Ask} base=${base} components=${components} asked=${loaded.again} />
    <${Content} of=${loaded}>${(exports: Export[]) =>
      exports.length === 0 ? html`<${Empty}>No export yet.<//>` : exports.map((one) => html`<${Made} key=${one.id} export=${one} changed=${loaded.again} />`)}<//>`;
}

/** Components that are scenes of their own, in `components/N`, by N. */
function apart(components: readonly Component[]): [number, Component][] {
  return components.flatMap((part) => {
    const found = /^components\/(\d+)$/.exec(part.folder);
    return found ? [[Number(found[1]), part] as [number, Component]] : [];
  });
}

function Ask({ base, components, asked }: { base: string; components: readonly Component[]; asked: () => void }): Shown {
  const [formats, setFormats] = useState<readonly ExportFormat[]>([]);
  const [component, setComponent] = useState(0);
  const [crs, setCrs] = useState("");
  const [problem, setProblem] = useState<Problem | null>(null);
  const [isBusy, setBusy] = useState(false);
  const parts = apart(components);
  const choose = (name: ExportFormat, isChosen: boolean): void => setFormats(isChosen ? [...formats, name] : formats.filter((other) => other !== name));
  const ask = async (event: Event): Promise<void> => {
    event.preventDefault();
    setBusy(true);
    setProblem(null);
    const json: ExportRequest = { formats: [...formats], crs: crs || null, component: component || null };
    try {
      await send("POST", `${base}/exports`, { json });
      asked();
    } catch (error) {
      setProblem(problemOf(error));
    }
    setBusy(false);
  };
  return html`<form class="box" onSubmit=${(event: Event) => void ask(event)}>
    <fieldset class="options"><legend>Formats</legend>
      ${(Object.keys(FORMATS) as ExportFormat[]).map(
        (name) => html`<label><input type="checkbox" checked=${formats.includes(name)} onChange=${(event: Event) => choose(name, (event.target as HTMLInputElement).checked)} /> ${FORMATS[name]}</label>`,
      )}</fieldset>
    <div class="inline">
      ${parts.length > 0 && html`<label>Part of the drive
        <select value=${component} onChange=${(event: Event) => setComponent(Number((event.target as HTMLSelectElement).value))}>
          <option value="0">The scene itself</option>
          ${parts.map(([number, part]) => html`<option value=${number}>Component ${part.component}: ${plural(part.registered_units, "unit")}</option>`)}</select></label>`}
      <label>Coordinate reference system <input size="12" placeholder="the format's own" pattern=${CRS} title="as EPSG:25832" value=${crs} onInput=${(event: Event) => setCrs((event.target as HTMLInputElement).value.trim())} /></label>
      <button class="primary" disabled=${formats.length === 0 || isBusy}>Export</button>
    </div>
    ${problem && html`<${ProblemBox} problem=${problem} />`}
  </form>`;
}

function Made({ export: made, changed }: { export: Export; changed: () => void }): Shown {
  const remove = async (): Promise<void> => {
    await send("DELETE", `v1/exports/${made.id}`);
    changed();
  };
  const options = [made.component && `component ${made.component}`, made.crs, made.image_size_px && `images of at most ${made.image_size_px} px`];
  const isThere = made.state === "SUCCEEDED";
  return html`<section class="box" data-export=${made.id}><h3>${[made.formats.join(", "), ...options.filter(Boolean)].join(" · ")}</h3>
    <p><${Badge} state=${made.state} /> <a href=${link("jobs", made.job_id)}>Its job</a> · <${Time} at=${made.created_at} /></p>
    ${made.problem && html`<${ProblemBox} problem=${made.problem} />`}
    ${made.results.map(
      (result) => html`<p><strong>${result.format}</strong>: ${result.withheld ? html`withheld: ${result.withheld}` : `${plural(result.files, "file")}, ${bytes(result.size_bytes)}`}</p>
        ${(result.notes ?? []).length > 0 && html`<ul>${(result.notes ?? []).map((note) => html`<li>${note}</li>`)}</ul>`}`,
    )}
    ${isThere && html`<${FilesOf} id=${made.id} />`}
    ${(isThere || made.state === "FAILED" || made.state === "CANCELLED") && html`<${Confirm} label="Delete" ask="Delete this export and its files?" run=${remove} danger />`}
  </section>`;
}

function FilesOf({ id }: { id: string }): Shown {
  const [isOpen, setIsOpen] = useState(false);
  return html`<details onToggle=${(event: Event) => setIsOpen((event.target as HTMLDetailsElement).open)}><summary>Files</summary>
    ${isOpen && html`<${OpenFiles} id=${id} />`}</details>`;
}

const SHOWN = 200;

function OpenFiles({ id }: { id: string }): Shown {
  const loaded = useLoad((abort) => get<Export>(`v1/exports/${id}`, abort), `export ${id}`, false);
  return html`<${Content} of=${loaded}>${({ files }: Export) => html`<${FileTable} files=${files.slice(0, SHOWN)} label="Files of the export" />
    ${files.length > SHOWN && html`<p class="muted">The first ${SHOWN} of ${count(files.length)} files. All of them come with <code>mrasfm-client download ${id} --out DIR</code>.</p>`}`}<//>`;
}

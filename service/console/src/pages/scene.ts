import { fileUrl, get, getShown, send, session, type Finding, type Scene } from "../client";
import { Confirm, Content, Empty, Findings, Heading, Tabs, Tile, Time, useLoad } from "../components";
import { count, duration, significant } from "../format";
import { html, type Children, type Shown } from "../html";
import { Lazy } from "../lazy";
import { go, link } from "../router";
import { Slider } from "../slider";
import { SceneTable } from "./drives";
import { Exports } from "./exports";
import { Files } from "./files";

export interface Report {
  findings?: Finding[];
  stages: { stage: string; seconds: number; reused?: boolean }[];
  summary: Record<string, unknown>;
}

export function Scenes(): Shown {
  const loaded = useLoad((abort) => getShown<Scene>("v1/scenes", abort), "scenes");
  return html`<${Heading} title="Scenes" /><${Content} of=${loaded}>${(scenes: Scene[]) =>
    scenes.length === 0
      ? html`<${Empty}>No scene yet. A reconstruction makes a scene of a <a href=${link("drives")}>drive</a>.<//>`
      : html`<${SceneTable} scenes=${scenes} />`}<//>`;
}

const TABS = [
  { name: "", label: "Overview" },
  { name: "3d", label: "3D" },
  { name: "place", label: "Map" },
  { name: "calibration", label: "Calibration" },
  { name: "files", label: "Files" },
];

export function ScenePage({ id, tab }: { id: string; tab: string }): Shown {
  const loaded = useLoad((abort) => get<Scene>(`v1/scenes/${id}`, abort), id, false);
  const scene = loaded.value;
  const remove = async (): Promise<void> => {
    await send("DELETE", `v1/scenes/${id}`);
    go("scenes");
  };
  return html`<${Heading} title=${scene?.name ?? "Scene"} kind="Scene">
      ${scene && hasFile(scene, "report.html") && html`<a class="button" href=${fileUrl(`v1/scenes/${id}`, "report.html")} download>Download the report</a>`}
      ${session.value?.session_expires_at && html`<${Confirm} label="Delete" ask="Delete this scene and its files?" run=${remove} danger />`}
    <//>
    <${Tabs} base=${["scenes", id]} tabs=${TABS} current=${tab} />
    <${Content} of=${loaded}>${(shown: Scene) => sceneTab(shown, tab)}<//>`;
}

export function hasFile(of: { files: readonly { path: string }[] }, path: string): boolean {
  return of.files.some((file) => file.path === path);
}

function sceneTab(scene: Scene, tab: string): Children {
  const base = `v1/scenes/${scene.id}`;
  if (tab === "3d") {
    return hasFile(scene, "view.json")
      ? html`<${Lazy} load=${() => import("../viewer/page")} name="Viewer" of=${{ base, driveOf: { [scene.name]: scene.drive_id }, onlyDrive: scene.drive_id }} />`
      : html`<${Empty}>This scene has no view.json: it was made by an older version, or its points could not be written. Reconstruct it again.<//>`;
  }
  if (tab === "place") {
    if (!hasFile(scene, "view.json")) return html`<${Empty}>This scene has no view.json: it was made by an older version. Reconstruct it again.<//>`;
    if (!scene.summary.georeferenced) return html`<${Empty}>This scene has no place on the earth: its drive has no GNSS that could be used.<//>`;
    return html`<${Lazy} load=${() => import("../place/page")} name="Place" of=${{ base }} />`;
  }
  if (tab === "calibration") return html`<${Lazy} load=${() => import("../calibration/page")} name="CalibrationPage" of=${{ base, driveId: scene.drive_id, hasPictures: hasFile(scene, "pictures/birds_eye_before.png") }} />`;
  if (tab === "files") return html`<${Files} files=${scene.files} /><${Exports} base=${base} components=${scene.summary.components ?? []} />`;
  return html`<${Overview} scene=${scene} />`;
}

function Overview({ scene }: { scene: Scene }): Shown {
  const base = `v1/scenes/${scene.id}`;
  const loaded = useLoad((abort) => get<Report>(fileUrl(base, "report.json"), abort), `report ${scene.id}`, false);
  const { summary } = scene;
  return html`<dl class="tiles">
      <${Tile} label="Units registered">${count(summary.registered_units)} of ${count(summary.units)}<//>
      <${Tile} label="Images registered">${count(summary.registered_images)} of ${count(summary.images)}<//>
      <${Tile} label="Points">${count(summary.points)}<//>
      <${Tile} label="Place on the earth">${summary.georeferenced ? "by GNSS" : "none"}<//>
      <${Tile} label="Warnings">${summary.warnings}<//>
      <${Tile} label="Made"><${Time} at=${scene.created_at} /><//>
    </dl>
    <p><a href=${link("drives", scene.drive_id)}>The drive</a> · <a href=${link("jobs", scene.job_id)}>the job</a> · engine ${summary.engine_version}</p>
    <${Content} of=${loaded}>${(report: Report) => html`<${ReportParts} report=${report} />`}<//>
    ${(summary.components ?? []).length > 1 && html`<h2>Components</h2><p>Nothing links some parts of this drive with the rest: each is a scene of its own.</p>
      <ul>${(summary.components ?? []).map((part) => html`<li>Component ${part.component} in <code>${part.folder}</code>: ${count(part.registered_units)} units, ${count(part.points)} points</li>`)}</ul>`}
    ${hasFile(scene, "pictures/road_before.png") && html`<h2>Points of the road</h2>
      <${Slider} before=${fileUrl(base, "pictures/road_before.png")} after=${fileUrl(base, "pictures/road_after.png")} label="Before and after points off its surface were dropped" />`}`;
}

export function ReportParts({ report }: { report: Report }): Shown {
  const error = report.summary.mean_reprojection_error_px;
  return html`<h2>Findings</h2>
    ${(report.findings ?? []).length === 0 ? html`<p>None.</p>` : html`<${Findings} findings=${report.findings} />`}
    ${typeof error === "number" && html`<p>Mean reprojection error <span data-exact=${error}>${significant(error, 3)} px</span>.</p>`}
    <h2>Time by stage</h2>
    <${Stages} stages=${report.stages} />`;
}

function Stages({ stages }: { stages: Report["stages"] }): Shown {
  const longest = Math.max(...stages.map((stage) => stage.seconds), 1e-9);
  return html`<table class="bars"><thead class="hidden"><tr><th scope="col">Stage</th><th scope="col">Share</th><th scope="col">Time</th></tr></thead><tbody>${stages.map(
    (stage) => html`<tr><th scope="row">${stage.stage.replaceAll("-", " ")}</th>
      <td><progress max=${longest} value=${stage.seconds} aria-label=${`time of ${stage.stage}`}></progress></td>
      <td class="number">${duration(stage.seconds)}${stage.reused ? " (reused)" : ""}</td></tr>`,
  )}</tbody></table>`;
}

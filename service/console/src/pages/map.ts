import { useState } from "preact/hooks";
import { fileUrl, get, getShown, send, type MapResource, type MapVersion } from "../client";
import { Badge, Confirm, Content, Empty, Heading, ProblemBox, Tabs, Tile, Time, useLoad, type Loaded } from "../components";
import { count, significant } from "../format";
import { html, type Children, type Shown } from "../html";
import { Lazy } from "../lazy";
import { link } from "../router";
import { Slider } from "../slider";
import { Exports } from "./exports";
import { Files } from "./files";
import { hasFile, ReportParts, type Report } from "./scene";

export function Maps(): Shown {
  const loaded = useLoad((abort) => getShown<MapResource>("v1/maps", abort), "maps");
  return html`<${Heading} title="Maps" /><${Content} of=${loaded}>${(maps: MapResource[]) =>
    maps.length === 0
      ? html`<${Empty}>No map yet. Choose two or more <a href=${link("drives")}>drives</a> to make one.<//>`
      : html`<div class="scroll" tabindex="0" role="region" aria-label="Maps"><table>
          <thead><tr><th scope="col">Map</th><th scope="col" class="number">Version</th><th scope="col" class="number">Scenes connected</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col">Created</th></tr></thead>
          <tbody>${maps.map((map) => html`<tr key=${map.id}><td><a href=${link("maps", map.id)}>${map.name}</a></td>${summaryCells(map)}<td><${Time} at=${map.created_at} /></td></tr>`)}</tbody></table></div>`}<//>`;
}

function summaryCells(map: MapResource): Shown {
  const summary = map.version?.summary;
  if (!summary) return html`<td colspan="4" class="muted">${map.job_id ? html`<a href=${link("jobs", map.job_id)}>being made</a>` : "no version yet"}</td>`;
  return html`<td class="number">${map.current_version}</td><td class="number">${summary.connected} of ${summary.scenes}</td><td class="number">${summary.seams}</td><td class="number">${count(summary.points)}</td>`;
}

const TABS = [
  { name: "", label: "Overview" },
  { name: "3d", label: "3D" },
  { name: "place", label: "Map" },
  { name: "seams", label: "Seams" },
  { name: "calibration", label: "Calibration" },
  { name: "versions", label: "Versions" },
  { name: "files", label: "Files" },
];

export function MapPage({ id, tab }: { id: string; tab: string }): Shown {
  const loaded = useLoad((abort) => get<MapResource>(`v1/maps/${id}`, abort), id);
  const map = loaded.value;
  return html`<${Heading} title=${map?.name ?? "Map"} kind="Map" />
    <${Tabs} base=${["maps", id]} tabs=${TABS} current=${tab} />
    <${Content} of=${loaded}>${(shown: MapResource) => {
      if (tab === "versions") return html`<${Versions} map=${shown} changed=${loaded.again} />`;
      if (!shown.version) return html`<${Empty}>This map has no version yet.${shown.job_id && html` <a href=${link("jobs", shown.job_id)}>Its job</a>`}<//>`;
      return html`<${WithVersion} key=${shown.version.number} map=${shown} number=${shown.version.number} tab=${tab} />`;
    }}<//>`;
}

function WithVersion({ map, number, tab }: { map: MapResource; number: number; tab: string }): Shown {
  const base = `v1/maps/${map.id}/versions/${number}`;
  const loaded = useLoad((abort) => get<MapVersion>(base, abort), base, false);
  return html`<${Content} of=${loaded}>${(version: MapVersion) => versionTab(version, base, tab)}<//>`;
}

function versionTab(version: MapVersion, base: string, tab: string): Children {
  if (tab === "files") return html`<${Files} files=${version.files} /><${Exports} base=${base} />`;
  if (tab === "seams") return html`<${Seams} version=${version} base=${base} />`;
  if (tab === "calibration") {
    const files = version.files.map((file) => file.path).filter((path) => /^calibration\/[^/]+\.json$/.test(path));
    if (files.length === 0) return html`<${Empty}>This version has no calibration of its drives. Each scene has its own.<//>`;
    return html`<${Lazy} load=${() => import("../calibration/page")} name="MapCalibration" of=${{ base, files }} />`;
  }
  if (tab === "3d") {
    if (!hasFile(version, "view.json")) return html`<${Empty}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;
    const driveOf = Object.fromEntries(version.scenes.map((scene) => [scene.name, scene.drive_id]));
    return html`<${Lazy} load=${() => import("../viewer/page")} name="Viewer" of=${{ base, driveOf }} />`;
  }
  if (tab === "place") {
    if (!hasFile(version, "view.json")) return html`<${Empty}>This version has no view.json: it was made by an older version of the engine. Make the map again.<//>`;
    if (!version.summary.georeferenced) return html`<${Empty}>This map has no place on the earth: none of its drives has GNSS that could be used.<//>`;
    return html`<${Lazy} load=${() => import("../place/page")} name="Place" of=${{ base }} />`;
  }
  return html`<${Overview} version=${version} base=${base} />`;
}

function Overview({ version, base }: { version: MapVersion; base: string }): Shown {
  const report = useLoad((abort) => get<Report>(fileUrl(base, "report.json"), abort), `report ${base}`, false);
  const { summary } = version;
  return html`${hasFile(version, "report.html") && html`<p><a class="button" href=${fileUrl(base, "report.html")} download>Download the report</a></p>`}
    <dl class="tiles">
      <${Tile} label="Version">${version.number}<//>
      <${Tile} label="Scenes connected">${summary.connected} of ${summary.scenes}<//>
      <${Tile} label="Seams">${summary.seams}<//>
      <${Tile} label="Images registered">${count(summary.registered_images)} of ${count(summary.images)}<//>
      <${Tile} label="Points">${count(summary.points)}<//>
      <${Tile} label="Made"><${Time} at=${version.created_at} /><//>
    </dl>
    <h2>Scenes</h2><${ScenesOf} version=${version} />
    ${version.failed.length > 0 && html`<h2>Drives without a scene</h2>${version.failed.map((drive) => html`<p><a href=${link("drives", drive.drive_id)}>${drive.name}</a></p><${ProblemBox} problem=${drive.problem} />`)}`}
    <${Content} of=${report}>${(shown: Report) => html`<${ReportParts} report=${shown} />`}<//>`;
}

function ScenesOf({ version }: { version: MapVersion }): Shown {
  return html`<div class="scroll" tabindex="0" role="region" aria-label="Scenes of the map"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col">Connected</th><th scope="col">Drive</th></tr></thead>
    <tbody>${version.scenes.map(
      (scene) => html`<tr><td><a href=${link("scenes", scene.scene_id)}>${scene.name}</a></td>
        <td>${scene.connected ? html`<span class="badge good">connected</span>` : html`<span class="badge warn">placed by positions only</span>`}</td>
        <td><a href=${link("drives", scene.drive_id)}><code>${scene.drive_id}</code></a></td></tr>`,
    )}</tbody></table></div>`;
}

interface Seam {
  a: string;
  b: string;
  accepted: boolean;
  reason?: string;
  inliers?: number;
  units_agreeing?: number;
  units_tried?: number;
  residual_before_px?: number;
  residual_after_px?: number;
  sigma_translation_m?: number;
  sigma_rotation_deg?: number;
  scale?: number;
  pictures?: { before: string; after: string };
  [other: string]: unknown;
}
interface MapDocument {
  seams: Seam[];
  unconnected: (string | { name: string })[];
  left_out: unknown[];
}

function Seams({ version, base }: { version: MapVersion; base: string }): Shown {
  const loaded = useLoad((abort) => get<MapDocument>(fileUrl(base, "map.json"), abort), `map ${base}`, false);
  return html`<${Content} of=${loaded}>${(document: MapDocument) => html`
    ${document.seams.length === 0 && html`<${Empty}>No two scenes of this map were close enough to look for a seam.<//>`}
    ${document.seams.map((seam) => html`<${SeamBox} seam=${seam} base=${base} version=${version} />`)}
    ${version.unconnected.length > 0 && html`<h2>Not connected</h2><p>No seam in use connects these scenes with the others; positions place them: ${version.unconnected.join(", ")}.</p>`}`}<//>`;
}

function SeamBox({ seam, base }: { seam: Seam; base: string; version: MapVersion }): Shown {
  const title = `${seam.a} – ${seam.b}`;
  const figure = (label: string, value: number | undefined, unit: string): Shown =>
    value === undefined ? null : html`<${Tile} label=${label}><span data-exact=${value}>${significant(value, 3)} ${unit}</span><//>`;
  return html`<section class="box"><h2>${title}</h2>
    <p>${seam.accepted ? html`<span class="badge good">accepted</span>` : html`<span class="badge warn">rejected</span> ${seam.reason ?? "the evidence does not suffice"}`}</p>
    <dl class="tiles">
      ${seam.units_tried !== undefined && html`<${Tile} label="Units that agree">${seam.units_agreeing ?? 0} of ${seam.units_tried}<//>`}
      ${seam.inliers !== undefined && html`<${Tile} label="Shared points">${count(seam.inliers)}<//>`}
      ${figure("Residual before", seam.residual_before_px, "px")}
      ${figure("Residual after", seam.residual_after_px, "px")}
      ${figure("Sigma of the translation before the last adjustment", seam.sigma_translation_m, "m")}
      ${figure("Sigma of the rotation before the last adjustment", seam.sigma_rotation_deg, "deg")}
      ${seam.scale !== undefined && html`<${Tile} label="Difference of scale"><span data-exact=${seam.scale}>${significant(100 * (seam.scale - 1), 3)} %</span><//>`}
    </dl>
    ${seam.pictures
      ? html`<${Slider} before=${fileUrl(base, seam.pictures.before)} after=${fileUrl(base, seam.pictures.after)} label="Points of both scenes from above" />`
      : html`<p class="muted">${seam.accepted ? "There are no pictures: they were switched off." : "There are no pictures, because the seam is not used."}</p>`}
  </section>`;
}

function Versions({ map, changed }: { map: MapResource; changed: () => void }): Shown {
  const loaded = useLoad((abort) => getShown<MapVersion>(`v1/maps/${map.id}/versions`, abort), `versions ${map.id} ${map.current_version}`);
  return html`<${Content} of=${loaded}>${(versions: MapVersion[]) =>
    versions.length === 0 ? html`<${Empty}>No version yet.<//>` : html`<${VersionList} map=${map} versions=${versions} loaded=${loaded} changed=${changed} />`}<//>`;
}

function VersionList({ map, versions, changed }: { map: MapResource; versions: readonly MapVersion[]; loaded: Loaded<MapVersion[]>; changed: () => void }): Shown {
  const numbers = versions.map((version) => version.number);
  const [old, setOld] = useState(numbers[1] ?? numbers[0]!);
  const [recent, setRecent] = useState(numbers[0]!);
  const show = async (number: number): Promise<void> => {
    await send("PUT", `v1/maps/${map.id}/current-version`, { json: { version: number } });
    changed();
  };
  const choose = (label: string, value: number, set: (value: number) => void): Shown => html`<label>${label}
    <select value=${value} onChange=${(event: Event) => set(Number((event.target as HTMLSelectElement).value))}>
      ${numbers.map((number) => html`<option value=${number} selected=${number === value}>Version ${number}</option>`)}</select></label>`;
  const [a, b] = [versions.find((one) => one.number === old), versions.find((one) => one.number === recent)];
  return html`<div class="scroll" tabindex="0" role="region" aria-label="Versions"><table>
      <thead><tr><th scope="col" class="number">Version</th><th scope="col">Made</th><th scope="col" class="number">Scenes</th><th scope="col" class="number">Seams</th><th scope="col" class="number">Points</th><th scope="col"></th></tr></thead>
      <tbody>${versions.map(
        (version) => html`<tr key=${version.number}><td class="number">${version.number}</td><td><${Time} at=${version.created_at} /></td>
          <td class="number">${version.summary.scenes}</td><td class="number">${version.summary.seams}</td><td class="number">${count(version.summary.points)}</td>
          <td>${version.is_current ? html`<${Badge} state="current" />` : html`<${Confirm} label="Make it current" ask=${`Show version ${version.number}?`} run=${() => show(version.number)} />`}</td></tr>`,
      )}</tbody></table></div>
    <h2>Compare</h2>
    ${numbers.length < 2
      ? html`<p class="muted">There is one version only. An aggregation into this map makes the next.</p>`
      : html`<div class="inline">${choose("From", old, setOld)} ${choose("To", recent, setRecent)}</div>${a && b && html`<${Difference} a=${a} b=${b} />`}`}`;
}

const FIGURES = ["scenes", "connected", "seams", "registered_units", "registered_images", "points", "warnings"] as const;

function Difference({ a, b }: { a: MapVersion; b: MapVersion }): Shown {
  const names = (version: MapVersion): Map<string, boolean> => new Map(version.scenes.map((scene) => [scene.name, scene.connected]));
  const [before, after] = [names(a), names(b)];
  const added = [...after.keys()].filter((name) => !before.has(name));
  const removed = [...before.keys()].filter((name) => !after.has(name));
  const turned = [...after].filter(([name, connected]) => before.has(name) && before.get(name) !== connected);
  const signed = (value: number): string => (value > 0 ? `+${count(value)}` : value < 0 ? `−${count(-value)}` : "same");
  return html`<table><thead><tr><th scope="col">Figure</th><th scope="col" class="number">Version ${a.number}</th><th scope="col" class="number">Version ${b.number}</th><th scope="col" class="number">Change</th></tr></thead>
      <tbody>${FIGURES.map((name) => html`<tr><th scope="row">${name.replaceAll("_", " ")}</th><td class="number">${count(a.summary[name])}</td><td class="number">${count(b.summary[name])}</td><td class="number">${signed(b.summary[name] - a.summary[name])}</td></tr>`)}</tbody></table>
    <ul>
      <li>Scenes added: ${added.join(", ") || "none"}</li>
      <li>Scenes removed: ${removed.join(", ") || "none"}</li>
      <li>Connection changed: ${turned.map(([name, connected]) => `${name} (${connected ? "connected now" : "not connected any more"})`).join(", ") || "none"}</li>
    </ul>`;
}

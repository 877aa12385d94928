// The calibration of a scene: what changed, how well it is known, and which cameras are not what they were given as.
import { fileUrl, get, getShown, session, type Drive, type Scene } from "../client";
import { Content, Empty, useLoad } from "../components";
import { significant } from "../format";
import { html, type Shown } from "../html";
import { Slider } from "../slider";
import { Chart, type Series } from "./chart";
import { AXES, type Calibration, type CameraCalibration } from "./document";

interface Props {
  base: string;
  driveId: string;
  hasPictures: boolean;
}

/** The calibrations of a map's drives, as its adjustment left them. */
export function MapCalibration({ base, files }: { base: string; files: readonly string[] }): Shown {
  const loaded = useLoad((abort) => Promise.all(files.map(async (file) => ({ name: file.replace(/^calibration\/|\.json$/g, ""), document: await get<Calibration>(fileUrl(base, file), abort) }))), `calibrations ${base}`, false);
  return html`<${Content} of=${loaded}>${(found: { name: string; document: Calibration }[]) => found.map(({ name, document }) => html`<section class="box" data-scene=${name}><h2>${name}</h2><${Cameras} document=${document} /></section>`)}<//>`;
}

export function CalibrationPage({ base, driveId, hasPictures }: Props): Shown {
  const loaded = useLoad((abort) => get<Calibration>(fileUrl(base, "calibration.json"), abort), `calibration ${base}`, false);
  return html`<${Content} of=${loaded}>${(document: Calibration) => html`<${Cameras} document=${document} />`}<//>
    ${hasPictures && html`<h2>The ground from above</h2><${Slider} before=${fileUrl(base, "pictures/birds_eye_before.png")} after=${fileUrl(base, "pictures/birds_eye_after.png")} label="All cameras projected onto the road, calibration as given and as refined" />`}
    ${session.value?.session_expires_at && html`<${History} driveId=${driveId} />`}`;
}

export function Cameras({ document }: { document: Calibration }): Shown {
  const wrong = Object.entries(document.cameras).filter(([, camera]) => camera.wrong).map(([name]) => name);
  const state = document.why === undefined ? "The calibration is used as given" : `${document.adjusted ? "The calibration was refined" : "The calibration was kept as given"}: ${document.why}`;
  return html`<p>${state}.</p>
    ${wrong.length > 0
      ? html`<div class="box bad" role="alert"><strong>Not mounted as given: ${wrong.join(", ")}</strong><p>The images contradict the calibration of ${wrong.length === 1 ? "this camera" : "these cameras"}. Calibrate anew, or use the refined values where their sigma suffices.</p></div>`
      : html`<p><span class="badge good">no single camera contradicts its calibration</span></p>`}
    <${Corrections} document=${document} what="rotation" unit="deg" title="Correction of the rotation about the rig's axes" />
    <${Corrections} document=${document} what="translation" unit="m" title="Correction of the position along the rig's axes" />
    <p class="muted small">± is one sigma, with what the lenses may be off by. Observed: the drive's images and positions determine this direction. Only the prior: they do not, and the value is the given one within its uncertainty.</p>
    <${TimeOffsets} document=${document} />
    <${Intrinsics} document=${document} />`;
}

interface CorrectionProps {
  document: Calibration;
  what: "rotation" | "translation";
  unit: string;
  title: string;
}

function Corrections({ document, what, unit, title }: CorrectionProps): Shown {
  return html`<h2>${title}</h2>
    <div class="scroll" tabindex="0" role="region" aria-label=${title}><table data-corrections=${what}>
      <thead><tr><th scope="col">Camera</th>${AXES.map((axis) => html`<th scope="col" class="number">${axis} [${unit}]</th>`)}<th scope="col">Verdict</th></tr></thead>
      <tbody>${Object.entries(document.cameras).map(([name, camera]) => html`<tr class=${camera.wrong ? "wrong" : ""} data-camera=${name} data-wrong=${String(camera.wrong)}>
        <th scope="row">${name}${camera.wrong && html` <span class="badge bad">wrong</span>`}</th>
        ${AXES.map((axis, index) => html`<td class="number">${value(camera, what, index, axis)}</td>`)}
        <td>${verdicts(camera, what)}</td></tr>`)}</tbody></table></div>`;
}

function value(camera: CameraCalibration, what: "rotation" | "translation", index: number, axis: string): Shown {
  const unit = what === "rotation" ? "rotation_deg" : "translation_m";
  const correction = (what === "rotation" ? camera.difference.rotation_vector_deg : camera.difference.translation_m)[index]!;
  return withSigma(correction, camera.sigma?.[unit]?.[index], axis);
}

function withSigma(correction: number, sigma: number | null | undefined, axis: string): Shown {
  if (sigma === null || sigma === undefined) return html`<span data-axis=${axis} data-value=${correction}>${significant(correction, 3)}</span>`;
  // As many decimals as three significant digits of the sigma have: more say nothing.
  const decimals = Math.min(9, Math.max(0, 2 - Math.floor(Math.log10(sigma))));
  return html`<span data-axis=${axis} data-value=${correction} data-sigma=${sigma}>${correction.toFixed(decimals)} <span class="muted">± ${sigma.toFixed(decimals)}</span></span>`;
}

function verdicts(camera: CameraCalibration, what: "rotation" | "translation"): string {
  const found = camera.verdict?.[what] ?? [];
  if (found.length === 0) return "not refined";
  if (new Set(found).size === 1) return found[0]!;
  return found.map((verdict, index) => `${AXES[index]}: ${verdict}`).join("; ");
}

function TimeOffsets({ document }: { document: Calibration }): Shown {
  const rows = Object.entries(document.cameras).filter(([, camera]) => camera.refined.time_offset_us !== undefined);
  if (rows.length === 0) return null;
  return html`<h2>Time offset of the cameras</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Time offsets"><table data-time-offsets>
      <thead><tr><th scope="col">Camera</th><th scope="col" class="number">Offset [µs]</th><th scope="col">Verdict</th></tr></thead>
      <tbody>${rows.map(([name, camera]) => html`<tr data-camera=${name}><th scope="row">${name}</th>
        <td class="number">${withSigma(camera.refined.time_offset_us!, camera.sigma?.time_offset_us, "time_offset")}</td><td>${camera.verdict?.time_offset ?? ""}</td></tr>`)}</tbody></table></div>`;
}

function Intrinsics({ document }: { document: Calibration }): Shown {
  const isRefined = Object.values(document.cameras).some((camera) => camera.given.params.some((given, index) => given !== camera.refined.params[index]));
  return html`<h2>Intrinsics</h2>
    ${!isRefined && html`<p class="muted">They were used as given: no setting asks to refine them.</p>`}
    <div class="scroll" tabindex="0" role="region" aria-label="Intrinsics"><table data-intrinsics>
      <thead><tr><th scope="col">Camera</th><th scope="col">Model</th><th scope="col">Parameter</th><th scope="col" class="number">Given</th><th scope="col" class="number">Refined</th></tr></thead>
      <tbody>${Object.entries(document.cameras).flatMap(([name, camera]) => camera.param_names.map((param, index) => html`<tr data-camera=${name} data-param=${param}>
        ${index === 0 && html`<th scope="row" rowspan=${camera.param_names.length}>${name}</th><td rowspan=${camera.param_names.length}>${camera.model}<div class="muted small number">${camera.width} × ${camera.height} px</div></td>`}
        <td>${param}${/^(f|c)/.test(param) ? " [px]" : ""}</td>
        <td class="number" data-value=${camera.given.params[index]}>${significant(camera.given.params[index]!, 6)}</td>
        <td class="number" data-value=${camera.refined.params[index]}>${significant(camera.refined.params[index]!, 6)}</td></tr>`))}</tbody></table></div>`;
}

interface Sample {
  at: string;
  calibration: Calibration;
}

const MOST_SCENES = 50;

async function history(driveId: string, abort: AbortSignal): Promise<Sample[] | null> {
  const drive = await get<Drive>(`v1/drives/${driveId}`, abort);
  if (!drive.vehicle) return null;
  const drives = await getShown<Drive>(`v1/drives?vehicle=${encodeURIComponent(drive.vehicle)}`, abort);
  const newest = drives.slice(0, MOST_SCENES).map(async (one): Promise<Sample | null> => {
    const [scene] = (await get<{ items: Scene[] }>(`v1/scenes?drive_id=${one.id}&limit=1`, abort)).items;
    if (!scene) return null;
    return { at: one.created_at, calibration: await get<Calibration>(`v1/scenes/${scene.id}/files/calibration.json`, abort) };
  });
  const samples = (await Promise.all(newest)).filter((sample): sample is Sample => sample !== null);
  return samples.sort((a, b) => a.at.localeCompare(b.at));
}

function History({ driveId }: { driveId: string }): Shown {
  const loaded = useLoad((abort) => history(driveId, abort).then((samples) => ({ samples })), `history ${driveId}`, false);
  return html`<h2>All drives of this vehicle</h2>
    <${Content} of=${loaded}>${({ samples }: { samples: Sample[] | null }) => {
      if (samples === null) return html`<${Empty}>The drive's manifest names no vehicle. With <code>vehicle</code> in it, the corrections of all its drives are plotted here.<//>`;
      if (samples.length < 2) return html`<${Empty}>This is the only drive of its vehicle that has a scene.<//>`;
      return AXES.map((axis, index) => html`<${Chart} title=${`Rotation about ${axis}, correction in degrees, by date of the drive`} unit="deg" series=${seriesOf(samples, index)} />`);
    }}<//>`;
}

function seriesOf(samples: readonly Sample[], index: number): Series[] {
  const names = [...new Set(samples.flatMap((sample) => Object.keys(sample.calibration.cameras)))];
  return names.map((name) => ({
    name,
    points: samples.flatMap((sample) => {
      const camera = sample.calibration.cameras[name];
      if (!camera) return [];
      // What the drives of a vehicle share, as errors of its lenses, says nothing of how they differ.
      const scatter = camera.repeatability?.rotation_deg ?? camera.sigma?.rotation_deg;
      return [{ x: Date.parse(sample.at), y: camera.difference.rotation_vector_deg[index]!, sigma: scatter?.[index] ?? 0 }];
    }),
  }));
}

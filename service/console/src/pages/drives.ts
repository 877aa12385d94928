import { useState } from "preact/hooks";
import { get, getShown, send, type Drive, type Job, type Preflight, type Problem, type Scene } from "../client";
import { Badge, Confirm, Content, Empty, Findings, Heading, problemOf, ProblemBox, Tile, Time, useLoad } from "../components";
import { bytes, count, plural } from "../format";
import { html, type Shown } from "../html";
import { jobs, put } from "../live";
import { go, link } from "../router";
import { JobTable } from "./jobs";

export function Drives(): Shown {
  const loaded = useLoad((abort) => getShown<Drive>("v1/drives", abort), "drives");
  const [chosen, setChosen] = useState<readonly string[]>([]);
  const choose = (id: string, isChosen: boolean): void => setChosen(isChosen ? [...chosen, id] : chosen.filter((other) => other !== id));
  return html`<${Heading} title="Drives"><a class="button primary" href=${link("upload")}>Upload a drive</a><//>
    <${Content} of=${loaded}>${(drives: Drive[]) =>
      drives.length === 0
        ? html`<${Empty}><p>No drive yet.</p><p>A drive is a folder with <code>drive.json</code> and its images.
            <a href=${link("upload")}>Upload one here</a>, or with <code>mrasfm upload FOLDER</code>.</p><//>`
        : html`<${Chosen} drives=${drives.filter((drive) => chosen.includes(drive.id))} />
            <${DriveTable} drives=${drives} chosen=${chosen} choose=${choose} />`}<//>`;
}

function DriveTable({ drives, chosen, choose }: { drives: readonly Drive[]; chosen: readonly string[]; choose: (id: string, isChosen: boolean) => void }): Shown {
  return html`<div class="scroll" tabindex="0" role="region" aria-label="Drives"><table>
    <thead><tr><th scope="col"><span class="hidden">Choose for a map</span></th><th scope="col">Drive</th><th scope="col">State</th><th scope="col">Check</th>
      <th scope="col" class="number">Cameras</th><th scope="col" class="number">Frames</th><th scope="col" class="number">Files</th><th scope="col" class="number">Size</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${drives.map(
        (drive) => html`<tr key=${drive.id}>
          <td><input type="checkbox" aria-label=${`choose ${drive.name} for a map`} disabled=${drive.state !== "COMMITTED"}
            checked=${chosen.includes(drive.id)} onChange=${(event: Event) => choose(drive.id, (event.target as HTMLInputElement).checked)} /></td>
          <td><a href=${link("drives", drive.id)}>${drive.name}</a>${drive.vehicle && html`<div class="muted small">${drive.vehicle}</div>`}</td>
          <td><${Badge} state=${drive.state} /></td>
          <td><${Badge} state=${drive.preflight} /><div class="muted small">${found(drive)}</div></td>
          <td class="number">${drive.cameras}</td>
          <td class="number">${count(drive.frames)}</td>
          <td class="number">${count(drive.files_stored)} of ${count(drive.files_expected)}</td>
          <td class="number">${bytes(drive.bytes_stored)}</td>
          <td><${Time} at=${drive.created_at} /></td>
        </tr>`,
      )}
    </tbody>
  </table></div>`;
}

function Chosen({ drives }: { drives: readonly Drive[] }): Shown {
  return drives.length > 1 ? html`<${MakeMap} drives=${drives} />` : null;
}

function MakeMap({ drives }: { drives: readonly Drive[] }): Shown {
  const [name, setName] = useState("map");
  const [problem, setProblem] = useState<Problem | null>(null);
  const [isBusy, setBusy] = useState(false);
  const make = async (event: Event): Promise<void> => {
    event.preventDefault();
    setBusy(true);
    setProblem(null);
    try {
      const answer = await send("POST", "v1/aggregations", { json: { drives: drives.map((drive) => drive.id), name } });
      const job = (await answer.json()) as Job;
      put(job);
      go("jobs", job.id);
    } catch (error) {
      setProblem(problemOf(error));
    }
    setBusy(false);
  };
  return html`<form class="box inline" onSubmit=${(event: Event) => void make(event)}>
    <label>Name of the map <input required maxlength="200" value=${name} onInput=${(event: Event) => setName((event.target as HTMLInputElement).value)} /></label>
    <button class="primary" disabled=${isBusy}>Make a map of ${drives.length} drives</button>
    ${problem && html`<${ProblemBox} problem=${problem} />`}
  </form>`;
}

export function DrivePage({ id }: { id: string }): Shown {
  const loaded = useLoad((abort) => get<Drive>(`v1/drives/${id}`, abort), id);
  const drive = loaded.value;
  return html`<${Heading} title=${drive?.name ?? "Drive"} kind="Drive">${drive && html`<${DriveActions} drive=${drive} />`}<//>
    <${Content} of=${loaded}>${(shown: Drive) => html`<${DriveFacts} drive=${shown} />`}<//>
    ${drive && html`<${Checks} drive=${drive} /><${ScenesOf} drive=${drive} /><${JobsOf} drive=${drive} />`}`;
}

/** Number of errors and warnings that the check found; empty where it found none. */
function found(drive: Drive): string {
  const counts: [number, string][] = [[drive.preflight_errors, "error"], [drive.preflight_warnings, "warning"]];
  return counts.filter(([value]) => value > 0).map(([value, what]) => plural(value, what)).join(", ");
}

function DriveFacts({ drive }: { drive: Drive }): Shown {
  return html`<dl class="tiles">
    <${Tile} label="State"><${Badge} state=${drive.state} /><//>
    <${Tile} label="Files">${count(drive.files_stored)} of ${count(drive.files_expected)}<//>
    <${Tile} label="Size">${bytes(drive.bytes_stored)}<//>
    <${Tile} label="Cameras">${drive.cameras}<//>
    <${Tile} label="Frames">${count(drive.frames)}<//>
    <${Tile} label="GNSS">${drive.has_gnss ? "yes" : "no"}<//>
    <${Tile} label="Vehicle">${drive.vehicle ?? "not named"}<//>
    <${Tile} label="Created"><${Time} at=${drive.created_at} /><//>
  </dl><p class="muted small"><code>${drive.id}</code></p>`;
}

function DriveActions({ drive }: { drive: Drive }): Shown {
  const reconstruct = async (): Promise<void> => {
    const answer = await send("POST", "v1/reconstructions", { json: { drive_id: drive.id } });
    const job = (await answer.json()) as Job;
    put(job);
    go("jobs", job.id);
  };
  const remove = async (): Promise<void> => {
    await send("DELETE", `v1/drives/${drive.id}`);
    go("drives");
  };
  return html`${drive.state === "COMMITTED"
      ? html`<${Confirm} label="Reconstruct" ask="Start a reconstruction?" run=${reconstruct} />`
      : html`<a class="button primary" href=${link("upload")}>Continue the upload</a>`}
    <${Confirm} label="Delete" ask="Delete this drive and its images?" run=${remove} danger />`;
}

function Checks({ drive }: { drive: Drive }): Shown {
  const loaded = useLoad((abort) => get<Preflight>(`v1/drives/${drive.id}/preflight`, abort), `preflight ${drive.id}`);
  if (drive.state !== "COMMITTED") return null;
  return html`<h2>Check of the drive</h2>
    <${Content} of=${loaded}>${(check: Preflight) => html`<p><${Badge} state=${check.state} /> ${
      check.findings.length === 0 ? (check.state === "PENDING" ? "The images are being checked." : "No finding.") : plural(check.findings.length, "finding")
    }</p><${Findings} findings=${check.findings} />`}<//>`;
}

function ScenesOf({ drive }: { drive: Drive }): Shown {
  const loaded = useLoad((abort) => getShown<Scene>(`v1/scenes?drive_id=${drive.id}`, abort), `scenes ${drive.id}`);
  return html`<h2>Scenes</h2><${Content} of=${loaded}>${(scenes: Scene[]) =>
    scenes.length === 0 ? html`<${Empty}>No scene of this drive yet.<//>` : html`<${SceneTable} scenes=${scenes} />`}<//>`;
}

export function SceneTable({ scenes }: { scenes: readonly Scene[] }): Shown {
  return html`<div class="scroll" tabindex="0" role="region" aria-label="Scenes"><table>
    <thead><tr><th scope="col">Scene</th><th scope="col" class="number">Units registered</th><th scope="col" class="number">Images registered</th><th scope="col" class="number">Points</th><th scope="col">Georeferenced</th><th scope="col" class="number">Warnings</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${scenes.map(
        (scene) => html`<tr key=${scene.id}>
          <td><a href=${link("scenes", scene.id)}>${scene.name}</a></td>
          <td class="number">${count(scene.summary.registered_units)} of ${count(scene.summary.units)}</td>
          <td class="number">${count(scene.summary.registered_images)} of ${count(scene.summary.images)}</td>
          <td class="number">${count(scene.summary.points)}</td>
          <td>${scene.summary.georeferenced ? "yes" : "no"}</td>
          <td class="number">${scene.summary.warnings}</td>
          <td><${Time} at=${scene.created_at} /></td>
        </tr>`,
      )}
    </tbody>
  </table></div>`;
}

function JobsOf({ drive }: { drive: Drive }): Shown {
  const mine = [...(jobs.value?.values() ?? [])].filter((job) => job.drive_id === drive.id);
  mine.sort((a, b) => b.created_at.localeCompare(a.created_at));
  return html`<h2>Jobs</h2>${mine.length === 0 ? html`<${Empty}>No job of this drive yet.<//>` : html`<${JobTable} jobs=${mine} />`}`;
}

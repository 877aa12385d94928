import { useState } from "preact/hooks";
import { get, getShown, send, type Drive, type Export, type Job } from "../client";
import { Badge, Bar, Confirm, Content, Empty, eta, Heading, KINDS, ProblemBox, stageOf, Tile, Time, useLoad } from "../components";
import { duration } from "../format";
import { html, type Children, type Shown } from "../html";
import { hasEnded, jobs, put } from "../live";
import { go, link } from "../router";

const SHOWN = 200;
const NAMED = 5; // drives of a map, in a list of jobs
const PERIODS = { active: "Not ended", failed: "Failed", all: "All" } as const;
type Period = keyof typeof PERIODS;

export function Jobs(): Shown {
  const [period, setPeriod] = useState<Period>("all");
  const known = jobs.value;
  const all = [...(known?.values() ?? [])].sort((a, b) => b.created_at.localeCompare(a.created_at));
  const wanted = all.filter((job) =>
    period === "active" ? !hasEnded(job) : period === "failed" ? job.state === "FAILED" : true,
  );
  return html`<${Heading} title="Jobs">
      <div class="choice" role="group" aria-label="Jobs to show">
        ${Object.entries(PERIODS).map(
          ([name, label]) => html`<button type="button" aria-pressed=${period === name} onClick=${() => setPeriod(name as Period)}>${label}</button>`,
        )}
      </div>
    <//>
    ${known === null && html`<p class="muted" aria-busy="true">Loading …</p>`}
    ${known !== null && wanted.length === 0 &&
    html`<${Empty}>${period === "all" ? "No job yet. Upload a drive and start its reconstruction." : "No such job."}<//>`}
    ${wanted.length > 0 && html`<${JobTable} jobs=${wanted.slice(0, SHOWN)} />`}
    ${wanted.length > SHOWN && html`<p class="muted">The newest ${SHOWN} of ${wanted.length} jobs are shown.</p>`}`;
}

export function JobTable({ jobs: shown }: { jobs: readonly Job[] }): Shown {
  const drives = useLoad((abort) => getShown<Drive>("v1/drives", abort), "names of drives");
  return html`<div class="scroll" tabindex="0" role="region" aria-label="Jobs"><table>
    <thead><tr><th scope="col">Job</th><th scope="col">State</th><th scope="col">Progress</th><th scope="col">Stage</th><th scope="col">Time left</th><th scope="col">Created</th></tr></thead>
    <tbody>
      ${shown.map(
        (job) => html`<tr key=${job.id}>
          <td><a href=${link("jobs", job.id)}>${KINDS[job.kind]}</a><div class="muted small">${nameOf(job, drives.value)}</div></td>
          <td><${Badge} state=${job.state} /></td>
          <td><${Bar} percent=${job.progress.percent} label="done" /></td>
          <td>${hasEnded(job) ? "–" : stageOf(job)}</td>
          <td class="number">${hasEnded(job) ? "–" : eta(job)}</td>
          <td><${Time} at=${job.created_at} /></td>
        </tr>`,
      )}
    </tbody>
  </table></div>`;
}

function nameOf(job: Job, drives: readonly Drive[] | null): string {
  const members = (job.members ?? []).map((member) => member.name);
  const more = members.length - NAMED;
  if (members.length > 0) return members.slice(0, NAMED).join(", ") + (more > 0 ? ` and ${more} more` : "");
  return drives?.find((drive) => drive.id === job.drive_id)?.name ?? job.drive_id ?? job.id;
}

export function JobPage({ id }: { id: string }): Shown {
  const loaded = useLoad((abort) => get<Job>(`v1/jobs/${id}`, abort), id);
  const live = jobs.value?.get(id);
  const job = live ?? loaded.value;
  if (!job) return html`<${Heading} title="Job" /><${Content} of=${loaded}>${() => null}<//>`;
  return html`<${Heading} title=${KINDS[job.kind]} kind="Job"><${JobActions} job=${job} /><//>
    <div class="row"><${Badge} state=${job.state} />${job.cancel_requested && !hasEnded(job) && html`<span class="badge warn">stopping</span>`}
      <${Bar} percent=${job.progress.percent} label="done" /></div>
    <dl class="tiles" aria-live="polite">
      <${Tile} label=${hasEnded(job) ? "Last stage" : "Stage"}>${job.state === "SUCCEEDED" ? "all done" : stageOf(job)}<//>
      <${Tile} label=${hasEnded(job) ? "Took" : "Time left"}>${hasEnded(job) ? took(job) : eta(job)}<//>
      <${Tile} label="Created"><${Time} at=${job.created_at} /><//>
      <${Tile} label="Started"><${Time} at=${job.started_at} /><//>
      <${Tile} label="Heartbeat"><${Time} at=${job.heartbeat_at} /><//>
    </dl>
    ${job.problem && html`<${ProblemBox} problem=${job.problem} />`}
    <${Results} job=${job} />
    <${Tree} job=${job} />
    <${Attempts} job=${job} />
    <h2>Details</h2>
    <dl class="facts">
      <dt>Id</dt><dd><code>${job.id}</code></dd>
      ${job.drive_id && html`<dt>Drive</dt><dd><a href=${link("drives", job.drive_id)}>${job.drive_id}</a></dd>`}
      ${job.parent_id && html`<dt>Part of</dt><dd><a href=${link("jobs", job.parent_id)}>${job.parent_id}</a></dd>`}
      ${job.retry_of && html`<dt>Repeats</dt><dd><a href=${link("jobs", job.retry_of)}>${job.retry_of}</a></dd>`}
      <dt>Reused stages</dt><dd>${job.progress.reused_stages?.join(", ") || "none"}</dd>
      <dt>Settings</dt><dd><pre tabindex="0">${JSON.stringify(job.settings, null, 1)}</pre></dd>
    </dl>`;
}

function took(job: Job): string {
  if (!job.finished_at || !job.started_at) return "did not start";
  return duration((Date.parse(job.finished_at) - Date.parse(job.started_at)) / 1000);
}

function JobActions({ job }: { job: Job }): Shown {
  const cancel = async (): Promise<void> => {
    const answer = await send("POST", `v1/jobs/${job.id}:cancel`);
    put((await answer.json()) as Job);
  };
  const retry = async (): Promise<void> => {
    const answer = await send("POST", `v1/jobs/${job.id}:retry`);
    const again = (await answer.json()) as Job;
    put(again);
    go("jobs", again.id);
  };
  const canRetry = job.kind !== "SUBMAP" && (job.state === "FAILED" || job.state === "CANCELLED");
  return html`${!hasEnded(job) && !job.cancel_requested && html`<${Confirm} label="Cancel" ask="Cancel this job?" run=${cancel} danger />`}
  ${canRetry && html`<${Confirm} label="Retry" ask="Do it again? Finished stages are reused." run=${retry} />`}`;
}

function Results({ job }: { job: Job }): Shown {
  if (job.scene_id) return html`<p><a class="button primary" href=${link("scenes", job.scene_id)}>Open the scene</a></p>`;
  if (job.map_id && job.map_version) return html`<p><a class="button primary" href=${link("maps", job.map_id)}>Open the map</a></p>`;
  if (job.export_id) return html`<${ExportOf} id=${job.export_id} />`;
  return null;
}

function ExportOf({ id }: { id: string }): Shown {
  const loaded = useLoad((abort) => get<Export>(`v1/exports/${id}`, abort), `export ${id}`, false);
  return html`<${Content} of=${loaded}>${({ scene_id: scene, map_id: map, formats }: Export) => html`<p>Formats: ${formats.join(", ")}.</p>
    <p><a class="button primary" href=${scene ? link("scenes", scene, "files") : link("maps", map ?? "", "files")}>Open the exports of the ${scene ? "scene" : "map"}</a></p>`}<//>`;
}

interface Branch {
  label: string;
  state: string | null | undefined;
  percent: number;
  jobId: string | null | undefined;
  note: Children;
}

function Tree({ job }: { job: Job }): Shown {
  const members: Branch[] = (job.members ?? []).map((member) => ({
    label: member.name,
    state: member.scene_id ? "SUCCEEDED" : member.state,
    percent: member.percent,
    jobId: member.job_id,
    note: member.problem ? member.problem.detail : member.job_id ? "" : "its scene was there",
  }));
  const submaps: Branch[] = (job.submaps ?? []).map((submap) => ({
    label: `Sub-map ${submap.number}: units ${submap.first_unit} to ${submap.last_unit}`,
    state: submap.state,
    percent: submap.percent,
    jobId: submap.job_id,
    note: submap.problem?.detail ?? "",
  }));
  const branches = [...members, ...submaps];
  if (branches.length === 0) return null;
  return html`<h2>${members.length > 0 ? "Drives of this map" : "Sub-maps"}</h2>
    <ul class="tree">
      ${branches.map(
        (branch) => html`<li key=${branch.label}>
          <span class="label">${branch.jobId ? html`<a href=${link("jobs", branch.jobId)}>${branch.label}</a>` : branch.label}</span>
          ${branch.state && html`<${Badge} state=${branch.state} />`}
          <${Bar} percent=${branch.percent} label=${`${branch.label} done`} />
          ${branch.note && html`<span class="muted small">${branch.note}</span>`}
        </li>`,
      )}
    </ul>`;
}

function Attempts({ job }: { job: Job }): Shown {
  if (job.attempts.length === 0) return null;
  return html`<h2>Attempts</h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Attempts"><table>
      <thead><tr><th scope="col" class="number">Attempt</th><th scope="col">Worker</th><th scope="col">Started</th><th scope="col">Finished</th><th scope="col">Outcome</th></tr></thead>
      <tbody>
        ${job.attempts.map(
          (attempt) => html`<tr>
            <td class="number">${attempt.attempt}</td><td><code>${attempt.worker}</code></td>
            <td><${Time} at=${attempt.started_at} /></td><td><${Time} at=${attempt.finished_at} /></td>
            <td>${attempt.outcome ?? "runs"}${attempt.problem && html`<div class="small">${attempt.problem.detail}</div>`}</td>
          </tr>`,
        )}
      </tbody>
    </table></div>`;
}

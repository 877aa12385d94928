import { get, send, setSession, type Session, type Status } from "../client";
import { Badge, Content, Empty, Heading, Tile, Time, useLoad } from "../components";
import { bytes, count, duration, plural } from "../format";
import { html, type Shown } from "../html";
import { link } from "../router";
import { useEffect } from "preact/hooks";

const STATUS_EVERY_MS = 5000;

export function StatusPage(): Shown {
  const loaded = useLoad((abort) => get<Status>("v1/status", abort), "status");
  useEffect(() => {
    const timer = setInterval(() => document.hidden || loaded.again(), STATUS_EVERY_MS);
    return () => clearInterval(timer);
  }, []);
  return html`<${Heading} title="Status" /><${Content} of=${loaded}>${(status: Status) => html`<${Parts} status=${status} />`}<//>`;
}

function Parts({ status }: { status: Status }): Shown {
  const [online, offline] = [status.workers.filter((worker) => worker.online), status.workers.filter((worker) => !worker.online)];
  const used = 1 - status.disk.free_bytes / status.disk.total_bytes;
  return html`<p><${Badge} state=${status.status} /> Version ${status.version}</p>
    ${status.reasons.length > 0 && html`<ul class="findings">${status.reasons.map((reason) => html`<li class="warn">${reason}</li>`)}</ul>`}
    <dl class="tiles">
      <${Tile} label="Jobs that wait">${count(status.queue.queued)}<//>
      <${Tile} label="Jobs that run">${count(status.queue.running)}<//>
      <${Tile} label="Stalled jobs">${count(status.queue.stalled)}<//>
      <${Tile} label="Longest wait">${status.queue.longest_wait_seconds > 0 ? duration(status.queue.longest_wait_seconds) : "none"}<//>
      <${Tile} label="Broker">${status.broker ? "answers" : "does not answer"}<//>
      <${Tile} label="Reconciler">${status.reconciler ? "runs" : "does not run"}<//>
      <${Tile} label="Disk">${bytes(status.disk.free_bytes)} free of ${bytes(status.disk.total_bytes)}
        <progress max="1" value=${used} aria-label="disk in use"></progress><//>
      <${Tile} label="Uploads">${status.disk.accepts_uploads ? "are taken" : "are refused: the disk is full"}<//>
    </dl>
    <h2>Workers</h2>
    ${online.length === 0
      ? html`<${Empty}>No worker is online. Jobs are accepted and wait.<//>`
      : html`<${WorkerTable} workers=${online} label="Workers" />`}
    ${offline.length > 0 && html`<details class="box"><summary>${plural(offline.length, "worker")} that have been silent since</summary><${WorkerTable} workers=${offline} label="Silent workers" /></details>`}
    <p><a href="docs">Description of the API</a></p>`;
}

function WorkerTable({ workers, label }: { workers: Status["workers"]; label: string }): Shown {
  return html`<div class="scroll" tabindex="0" role="region" aria-label=${label}><table>
    <thead><tr><th scope="col">Worker</th><th scope="col">Online</th><th scope="col">Queues</th><th scope="col" class="number">Jobs at one time</th><th scope="col">Last report</th></tr></thead>
    <tbody>${workers.map(
      (worker) => html`<tr><td><code>${worker.name}</code></td><td><span class=${`badge ${worker.online ? "good" : "plain"}`}>${worker.online ? "online" : "offline"}</span></td>
        <td>${worker.queues.join(", ")}</td><td class="number">${worker.concurrency}</td><td><${Time} at=${worker.seen_at} /></td></tr>`,
    )}</tbody></table></div>`;
}

export function Keys(): Shown {
  const loaded = useLoad((abort) => get<Session>("v1/session", abort), "session");
  return html`<${Heading} title="Key and project" /><${Content} of=${loaded}>${(shown: Session) => html`
    <dl class="tiles">
      <${Tile} label="Project">${shown.project}<//>
      <${Tile} label="Key">${shown.key_name}<//>
      <${Tile} label="Key made"><${Time} at=${shown.key_created_at} /><//>
      <${Tile} label="Session ends"><${Time} at=${shown.session_expires_at} /><//>
      <${Tile} label="Stored">${bytes(shown.used_bytes)} of ${bytes(shown.max_bytes)}
        <progress max=${shown.max_bytes} value=${shown.used_bytes} aria-label="storage in use"></progress><//>
      <${Tile} label="Active jobs">at most ${count(shown.max_active_jobs)}<//>
      <${Tile} label="Drives">at most ${count(shown.max_drives)}<//>
    </dl>
    <p class="muted small"><code>${shown.key_id}</code></p>
    <h2>More keys</h2>
    <p>Keys are made and revoked on the service's machine. A revoked key ends its sessions within seconds.</p>
    <pre tabindex="0">mrasfm keys create --name NAME
mrasfm keys revoke ${shown.key_id}</pre>`}<//>
    <p><a href=${link("status")}>Status of the service</a></p>`;
}

export async function logOut(): Promise<void> {
  await send("DELETE", "v1/session");
  setSession(null);
}

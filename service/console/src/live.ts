// Jobs as the stream tells of them, for all parts of the page.
import { signal } from "@preact/signals";
import { getShown, session, setSession, type Job } from "./client";
import type { Connection, FromPage, FromWorker } from "./messages";
import { ProjectStream } from "./stream";

export const jobs = signal<ReadonlyMap<string, Job> | null>(null);
export const connection = signal<Connection>("connecting");
/** Rises when lists have to be read again: a job came or ended, or the stream began anew. */
export const epoch = signal(0);

const ENDED = ["SUCCEEDED", "FAILED", "CANCELLED"];
let tell: ((message: FromPage) => void) | null = null;
/** For each read of the list under way, oldest first: the jobs put since it began, which its answer may show as before. */
const reads = new Set<Map<string, Job>>();

export function hasEnded(job: Job): boolean {
  return ENDED.includes(job.state);
}

export function put(...changed: Job[]): void {
  const next = new Map(jobs.value ?? []);
  let isNews = false;
  for (const job of changed) {
    const before = next.get(job.id);
    isNews ||= !before || (hasEnded(job) && !hasEnded(before));
    next.set(job.id, job);
    for (const since of reads) since.set(job.id, job);
  }
  jobs.value = next;
  if (isNews) epoch.value += 1;
}

async function readJobs(): Promise<void> {
  const since = new Map<string, Job>();
  reads.add(since);
  try {
    const found = await getShown<Job>("v1/jobs");
    if (!reads.has(since)) return; // a later read was sooner here
    forgetUntil(since);
    jobs.value = new Map([...found.map((job): [string, Job] => [job.id, job]), ...since]);
    epoch.value += 1;
  } catch {
    reads.delete(since); // said by the connection; the stream's next start reads them again
  }
}

function forgetUntil(last: Map<string, Job>): void {
  for (const read of reads) {
    reads.delete(read);
    if (read === last) return;
  }
}

function hear(message: FromWorker): void {
  if (!session.value) return;
  if (message.type === "job") put(message.job);
  if (message.type === "jobs") put(...message.jobs);
  if (message.type === "connection") connection.value = message.connection;
  if (message.type === "ready") {
    connection.value = "live";
    void readJobs();
  }
  if (message.type === "end") setSession(null);
}

/** Follow the project until `unfollow`. */
export function follow(): void {
  if (tell) return;
  tell = "SharedWorker" in window ? throughWorker() : alone();
  tell({ type: document.hidden ? "hidden" : "visible" });
  void readJobs();
}

export function unfollow(): void {
  tell?.({ type: "leaves" });
  tell = null;
  reads.clear(); // whoever logs in next has other jobs
  jobs.value = null;
}

function throughWorker(): (message: FromPage) => void {
  const { port } = new SharedWorker(new URL("events.js", import.meta.url), { name: "mrasfm-events" });
  port.onmessage = ({ data }: MessageEvent<FromWorker>) => hear(data);
  port.start();
  return (message) => port.postMessage(message);
}

function alone(): (message: FromPage) => void {
  const stream = new ProjectStream("v1/", hear);
  return (message) => (message.type === "visible" ? stream.open() : stream.close());
}

document.addEventListener("visibilitychange", () => tell?.({ type: document.hidden ? "hidden" : "visible" }));
window.addEventListener("pagehide", () => tell?.({ type: "leaves" }));
window.addEventListener("pageshow", (event) => event.persisted && tell?.({ type: "visible" }));

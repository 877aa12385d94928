// Jobs as the stream tells of them, for all parts of the page.
import { signal } from "@preact/signals";
import { get, getShown, identityOf, mayPass, ProblemError, session, setSession, type Job, type Session } from "./client";
import type { Connection, FromPage, FromWorker } from "./messages";
import { ProjectStream } from "./stream";

export const jobs = signal<ReadonlyMap<string, Job> | null>(null);
export const connection = signal<Connection>("connecting");
/** Rises when lists have to be read again: a job came or ended, or the stream began anew. */
export const epoch = signal(0);

const ENDED = ["SUCCEEDED", "FAILED", "CANCELLED"];
const AGAIN_MS = 1000;
let tell: ((type: FromPage["type"]) => void) | null = null;
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
  if (message.type === "end") void checkSession();
}

/** The stream ended with its session. Another page may have begun another one, which the cookie now stands for. */
async function checkSession(): Promise<void> {
  const before = identityOf(session.value);
  try {
    const now = await get<Session>("v1/session");
    setSession(now);
    if (identityOf(now) === before) tell?.(document.hidden ? "hidden" : "visible");
  } catch (error) {
    if (error instanceof ProblemError && mayPass(error)) setTimeout(() => void checkSession(), AGAIN_MS);
    else setSession(null);
  }
}

/** Follow the project until `unfollow`. */
export function follow(): void {
  if (tell) return;
  tell = "SharedWorker" in window ? throughWorker() : alone();
  tell(document.hidden ? "hidden" : "visible");
  void readJobs();
}

export function unfollow(): void {
  tell?.("leaves");
  tell = null;
  reads.clear(); // whoever logs in next has other jobs
  jobs.value = null;
}

function throughWorker(): (type: FromPage["type"]) => void {
  const of = identityOf(session.value);
  const { port } = new SharedWorker(new URL("events.js", import.meta.url), { name: "mrasfm-events" });
  port.onmessage = ({ data }: MessageEvent<FromWorker>) => hear(data);
  port.start();
  return (type) => port.postMessage({ type, session: of } satisfies FromPage);
}

function alone(): (type: FromPage["type"]) => void {
  const stream = new ProjectStream("v1/", hear);
  return (type) => (type === "visible" ? stream.open() : stream.close());
}

document.addEventListener("visibilitychange", () => tell?.(document.hidden ? "hidden" : "visible"));
window.addEventListener("pagehide", () => tell?.("leaves"));
window.addEventListener("pageshow", (event) => event.persisted && tell?.("visible"));

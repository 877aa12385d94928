// Requests to the API of this host. The cookie goes along by itself; the key is never kept here.
import { signal } from "@preact/signals";
import type { components } from "./api";

type Schemas = components["schemas"];
export type Job = Schemas["JobResource"];
export type Drive = Schemas["DriveResource"];
export type Scene = Schemas["SceneResource"];
export type MapResource = Schemas["MapResource"];
export type MapVersion = Schemas["MapVersionResource"];
export type Session = Schemas["SessionResource"];
export type Status = Schemas["ServiceStatus"];
export type Preflight = Schemas["PreflightResource"];
export type Problem = Pick<Schemas["Problem"], "title" | "detail" | "remedy"> & Partial<Schemas["Problem"]>;
export type Finding = Schemas["Finding"];
export type Upload = Schemas["UploadResource"];
export type FileResource = Schemas["SceneFileResource"];
export type Export = Schemas["ExportResource"];
export type ExportRequest = Schemas["ExportRequest"];
export type ExportFormat = ExportRequest["formats"][number];
export interface Page<Item> {
  items: Item[];
  next?: string | null;
}

/** undefined: not asked yet; null: nobody is logged in. */
export const session = signal<Session | null | undefined>(undefined);

const MAY_BE_THERE = "mrasfm-session"; // remembers that a cookie may be there, which scripts cannot see

/** Which session it is: the cookie of all pages is one, so that another page may have begun another. */
export function identityOf(one: Session | null | undefined): string {
  return one ? `${one.key_id} ${one.session_expires_at ?? ""}` : "";
}

/** Calls `changed` when another page logged in or out. */
export function watchSession(changed: () => void): void {
  window.addEventListener("storage", (event) => (event.key === MAY_BE_THERE || event.key === null) && changed());
  window.addEventListener("pageshow", (event) => event.persisted && changed()); // it was asleep, and heard nothing
}

export function remembersSession(): boolean {
  return localStorage.getItem(MAY_BE_THERE) === "1";
}

export function setSession(value: Session | null): void {
  if (value) localStorage.setItem(MAY_BE_THERE, "1");
  else localStorage.removeItem(MAY_BE_THERE);
  session.value = value;
}

export class ProblemError extends Error {
  constructor(
    readonly problem: Problem,
    readonly status: number,
  ) {
    super(problem.detail);
  }
}

/** A value of 128 random bits; `crypto.randomUUID` does not exist on plain http. */
export function randomName(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

interface Options {
  json?: unknown;
  text?: string; // JSON that is sent byte for byte
  headers?: Record<string, string>;
  signal?: AbortSignal;
}

export async function send(method: string, path: string, options: Options = {}): Promise<Response> {
  const headers = new Headers(options.headers);
  const init: RequestInit = { method, headers, credentials: "same-origin" };
  const body = options.json === undefined ? options.text : JSON.stringify(options.json);
  if (body !== undefined) {
    headers.set("Content-Type", "application/json");
    init.body = body;
  }
  if (method === "POST" && path !== "v1/session" && !headers.has("Idempotency-Key")) headers.set("Idempotency-Key", randomName());
  if (options.signal) init.signal = options.signal;
  let answer: Response;
  try {
    answer = await fetch(path, init);
  } catch (error) {
    if (options.signal?.aborted) throw error;
    throw new ProblemError(
      {
        title: "The service does not answer",
        detail: "The request did not reach the service.",
        remedy: "Check the connection; this page goes on by itself when the service is back.",
      },
      0,
    );
  }
  if (answer.ok) return answer;
  throw await refusalOf(answer);
}

export async function refusalOf(answer: Response): Promise<ProblemError> {
  if (answer.status === 401) setSession(null);
  const isProblem = answer.headers.get("content-type")?.startsWith("application/problem+json");
  const problem = isProblem ? await (answer.json() as Promise<Problem>).catch(() => null) : null; // HEAD gives no body
  const unknown = { title: `HTTP ${answer.status}`, detail: answer.statusText || "No details.", remedy: "Try again." };
  return new ProblemError(problem ?? unknown, answer.status);
}

const PASSING = [0, 408, 423, 429]; // 0: no answer
const IN_FLIGHT = "urn:mrasfm:problem:request-in-flight"; // the same request, whose answer was lost

/** Whether the same request may succeed later. */
export function mayPass(error: unknown): boolean {
  if (!(error instanceof ProblemError)) return true;
  return PASSING.includes(error.status) || error.status >= 500 || error.problem.type === IN_FLIGHT;
}

export async function get<Resource>(path: string, abort?: AbortSignal): Promise<Resource> {
  const answer = await send("GET", path, abort ? { signal: abort } : {});
  return (await answer.json()) as Resource;
}

/** A list to be shown, up to a bound that no project of people reaches. */
export function getShown<Item>(path: string, abort?: AbortSignal): Promise<Item[]> {
  return getPages<Item>(path, 200, 5000, abort);
}

/** A whole list, however long: a drive may have a million files. */
export function getAll<Item>(path: string, abort?: AbortSignal): Promise<Item[]> {
  return getPages<Item>(path, 1000, Infinity, abort);
}

async function getPages<Item>(path: string, limit: number, enough: number, abort?: AbortSignal): Promise<Item[]> {
  const items: Item[] = [];
  let next: string | null | undefined = "";
  while (next !== null && next !== undefined && items.length < enough) {
    const cursor: string = next === "" ? "" : `&cursor=${encodeURIComponent(next)}`;
    const page: Page<Item> = await get<Page<Item>>(`${path}${path.includes("?") ? "&" : "?"}limit=${limit}${cursor}`, abort);
    items.push(...page.items);
    next = page.next;
  }
  return items;
}

export function fileUrl(owner: string, path: string): string {
  return `${owner}/files/${path.split("/").map(encodeURIComponent).join("/")}`;
}

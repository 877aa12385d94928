// What pages and the worker that holds their one stream say to each other.
import type { Job } from "./client";

export type FromPage = { type: "visible" | "hidden" | "leaves"; session: string };
export type Connection = "connecting" | "live" | "polling" | "offline";
export type FromWorker =
  | { type: "job"; job: Job }
  | { type: "jobs"; jobs: Job[] }
  | { type: "ready" }
  | { type: "connection"; connection: Connection }
  | { type: "end" };

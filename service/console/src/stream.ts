// One event stream, with polling as its fallback. A browser opens six connections to a host at most, so that all pages
// share one stream where the browser can.
import type { Job, Page } from "./client";
import type { Connection, FromWorker } from "./messages";

const POLL_MS = 3000;
const GRACE_MS = 4000; // a stream that reconnects at once needs no polling
const CLOSED = 2;
const NOT_MODIFIED = 304;

export class ProjectStream {
  private source: EventSource | null = null;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private etag = "";
  private isDown = false; // since the stream's last start, there was a poll

  constructor(
    private readonly api: string,
    private readonly say: (message: FromWorker) => void,
  ) {}

  get isOpen(): boolean {
    return this.source !== null;
  }

  open(): void {
    if (this.source) return;
    this.isDown = false;
    this.connection("connecting");
    this.listen();
  }

  private listen(): void {
    const source = new EventSource(`${this.api}events`);
    this.source = source;
    source.addEventListener("ready", () => {
      this.stopPolling();
      this.isDown = false;
      this.connection("live");
      this.say({ type: "ready" });
    });
    source.addEventListener("job", (event) => {
      this.say({ type: "job", job: JSON.parse((event as MessageEvent<string>).data) as Job });
    });
    source.addEventListener("end", () => this.end());
    source.onerror = () => this.fallBack(source);
  }

  close(): void {
    this.source?.close();
    this.source = null;
    this.stopPolling();
  }

  private connection(connection: Connection): void {
    this.say({ type: "connection", connection });
  }

  private end(): void {
    this.close();
    this.say({ type: "end" });
  }

  private fallBack(source: EventSource): void {
    if (source !== this.source || this.timer !== undefined) return;
    if (!this.isDown) this.connection("connecting");
    this.timer = setTimeout(() => void this.poll(), source.readyState === CLOSED ? 0 : GRACE_MS);
  }

  private stopPolling(): void {
    clearTimeout(this.timer);
    this.timer = undefined;
  }

  private async poll(): Promise<void> {
    const source = this.source;
    try {
      const answer = await fetch(`${this.api}jobs?limit=100`, { headers: { "If-None-Match": this.etag } });
      if (answer.status === 401) return this.end();
      if (this.source !== source || this.timer === undefined) return;
      if (answer.status === 200) {
        this.etag = answer.headers.get("etag") ?? "";
        this.say({ type: "jobs", jobs: ((await answer.json()) as Page<Job>).items });
      }
      this.connection(answer.ok || answer.status === NOT_MODIFIED ? "polling" : "offline");
    } catch {
      this.connection("offline");
    }
    if (this.source !== source || source === null) return;
    this.isDown = true;
    this.timer = setTimeout(() => this.again(source), POLL_MS);
  }

  /** A browser gives up where the service, or a proxy in its place, answered with an error: it is asked anew, not at once. */
  private again(source: EventSource): void {
    if (source.readyState !== CLOSED) return void this.poll();
    this.stopPolling();
    this.listen();
  }
}

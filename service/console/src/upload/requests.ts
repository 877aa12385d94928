// Requests of an upload, which are made again where the service, or the way to it, was at fault.
import { mayPass, randomName, refusalOf, send } from "../client";

const TRIES = 6;

export async function require(answer: Response): Promise<Response> {
  if (answer.ok) return answer;
  throw await refusalOf(answer);
}

/** Tries of something, until it has gone on. */
export class RetryBudget {
  private failed = 0;

  constructor(private readonly abort: AbortSignal) {}

  renew(): void {
    this.failed = 0;
  }

  /** Wait before the next try, each time longer; what failed is thrown where it was the last one. */
  async pause(error: unknown): Promise<void> {
    this.failed += 1;
    if (this.abort.aborted || this.failed >= TRIES) throw error;
    await new Promise((done) => setTimeout(done, 500 * 2 ** this.failed));
  }
}

export async function again<Value>(work: () => Promise<Value>, abort: AbortSignal): Promise<Value> {
  const budget = new RetryBudget(abort);
  for (;;) {
    try {
      return await work();
    } catch (error) {
      if (!mayPass(error)) throw error;
      await budget.pause(error);
    }
  }
}

/** Sends a request until it has an answer that counts; by its key a repetition is known. */
export function sendAgain(method: string, path: string, abort: AbortSignal, text?: string): Promise<Response> {
  const headers = method === "POST" ? { "Idempotency-Key": randomName() } : {};
  return again(() => send(method, path, { headers, signal: abort, ...(text === undefined ? {} : { text }) }), abort);
}

// Requests of an upload, which are made again where the service, or the way to it, was at fault.
import { ProblemError, refusalOf } from "../client";

const TRIES = 6;
const PASSING = [0, 408, 423, 429]; // 0: no answer
const IN_FLIGHT = "urn:mrasfm:problem:request-in-flight"; // the same request, whose answer was lost

export async function require(answer: Response): Promise<Response> {
  if (answer.ok) return answer;
  throw await refusalOf(answer);
}

/** Whether the same request may succeed later. */
export function mayPass(error: unknown): boolean {
  if (!(error instanceof ProblemError)) return true;
  return PASSING.includes(error.status) || error.status >= 500 || error.problem.type === IN_FLIGHT;
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

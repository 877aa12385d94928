// Large files in pieces, after tus 1.0.0. The service says where a file goes on: of a piece whose answer was lost, it
// may have kept any part.
import { getAll, mayPass, ProblemError, randomName, refusalOf, type Drive, type Upload } from "../client";
import type { Identified } from "./folder";
import { again, require, RetryBudget } from "./requests";

export const IN_PIECES = 8 << 20; // bytes from which on a file is sent so
const PIECE = 8 << 20;
const TUS = { "Tus-Resumable": "1.0.0" };
const WRONG_OFFSET = "urn:mrasfm:problem:wrong-offset";

interface Position {
  url: string;
  offset: number;
}

/** Sends what the service does not have of a file; `sent` hears how many bytes more it has. */
export async function sendInPieces(drive: Drive, one: Identified, sent: (bytes: number) => void, abort: AbortSignal): Promise<void> {
  const uploads = `v1/drives/${drive.id}/uploads`;
  const budget = new RetryBudget(abort);
  let at = await positionIn(await begun(uploads, one, abort), uploads, one, abort);
  let furthest = at.offset;
  sent(at.offset);
  while (at.offset < one.file.size) {
    const before = at.offset;
    try {
      at = { url: at.url, offset: await append(at, one.file, abort) };
    } catch (error) {
      if (!mayPass(error) && !isWrongOffset(error)) throw error;
      await budget.pause(error);
      at = await positionIn(at.url, uploads, one, abort);
    }
    if (at.offset > furthest) budget.renew();
    furthest = Math.max(furthest, at.offset);
    sent(at.offset - before);
  }
}

/** The upload of this file that another page, or another browser, has begun. */
async function begun(uploads: string, { path, sha256 }: Identified, abort: AbortSignal): Promise<string | null> {
  const found = (await again(() => getAll<Upload>(`${uploads}?sha256=${sha256}`, abort), abort)).find((upload) => upload.path === path);
  return found ? `${uploads}/${found.id}` : null;
}

/** Where an upload goes on; a new one begins where the service has none at the address. */
async function positionIn(url: string | null, uploads: string, one: Identified, abort: AbortSignal): Promise<Position> {
  const offset = url === null ? null : await again(() => offsetOf(url, abort), abort);
  return url === null || offset === null ? create(uploads, one, abort) : { url, offset };
}

async function offsetOf(url: string, abort: AbortSignal): Promise<number | null> {
  const answer = await fetch(url, { method: "HEAD", headers: TUS, signal: abort });
  if (answer.ok) return Number(answer.headers.get("upload-offset"));
  const refusal = await refusalOf(answer);
  if (mayPass(refusal)) throw refusal;
  return null; // an answer to HEAD has no words: that to a new upload says what is wrong
}

async function create(uploads: string, { path, file, sha256 }: Identified, abort: AbortSignal): Promise<Position> {
  const given = { path, sha256, replace: "true" };
  const metadata = Object.entries(given).map(([name, value]) => `${name} ${base64OfText(value)}`).join(",");
  // By its key a repetition is known: each upload counts with all of its bytes.
  const headers = { ...TUS, "Upload-Length": String(file.size), "Upload-Metadata": metadata, "Idempotency-Key": randomName() };
  const answer = await again(async () => require(await fetch(uploads, { method: "POST", headers, signal: abort })), abort);
  return { url: answer.headers.get("location")!.replace(/^\//, ""), offset: Number(answer.headers.get("upload-offset")) };
}

/** Sends the next piece; the offset after it. */
async function append({ url, offset }: Position, file: Blob, abort: AbortSignal): Promise<number> {
  const headers = { ...TUS, "Upload-Offset": String(offset), "Content-Type": "application/offset+octet-stream" };
  const body = file.slice(offset, offset + PIECE);
  const answer = await require(await fetch(url, { method: "PATCH", body, headers, signal: abort }));
  return Number(answer.headers.get("upload-offset"));
}

function isWrongOffset(error: unknown): boolean {
  return error instanceof ProblemError && error.problem.type === WRONG_OFFSET;
}

function base64OfText(text: string): string {
  return btoa(String.fromCharCode(...new TextEncoder().encode(text)));
}

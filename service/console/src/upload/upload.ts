// The upload of a drive. What the service has is asked, not remembered: another browser goes on where this one stopped.
import { fileUrl, getAll, ProblemError, send, type Drive } from "../client";
import { Hasher } from "./hashing";
import { MANIFEST, type Folder } from "./folder";

const IN_PIECES = 8 << 20; // bytes from which on a file is sent resumably
const PIECE = 8 << 20;
const AT_ONE_TIME = 4;
const TRIES = 6;
const TUS = { "Tus-Resumable": "1.0.0" };

export interface Progress {
  step: "creates" | "hashes" | "sends" | "commits" | "done";
  doneBytes: number;
  totalBytes: number;
  sentFiles: number;
  files: number;
}
interface DriveFile {
  path: string;
  sha256?: string | null;
  size_bytes?: number | null;
}
interface Missing {
  path: string;
  file: File;
  sha256: string;
}

export function refuse(detail: string, remedy: string): ProblemError {
  return new ProblemError({ title: "The folder is no drive", detail, remedy }, 0);
}

export async function upload(folder: Folder, say: (progress: Progress) => void, abort: AbortSignal): Promise<Drive> {
  const manifest = folder.get(MANIFEST);
  if (!manifest) throw refuse(`There is no ${MANIFEST} in it.`, "Choose the folder that drive.json is in; 'mrasfm import' makes one of other recordings.");
  const progress: Progress = { step: "creates", doneBytes: 0, totalBytes: 0, sentFiles: 0, files: 0 };
  say({ ...progress });
  const drive = await openDrive(await manifest.text(), abort);
  const named = await getAll<DriveFile>(`v1/drives/${drive.id}/files`, abort);
  const absent = named.filter((one) => !folder.has(one.path));
  if (absent.length > 0) {
    const first = absent.slice(0, 5).map((one) => one.path).join(", ");
    throw refuse(`${absent.length} of ${named.length} files that the manifest names are missing: ${first}${absent.length > 5 ? " …" : ""}.`, "Complete the folder; what is sent already stays.");
  }
  const files = named.map(({ path }) => ({ path, file: folder.get(path)! }));
  Object.assign(progress, { step: "hashes", files: files.length, totalBytes: files.reduce((sum, { file }) => sum + file.size, 0) });
  const missing = await declare(drive, files, progress, say, abort);
  Object.assign(progress, { step: "sends", doneBytes: progress.totalBytes - missing.reduce((sum, { file }) => sum + file.size, 0), sentFiles: files.length - missing.length });
  say({ ...progress });
  await sendAll(drive, missing, (bytes, isWhole) => {
    progress.doneBytes += bytes;
    if (isWhole) progress.sentFiles += 1;
    say({ ...progress });
  }, abort);
  say({ ...progress, step: "commits" });
  const committed = (await (await send("POST", `v1/drives/${drive.id}:commit`, { signal: abort })).json()) as Drive;
  say({ ...progress, step: "done" });
  return committed;
}

/** The open drive of this manifest, or a new one. */
async function openDrive(manifest: string, abort: AbortSignal): Promise<Drive> {
  for (const drive of await getAll<Drive>("v1/drives", abort)) {
    if (drive.state !== "OPEN") continue;
    const stored = await (await send("GET", `v1/drives/${drive.id}/manifest`, { signal: abort })).text();
    if (stored === manifest) return drive;
  }
  const answer = await send("POST", "v1/drives", { text: manifest, signal: abort });
  return (await answer.json()) as Drive;
}

async function declare(drive: Drive, files: { path: string; file: File }[], progress: Progress, say: (progress: Progress) => void, abort: AbortSignal): Promise<Missing[]> {
  const hasher = new Hasher();
  const hashed: Missing[] = [];
  try {
    for (const { path, file } of files) {
      if (abort.aborted) throw abort.reason;
      hashed.push({ path, file, sha256: await hasher.sha256(file) });
      progress.doneBytes += file.size;
      say({ ...progress });
    }
  } finally {
    hasher.close();
  }
  const declaration = { files: hashed.map(({ path, file, sha256 }) => ({ path, size_bytes: file.size, sha256 })) };
  const answer = await send("POST", `v1/drives/${drive.id}/files:declare`, { json: declaration, signal: abort });
  const { to_send: wanted } = (await answer.json()) as { to_send: string[] };
  const names = new Set(wanted);
  return hashed.filter(({ path }) => names.has(path));
}

async function sendAll(drive: Drive, missing: readonly Missing[], sent: (bytes: number, isWhole: boolean) => void, abort: AbortSignal): Promise<void> {
  const queue = [...missing];
  const work = async (): Promise<void> => {
    for (let next = queue.shift(); next; next = queue.shift()) {
      const one = next;
      if (one.file.size >= IN_PIECES) await inPieces(drive, one, sent, abort);
      else {
        await again(() => put(drive, one, abort), abort);
        sent(one.file.size, true);
      }
    }
  };
  await Promise.all(Array.from({ length: AT_ONE_TIME }, work));
}

async function put(drive: Drive, { path, file, sha256 }: Missing, abort: AbortSignal): Promise<void> {
  const answer = await fetch(fileUrl(`v1/drives/${drive.id}`, path), { method: "PUT", body: file, headers: { "Content-Digest": `sha-256=:${base64OfHex(sha256)}:` }, signal: abort });
  await require(answer);
}

async function inPieces(drive: Drive, { path, file, sha256 }: Missing, sent: (bytes: number, isWhole: boolean) => void, abort: AbortSignal): Promise<void> {
  const remembered = `upload ${drive.id} ${sha256}`;
  let url = localStorage.getItem(remembered);
  let offset = url ? await offsetOf(url, abort) : null;
  if (url === null || offset === null) {
    const metadata = `path ${base64OfText(path)},sha256 ${base64OfText(sha256)}`;
    const answer = await require(await fetch(`v1/drives/${drive.id}/uploads`, { method: "POST", headers: { ...TUS, "Upload-Length": String(file.size), "Upload-Metadata": metadata }, signal: abort }));
    url = answer.headers.get("location")!.replace(/^\//, "");
    offset = 0;
    localStorage.setItem(remembered, url);
  }
  sent(offset, false);
  while (offset < file.size) {
    const from: number = offset;
    const target = url;
    const piece = file.slice(from, from + PIECE);
    const answer = await again(async () => require(await fetch(target, { method: "PATCH", body: piece, headers: { ...TUS, "Upload-Offset": String(from), "Content-Type": "application/offset+octet-stream" }, signal: abort })), abort);
    offset = Number(answer.headers.get("upload-offset"));
    sent(offset - from, offset >= file.size);
  }
  localStorage.removeItem(remembered);
}

async function offsetOf(url: string, abort: AbortSignal): Promise<number | null> {
  const answer = await fetch(url, { method: "HEAD", headers: TUS, signal: abort });
  return answer.ok ? Number(answer.headers.get("upload-offset")) : null;
}

async function require(answer: Response): Promise<Response> {
  if (answer.ok) return answer;
  const isProblem = answer.headers.get("content-type")?.startsWith("application/problem+json");
  const problem = isProblem ? await answer.json() : { title: `HTTP ${answer.status}`, detail: answer.statusText, remedy: "Try again." };
  throw new ProblemError(problem, answer.status);
}

/** Once more, later, where the service or the way to it was at fault. */
async function again<Value>(work: () => Promise<Value>, abort: AbortSignal): Promise<Value> {
  for (let tried = 1; ; tried += 1) {
    try {
      return await work();
    } catch (error) {
      const isPassing = !(error instanceof ProblemError) || error.status >= 500 || error.status === 423 || error.status === 429;
      if (abort.aborted || !isPassing || tried >= TRIES) throw error;
      await new Promise((done) => setTimeout(done, 500 * 2 ** tried));
    }
  }
}

function base64OfHex(hex: string): string {
  return btoa(String.fromCharCode(...hex.match(/../g)!.map((byte) => parseInt(byte, 16))));
}

function base64OfText(text: string): string {
  return btoa(String.fromCharCode(...new TextEncoder().encode(text)));
}

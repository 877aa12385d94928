// The upload of a drive. What the service has is asked, not remembered: another browser goes on where this one stopped.
import { fileUrl, getAll, ProblemError, send, type Drive } from "../client";
import { Hasher } from "./hashing";
import { requireExpected } from "./archive";
import { composed, MANIFEST, type Folder, type Identified } from "./folder";
import { again, require, sendAgain } from "./requests";
import { IN_PIECES, sendInPieces } from "./resumable";

const AT_ONE_TIME = 4;
const DECLARED_AT_ONCE = 1000; // files; the service bounds them, and a request answers soon

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

function refuse(folder: Folder, detail: string, remedy: string): ProblemError {
  return new ProblemError({ title: `The ${folder.what} is no drive`, detail, remedy }, 0);
}

export async function upload(folder: Folder, say: (progress: Progress) => void, abort: AbortSignal): Promise<Drive> {
  const manifest = await folder.manifest();
  if (manifest === null) throw refuse(folder, `There is no ${MANIFEST} in it.`, `Choose the folder that ${MANIFEST} is in, or an archive of it; 'mrasfm import' makes one of other recordings.`);
  const progress: Progress = { step: "creates", doneBytes: 0, totalBytes: 0, sentFiles: 0, files: 0 };
  say({ ...progress });
  const { drive, isNew } = await openDrive(manifest, abort);
  const named = new Map((await again(() => getAll<DriveFile>(`v1/drives/${drive.id}/files`, abort), abort)).map(({ path }) => [composed(path), path]));
  try {
    requireComplete(folder, named);
  } catch (error) {
    if (isNew) await sendAgain("DELETE", `v1/drives/${drive.id}`, abort).catch(() => null); // what is wrong with the folder matters more
    throw error;
  }
  const size = (path: string): number => folder.sizes.get(path)!;
  const total = (paths: Iterable<string>): number => [...paths].reduce((sum, path) => sum + size(path), 0);
  Object.assign(progress, { step: "hashes", files: named.size, totalBytes: total(named.keys()) });
  const digests = await identify(folder, named, progress, say, abort);
  const missing = await declare(drive, folder, named, digests, abort);
  Object.assign(progress, { step: "sends", doneBytes: progress.totalBytes - total(missing.keys()), sentFiles: named.size - missing.size });
  say({ ...progress });
  await sendAll(drive, folder, named, missing, (bytes, isWhole) => {
    progress.doneBytes += bytes;
    if (isWhole) progress.sentFiles += 1;
    say({ ...progress });
  }, abort);
  say({ ...progress, step: "commits" });
  const committed = (await (await sendAgain("POST", `v1/drives/${drive.id}:commit`, abort)).json()) as Drive;
  say({ ...progress, step: "done" });
  return committed;
}

function requireComplete(folder: Folder, named: ReadonlyMap<string, string>): void {
  requireExpected(folder, new Set(named.keys()));
  const absent = [...named.keys()].filter((path) => !folder.sizes.has(path));
  if (absent.length === 0) return;
  const first = absent.slice(0, 5).join(", ");
  throw refuse(folder, `${absent.length} of ${named.size} files that the manifest names are missing: ${first}${absent.length > 5 ? " …" : ""}.`, `Complete the ${folder.what}; files that were sent before are not sent again.`);
}

/** The open drive of this manifest, or a new one. */
async function openDrive(manifest: string, abort: AbortSignal): Promise<{ drive: Drive; isNew: boolean }> {
  for (const drive of await again(() => getAll<Drive>("v1/drives", abort), abort)) {
    if (drive.state !== "OPEN") continue;
    const stored = await (await sendAgain("GET", `v1/drives/${drive.id}/manifest`, abort)).text();
    if (stored === manifest) return { drive, isNew: false };
  }
  const answer = await sendAgain("POST", "v1/drives", abort, manifest);
  return { drive: (await answer.json()) as Drive, isNew: true };
}

/** SHA-256 of the files that the manifest names, by path. */
async function identify(folder: Folder, named: ReadonlyMap<string, string>, progress: Progress, say: (progress: Progress) => void, abort: AbortSignal): Promise<ReadonlyMap<string, string>> {
  const hasher = new Hasher();
  const found = new Map<string, string>();
  try {
    for await (const { path, file, crc32 } of folder.read(new Set(named.keys()))) {
      if (abort.aborted) throw abort.reason;
      try {
        found.set(path, await hasher.sha256(file, crc32));
      } catch (error) {
        throw refuse(folder, `'${path}' cannot be read: ${error instanceof Error ? error.message : String(error)}.`, `Check the ${folder.what}, then choose it again.`);
      }
      progress.doneBytes += file.size;
      say({ ...progress });
    }
  } finally {
    hasher.close();
  }
  return found;
}

/** The digests of the files that the service does not have. */
async function declare(drive: Drive, folder: Folder, named: ReadonlyMap<string, string>, digests: ReadonlyMap<string, string>, abort: AbortSignal): Promise<ReadonlyMap<string, string>> {
  const files = [...digests].map(([path, sha256]) => ({ path: named.get(path)!, size_bytes: folder.sizes.get(path)!, sha256 }));
  const wanted = new Set<string>();
  for (let first = 0; first < files.length; first += DECLARED_AT_ONCE) {
    const json = { files: files.slice(first, first + DECLARED_AT_ONCE) };
    const answer = await again(() => send("POST", `v1/drives/${drive.id}/files:declare`, { json, signal: abort }), abort);
    for (const path of ((await answer.json()) as { to_send: string[] }).to_send) wanted.add(path);
  }
  return new Map([...digests].filter(([path]) => wanted.has(named.get(path)!)));
}

async function sendAll(drive: Drive, folder: Folder, named: ReadonlyMap<string, string>, missing: ReadonlyMap<string, string>, sent: (bytes: number, isWhole: boolean) => void, abort: AbortSignal): Promise<void> {
  const entries = folder.read(new Set(missing.keys())); // shared: each takes the next one
  const work = async (): Promise<void> => {
    for (let next = await entries.next(); !next.done; next = await entries.next()) {
      const one = { ...next.value, path: named.get(next.value.path)!, sha256: missing.get(next.value.path)! };
      if (one.file.size >= IN_PIECES) {
        await sendInPieces(drive, one, (bytes) => sent(bytes, false), abort);
        sent(0, true);
      } else {
        await again(() => put(drive, one, abort), abort);
        sent(one.file.size, true);
      }
    }
  };
  await Promise.all(Array.from({ length: AT_ONE_TIME }, work));
}

/** Sends a small file. The drive has this manifest: where a file was changed here since it was sent, the new bytes count. */
async function put(drive: Drive, { path, file, sha256 }: Identified, abort: AbortSignal): Promise<void> {
  const answer = await fetch(`${fileUrl(`v1/drives/${drive.id}`, path)}?replace=true`, { method: "PUT", body: file, headers: { "Content-Digest": `sha-256=:${base64OfHex(sha256)}:` }, signal: abort });
  await require(answer);
}

function base64OfHex(hex: string): string {
  return btoa(String.fromCharCode(...hex.match(/../g)!.map((byte) => parseInt(byte, 16))));
}

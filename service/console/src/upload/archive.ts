// An archive as a folder. Its names are read here, so that a wrong one is refused before a byte is sent, and its files
// are sent one by one: what the service has already stays where it is, as with a folder.
import { ProblemError } from "../client";
import { composed, MANIFEST, type Entry, type Folder } from "./folder";
import { tarMembers, type Member } from "./tar";
import { zipMembers } from "./zip";

const MAGIC: [string, number[]][] = [
  ["zip", [0x50, 0x4b, 0x03, 0x04]], ["zip", [0x50, 0x4b, 0x05, 0x06]], ["gzip", [0x1f, 0x8b]], ["bzip2", [0x42, 0x5a, 0x68]],
  ["xz", [0xfd, 0x37, 0x7a, 0x58, 0x5a, 0x00]], ["7z", [0x37, 0x7a, 0xbc, 0xaf]], ["rar", [0x52, 0x61, 0x72, 0x21]],
];
const TAR_MAGIC_AT = 257;
const SHOWN = 5;
const LITTER = /(^|\/)(__MACOSX\/|\.DS_Store$|Thumbs\.db$|desktop\.ini$|\._[^/]*$)/;
// What `mrasfm import`, `mrasfm synth` and `mrasfm upload` leave beside the manifest: not sent, as nothing reads it there.
const BESIDE = /^(\.mrasfm-upload\.json$|truth(\.tum|_calibration\.json|_cameras\.json|_moving|_own_car|_world\.json)(\/|$))/;

export function refuse(detail: string, remedy: string): ProblemError {
  return new ProblemError({ title: "The archive is refused, nothing was sent", detail, remedy }, 0);
}

async function kindOf(file: File): Promise<string | null> {
  const start = new Uint8Array(await file.slice(0, 512).arrayBuffer());
  const found = MAGIC.find(([, magic]) => magic.every((byte, at) => start[at] === byte));
  if (found) return found[0];
  return new TextDecoder().decode(start.subarray(TAR_MAGIC_AT, TAR_MAGIC_AT + 5)) === "ustar" ? "tar" : null;
}

export async function isArchive(file: File): Promise<boolean> {
  return (await kindOf(file)) !== null;
}

/** The archive's files; refused where a name in it could mean a place outside the drive, or it is of another kind. */
export async function openArchive(file: File): Promise<Folder> {
  const kind = await kindOf(file);
  if (kind === "zip") return directly(await names(zipMembers(file)));
  if (kind === "tar") return directly(await names(tarMembers(file, false)));
  if (kind === "gzip") return inOrder(await names(tarMembers(file, true)), () => tarMembers(file, true));
  throw refuse(`${file.name} is packed with ${kind}, which browsers cannot unpack.`, "Unpack it and choose the folder, or pack it as zip, tar or tar.gz.");
}

/** Members by their path inside the drive. One top folder around all files does not count. */
async function names(members: AsyncGenerator<Member>): Promise<ReadonlyMap<string, Member>> {
  const found = new Map<string, Member>();
  for await (const member of members) {
    const name = safeName(member);
    if (name === null || LITTER.test(name)) continue;
    if (found.has(name)) throw refuse(`The archive holds '${name}' twice.`, "Make the archive again with each file once.");
    found.set(name, member);
  }
  const [first = ""] = found.keys();
  const top = `${first.split("/")[0]!}/`;
  const hasTop = !found.has(MANIFEST) && [...found.keys()].every((name) => name.startsWith(top));
  return hasTop ? new Map([...found].map(([name, member]) => [name.slice(top.length), member])) : found;
}

/** A member's path; null for a folder. */
function safeName({ name, isFolder, kind }: Member): string | null {
  const bad = (what: string, remedy = "Make the archive from inside the drive's folder, with relative names."): ProblemError => refuse(`The archive's member '${name.slice(0, 120)}' ${what}.`, remedy);
  if (kind) throw bad(`is ${kind}`, "Put the file itself into the archive.");
  if (/[\p{C}\u2028\u2029]/u.test(name)) throw bad("has control or invisible characters in its name");
  if (name.includes("\\")) throw bad("has a backslash in its name");
  if (name.startsWith("/")) throw bad("has an absolute name");
  if (/^[A-Za-z]:/.test(name)) throw bad("has a drive letter in its name");
  const plain = name.replace(/^\.\//, "").replace(isFolder ? /\/$/ : "", "");
  const parts = plain.split("/");
  if (parts.includes("..")) throw bad("leaves the drive's folder with '..'");
  if (isFolder) return null;
  if (parts.some((part) => part === "" || part === ".")) throw bad("has an empty part or '.' in its path");
  return composed(plain);
}

function sizes(members: ReadonlyMap<string, Member>): ReadonlyMap<string, number> {
  return new Map([...members].map(([path, member]) => [path, member.size]));
}

async function entry(path: string, member: Member): Promise<Entry> {
  const file = await member.content();
  if (file.size !== member.size) throw refuse(`The archive's member '${path}' unpacks to ${file.size} bytes and declares ${member.size}.`, "Make the archive again: it is damaged.");
  return { path, file, ...(member.crc32 === undefined ? {} : { crc32: member.crc32 }) };
}

/** An archive whose members can be read in any order. */
function directly(members: ReadonlyMap<string, Member>): Folder {
  return {
    what: "archive",
    sizes: sizes(members),
    manifest: async () => (members.has(MANIFEST) ? (await members.get(MANIFEST)!.content()).text() : null),
    read: async function* (paths) {
      for (const path of paths) yield entry(path, members.get(path)!);
    },
  };
}

/** A compressed tar: its members come in their order, each time from the beginning. */
function inOrder(members: ReadonlyMap<string, Member>, again: () => AsyncGenerator<Member>): Folder {
  const pathOf = new Map([...members].map(([path, member]) => [member.name, path]));
  async function* read(paths: ReadonlySet<string>): AsyncGenerator<Entry> {
    let left = paths.size;
    for await (const member of again()) {
      const path = pathOf.get(member.name);
      if (path === undefined || !paths.has(path)) continue;
      yield entry(path, member);
      if (--left === 0) return;
    }
  }
  return {
    what: "archive",
    sizes: sizes(members),
    manifest: async () => {
      for await (const { file } of read(new Set(members.has(MANIFEST) ? [MANIFEST] : []))) return file.text();
      return null;
    },
    read,
  };
}

/** Refuse files that are not the drive's, by name. */
export function requireExpected(folder: Folder, named: ReadonlySet<string>): void {
  const strange = [...folder.sizes.keys()].filter((path) => path !== MANIFEST && !named.has(path) && !BESIDE.test(path));
  if (folder.what !== "archive" || strange.length === 0) return;
  const more = strange.length > SHOWN ? ` and ${strange.length - SHOWN} more` : "";
  throw refuse(
    `${strange.length === 1 ? "One file" : `${strange.length} files`} of the archive ${strange.length === 1 ? "is" : "are"} none of the ${named.size} files of the drive's manifest: ${strange.slice(0, SHOWN).map((path) => `'${path}'`).join(", ")}${more}.`,
    "Leave them out of the archive, or name them as the manifest does; or choose the unpacked folder, of which only the drive's files are sent.",
  );
}

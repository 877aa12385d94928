// Members of a tar (ustar, pax, GNU's long names), from header to header; compressed with gzip it is read as a stream.
import { refuse } from "./archive";

export interface Member {
  name: string;
  isFolder: boolean;
  size: number; // bytes
  crc32?: number;
  kind?: string; // what it is where it is no file
  content: () => Promise<Blob>;
}

const BLOCK = 512;
const MOST_HEADER = 8192;
const [FILES, FOLDER] = [["", "0", "\0", "7"], "5"];
const KINDS: Record<string, string> = { "1": "a hard link", "2": "a symbolic link", "3": "a device", "4": "a device", "6": "a pipe", S: "a sparse file" };

interface Source {
  read: (size: number) => Promise<Uint8Array>; // fewer bytes at the end alone
  content: (size: number) => () => Promise<Blob>;
  pass: (size: number) => Promise<void>;
}

const damaged = (what: string): Error => refuse(`The archive is damaged: ${what}.`, "Make the archive again, or choose the unpacked folder.");

export async function* tarMembers(file: File, isPacked: boolean): AsyncGenerator<Member> {
  const source = isPacked ? streamed(file) : sliced(file);
  let where = "its beginning";
  let longName: string | null = null;
  let pax = new Map<string, string>();
  for (;;) {
    const header = await source.read(BLOCK);
    if (header.length < BLOCK) throw damaged(`it ends behind ${where} without its end mark`);
    if (header.every((byte) => byte === 0)) return;
    if (!isHeader(header)) throw damaged(`what follows ${where} is no header of a tar`);
    const type = String.fromCharCode(header[156]!);
    const size = pax.has("size") ? Number(pax.get("size")) : number(header, 124, 12);
    if (["x", "g", "L", "K", "X"].includes(type)) {
      if (size > MOST_HEADER) throw damaged(`a header behind ${where} has ${size} bytes`);
      const data = (await source.read(padded(size))).subarray(0, size);
      if (type === "L") longName = text(data).replace(/\0.*$/s, "");
      if (type === "x" || type === "X") pax = records(data);
      continue;
    }
    const prefix = text(field(header, 345, 155));
    const short = text(field(header, 0, 100));
    const isPosix = text(header.subarray(257, 263)) === "ustar\0";
    const name = pax.get("path") ?? longName ?? (isPosix && prefix ? `${prefix}/${short}` : short);
    const isFolder = type === FOLDER || (name.endsWith("/") && FILES.includes(type));
    const kind = [...pax.keys()].some((key) => key.startsWith("GNU.sparse.")) ? KINDS.S : (KINDS[type] ?? (FILES.includes(type) || isFolder ? undefined : `of the unknown type '${type}'`));
    [longName, pax] = [null, new Map()];
    where = `'${name.slice(0, 120)}'`;
    yield { name, isFolder, size, content: source.content(size), ...(kind ? { kind } : {}) };
    await source.pass(padded(size));
  }
}

function isHeader(header: Uint8Array): boolean {
  const sum = header.reduce((total, byte, at) => total + (at >= 148 && at < 156 ? 32 : byte), 0);
  return number(header, 148, 8) === sum;
}

function padded(size: number): number {
  return Math.ceil(size / BLOCK) * BLOCK;
}

function field(header: Uint8Array, at: number, length: number): Uint8Array {
  const part = header.subarray(at, at + length);
  const end = part.indexOf(0);
  return end < 0 ? part : part.subarray(0, end);
}

function text(data: Uint8Array): string {
  return new TextDecoder().decode(data);
}

/** Octal digits, or GNU's binary number. */
function number(header: Uint8Array, at: number, length: number): number {
  if (header[at]! & 0x80) return header.subarray(at + 1, at + length).reduce((value, byte) => value * 256 + byte, 0);
  return parseInt(text(field(header, at, length)).trim() || "0", 8);
}

function records(data: Uint8Array): Map<string, string> {
  const found = new Map<string, string>();
  for (let at = 0; at < data.length; ) {
    const space = data.indexOf(32, at);
    const end = at + Number(text(data.subarray(at, space)));
    const equals = data.indexOf(61, space);
    if (space < 0 || equals < 0 || !(end > equals) || end > data.length) throw damaged("an extended header cannot be read");
    found.set(text(data.subarray(space + 1, equals)), text(data.subarray(equals + 1, end - 1)));
    at = end;
  }
  return found;
}

function sliced(file: File): Source {
  let at = 0;
  return {
    read: async (size) => {
      at += size;
      return new Uint8Array(await file.slice(at - size, at).arrayBuffer());
    },
    content: (size) => {
      const part = file.slice(at, at + size);
      return () => Promise.resolve(part);
    },
    pass: (size) => {
      at += size;
      return Promise.resolve();
    },
  };
}

function streamed(file: File): Source {
  const reader = file.stream().pipeThrough(new DecompressionStream("gzip")).getReader();
  let rest = new Uint8Array(0);
  let taken = 0; // of the present content
  const upTo = async (size: number): Promise<Uint8Array[]> => {
    const parts: Uint8Array[] = [];
    for (let left = size; left > 0; ) {
      if (rest.length === 0) {
        const { done, value } = await reader.read().catch(() => {
          throw damaged("its compressed data are damaged or truncated");
        });
        if (done) break;
        rest = value;
      }
      const part = rest.subarray(0, left);
      parts.push(part);
      rest = rest.subarray(part.length);
      left -= part.length;
    }
    return parts;
  };
  return {
    read: async (size) => new Uint8Array(await new Blob((await upTo(size)) as BlobPart[]).arrayBuffer()),
    content: (size) => async () => {
      taken = size;
      return new Blob((await upTo(size)) as BlobPart[]);
    },
    pass: async (size) => {
      await upTo(size - taken);
      taken = 0;
    },
  };
}

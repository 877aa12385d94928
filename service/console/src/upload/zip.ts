// The directory of a zip, which lies at its end: names, sizes and places of all members.
import { refuse } from "./archive";
import type { Member } from "./tar";

const END = 0x06054b50;
const END64 = 0x06064b50;
const LOCATOR64 = 0x07064b50;
const MEMBER = 0x02014b50;
const LOCAL = 0x04034b50;
const [END_BYTES, LOCATOR_BYTES, END64_BYTES, MEMBER_BYTES, LOCAL_BYTES] = [22, 20, 56, 46, 30];
const MOST_COMMENT = 0xffff;
const IN_ZIP64 = 0xffffffff;
const [STORED, DEFLATED] = [0, 8];
const KINDS: Record<number, string> = { 0xa000: "a symbolic link", 0x2000: "a device", 0x6000: "a device", 0x1000: "a pipe", 0xc000: "a socket" };

async function bytes(file: Blob, begin: number, end: number): Promise<DataView> {
  return new DataView(await file.slice(begin, end).arrayBuffer());
}

const damaged = (what: string): Error => refuse(`The archive is damaged: ${what}.`, "Make the archive again, or choose the unpacked folder.");

export async function* zipMembers(file: File): AsyncGenerator<Member> {
  const { entries, offset, size } = await directory(file);
  const data = await bytes(file, offset, offset + size);
  let at = 0;
  for (let number = 0; number < entries; number += 1) {
    if (at + MEMBER_BYTES > data.byteLength || data.getUint32(at, true) !== MEMBER) throw damaged("its directory cannot be read");
    const nameBytes = data.getUint16(at + 28, true);
    const extraBytes = data.getUint16(at + 30, true);
    yield member(file, data, at, nameBytes, extraBytes);
    at += MEMBER_BYTES + nameBytes + extraBytes + data.getUint16(at + 32, true);
  }
}

async function directory(file: File): Promise<{ entries: number; offset: number; size: number }> {
  const from = Math.max(0, file.size - END_BYTES - MOST_COMMENT);
  const tail = await bytes(file, from, file.size);
  for (let at = tail.byteLength - END_BYTES; at >= 0; at -= 1) {
    if (tail.getUint32(at, true) !== END || at + END_BYTES + tail.getUint16(at + 20, true) !== tail.byteLength) continue;
    const found = { entries: tail.getUint16(at + 10, true), size: tail.getUint32(at + 12, true), offset: tail.getUint32(at + 16, true) };
    const locator = await bytes(file, from + at - LOCATOR_BYTES, from + at);
    if (locator.byteLength < LOCATOR_BYTES || locator.getUint32(0, true) !== LOCATOR64) return found;
    const end = await bytes(file, from + at - LOCATOR_BYTES - END64_BYTES, from + at - LOCATOR_BYTES);
    if (end.byteLength < END64_BYTES || end.getUint32(0, true) !== END64) throw damaged("its zip64 directory does not lie where it says");
    return { entries: Number(end.getBigUint64(32, true)), size: Number(end.getBigUint64(40, true)), offset: Number(end.getBigUint64(48, true)) };
  }
  throw damaged("its directory is missing at the end, so it is truncated");
}

function member(file: File, data: DataView, at: number, nameBytes: number, extraBytes: number): Member {
  const name = text(data, at + MEMBER_BYTES, nameBytes);
  const flags = data.getUint16(at + 8, true);
  const method = data.getUint16(at + 10, true);
  const kind = KINDS[(data.getUint32(at + 38, true) >>> 16) & 0xf000];
  const [size, packed, offset] = wide(data, at + MEMBER_BYTES + nameBytes, extraBytes, [data.getUint32(at + 24, true), data.getUint32(at + 20, true), data.getUint32(at + 42, true)]);
  if (flags & 1) throw refuse(`The archive's member '${name}' is encrypted.`, "Make the archive without a password.");
  if (method !== STORED && method !== DEFLATED) throw refuse(`The archive's member '${name}' is compressed by method ${method}.`, "Make the archive with Deflate, or without compression.");
  const content = async (): Promise<Blob> => {
    const local = await bytes(file, offset, offset + LOCAL_BYTES);
    if (local.byteLength < LOCAL_BYTES || local.getUint32(0, true) !== LOCAL) throw damaged(`'${name}' does not lie where its directory says`);
    const begin = offset + LOCAL_BYTES + local.getUint16(26, true) + local.getUint16(28, true);
    const stored = file.slice(begin, begin + packed);
    if (method === STORED) return stored;
    try {
      return await new Response(stored.stream().pipeThrough(new DecompressionStream("deflate-raw"))).blob();
    } catch {
      throw damaged(`'${name}' cannot be unpacked`);
    }
  };
  return { name, isFolder: name.endsWith("/"), size, crc32: data.getUint32(at + 16, true), content, ...(kind ? { kind } : {}) };
}

/** Size, packed size and offset; those of over 4 GB stand in a field of their own. */
function wide(data: DataView, at: number, length: number, values: [number, number, number]): [number, number, number] {
  for (let field = at; field + 4 <= at + length; field += 4 + data.getUint16(field + 2, true)) {
    if (data.getUint16(field, true) !== 1) continue;
    let next = field + 4;
    return values.map((value) => {
      if (value !== IN_ZIP64) return value;
      next += 8;
      return Number(data.getBigUint64(next - 8, true));
    }) as [number, number, number];
  }
  return values;
}

function text(data: DataView, at: number, length: number): string {
  const raw = new Uint8Array(data.buffer, data.byteOffset + at, length);
  try {
    return new TextDecoder("utf-8", { fatal: true }).decode(raw);
  } catch {
    throw refuse(`The archive's member '${new TextDecoder().decode(raw)}' has a name that is not UTF-8.`, "Make the archive with UTF-8 names (7-Zip: -mcu=on), or rename the file.");
  }
}

// SHA-256 of files. On plain http and another host than this machine browsers have no `crypto.subtle`.
import { createCRC32, createSHA256 } from "hash-wasm";

const MOST_AT_ONCE = 64 << 20; // bytes; `crypto.subtle` wants the whole file in memory
const scope = self as unknown as DedicatedWorkerGlobalScope;

interface Question {
  id: number;
  file: Blob;
  crc32?: number;
}

async function sha256({ file, crc32 }: Question): Promise<string> {
  if (scope.crypto.subtle && file.size <= MOST_AT_ONCE && crc32 === undefined) return hex(new Uint8Array(await scope.crypto.subtle.digest("SHA-256", await file.arrayBuffer())));
  const hash = await createSHA256();
  const sum = crc32 === undefined ? null : await createCRC32();
  hash.init();
  sum?.init();
  const reader = file.stream().getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    hash.update(value);
    sum?.update(value);
  }
  if (sum && parseInt(sum.digest("hex"), 16) !== crc32) throw new Error("its checksum is another than the archive says: the archive is damaged");
  return hash.digest("hex");
}

function hex(digest: Uint8Array): string {
  return Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

scope.onmessage = async ({ data }: MessageEvent<Question>) => {
  try {
    scope.postMessage({ id: data.id, sha256: await sha256(data) });
  } catch (error) {
    scope.postMessage({ id: data.id, error: error instanceof Error ? error.message : String(error) });
  }
};

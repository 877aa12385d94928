// SHA-256 of files. On plain http and another host than this machine browsers have no `crypto.subtle`.
import { createSHA256 } from "hash-wasm";

const MOST_AT_ONCE = 64 << 20; // bytes; `crypto.subtle` wants the whole file in memory
const scope = self as unknown as DedicatedWorkerGlobalScope;

async function sha256(file: Blob): Promise<string> {
  if (scope.crypto.subtle && file.size <= MOST_AT_ONCE) return hex(new Uint8Array(await scope.crypto.subtle.digest("SHA-256", await file.arrayBuffer())));
  const hash = await createSHA256();
  hash.init();
  const reader = file.stream().getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return hash.digest("hex");
    hash.update(value);
  }
}

function hex(digest: Uint8Array): string {
  return Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

scope.onmessage = async ({ data }: MessageEvent<{ id: number; file: Blob }>) => {
  try {
    scope.postMessage({ id: data.id, sha256: await sha256(data.file) });
  } catch (error) {
    scope.postMessage({ id: data.id, error: error instanceof Error ? error.message : String(error) });
  }
};

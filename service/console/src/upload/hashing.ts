// Hashes files in a worker, one after the other.
export class Hasher {
  private readonly worker = new Worker(new URL("hash.js", import.meta.url));
  private readonly waiting = new Map<number, { done: (sha256: string) => void; failed: (error: Error) => void }>();
  private last = 0;

  constructor() {
    this.worker.onmessage = ({ data }: MessageEvent<{ id: number; sha256?: string; error?: string }>) => {
      const waiting = this.waiting.get(data.id);
      this.waiting.delete(data.id);
      if (data.sha256) waiting?.done(data.sha256);
      else waiting?.failed(new Error(data.error ?? "a file cannot be read"));
    };
  }

  sha256(file: Blob, crc32?: number): Promise<string> {
    const id = ++this.last;
    return new Promise((done, failed) => {
      this.waiting.set(id, { done, failed });
      this.worker.postMessage({ id, file, ...(crc32 === undefined ? {} : { crc32 }) });
    });
  }

  close(): void {
    this.worker.terminate();
  }
}

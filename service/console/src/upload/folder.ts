// What was dropped or chosen, as files by their path inside the drive: a folder, or an archive of one.
import { isArchive, openArchive } from "./archive";

export const MANIFEST = "drive.json";

export interface Entry {
  path: string;
  file: Blob;
  crc32?: number; // of the content, where an archive says it
}

export interface Identified extends Entry {
  sha256: string;
}

export interface Folder {
  what: "folder" | "archive";
  sizes: ReadonlyMap<string, number>; // bytes by path
  /** The manifest's text, where there is one. */
  manifest: () => Promise<string | null>;
  /** Contents of some files, in the order in which they are best read. */
  read: (paths: ReadonlySet<string>) => AsyncGenerator<Entry>;
}

/** macOS writes 'ü' as two characters: names are compared with every character in one piece. */
export function composed(path: string): string {
  return path.normalize("NFC");
}

export async function chosen(files: FileList): Promise<Folder> {
  const [only] = files;
  if (only && files.length === 1 && !only.webkitRelativePath && (await isArchive(only))) return openArchive(only);
  const found = new Map<string, File>();
  for (const file of files) found.set(composed(file.webkitRelativePath.split("/").slice(1).join("/") || file.name), file);
  return folderOf(found);
}

export async function dropped(items: DataTransferItemList): Promise<Folder> {
  const entries = [...items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  const [only] = entries;
  if (only && entries.length === 1 && only.isFile) {
    const file = await fileOf(only as FileSystemFileEntry);
    if (await isArchive(file)) return openArchive(file);
  }
  const found = new Map<string, File>();
  for (const entry of entries) await collect(entry, entries.length === 1 && entry.isDirectory ? "" : entry.name, found);
  return folderOf(found);
}

function folderOf(files: ReadonlyMap<string, File>): Folder {
  return {
    what: "folder",
    sizes: new Map([...files].map(([path, file]) => [path, file.size])),
    manifest: async () => (await files.get(MANIFEST)?.text()) ?? null,
    read: async function* (paths) {
      for (const path of paths) yield { path, file: files.get(path)! };
    },
  };
}

function fileOf(entry: FileSystemFileEntry): Promise<File> {
  return new Promise<File>((done, failed) => entry.file(done, failed));
}

async function collect(entry: FileSystemEntry, path: string, files: Map<string, File>): Promise<void> {
  if (entry.isFile) {
    files.set(composed(path), await fileOf(entry as FileSystemFileEntry));
    return;
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((done, failed) => reader.readEntries(done, failed)); // at most 100
    if (some.length === 0) return;
    for (const child of some) await collect(child, path ? `${path}/${child.name}` : child.name, files);
  }
}

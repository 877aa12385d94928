// A folder that was dropped or chosen: its files by their path inside it.
export type Folder = Map<string, File>;

export const MANIFEST = "drive.json";

export function chosen(files: FileList): Folder {
  const folder: Folder = new Map();
  for (const file of files) folder.set(file.webkitRelativePath.split("/").slice(1).join("/") || file.name, file);
  return folder;
}

export async function dropped(items: DataTransferItemList): Promise<Folder> {
  const entries = [...items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  const folder: Folder = new Map();
  for (const entry of entries) await collect(entry, entries.length === 1 && entry.isDirectory ? "" : entry.name, folder);
  return folder;
}

async function collect(entry: FileSystemEntry, path: string, folder: Folder): Promise<void> {
  if (entry.isFile) {
    folder.set(path, await new Promise<File>((done, failed) => (entry as FileSystemFileEntry).file(done, failed)));
    return;
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((done, failed) => reader.readEntries(done, failed)); // at most 100
    if (some.length === 0) return;
    for (const child of some) await collect(child, path ? `${path}/${child.name}` : child.name, folder);
  }
}

// A folder or an archive by drag and drop, sent so that it can go on later, here or in another browser.
import { useEffect, useRef, useState } from "preact/hooks";
import type { Drive, Problem } from "../client";
import { Bar, Heading, problemOf, ProblemBox } from "../components";
import { bytes, count, plural } from "../format";
import { html, type Shown } from "../html";
import { link } from "../router";
import { chosen, dropped, MANIFEST, type Folder } from "./folder";
import { upload, type Progress } from "./upload";

const STEPS: Record<Progress["step"], string> = {
  creates: "The names and the manifest are being checked …", hashes: "Finding out what the service has already …", sends: "Sending …",
  commits: "The drive is being checked …", done: "Done.",
};

export function UploadPage(): Shown {
  const [isOver, setOver] = useState(false);
  const [progress, setProgress] = useState<Progress | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [drive, setDrive] = useState<Drive | null>(null);
  const [extra, setExtra] = useState(0);
  const abort = useRef(new AbortController());
  useEffect(() => () => abort.current.abort(), []);
  useEffect(keepPage, []);
  const isBusy = progress !== null && progress.step !== "done" && problem === null;
  const begin = async (opening: Promise<Folder>): Promise<void> => {
    const own = (abort.current = new AbortController());
    setProblem(null);
    setDrive(null);
    setProgress({ step: "creates", doneBytes: 0, totalBytes: 0, sentFiles: 0, files: 0 });
    setExtra(0);
    try {
      const folder = await opening;
      const sent = await upload(folder, (now) => {
        if (own.signal.aborted) return;
        setProgress(now);
        setExtra(now.files ? folder.sizes.size - now.files - 1 : 0);
      }, own.signal);
      setDrive(sent);
    } catch (error) {
      if (!own.signal.aborted) setProblem(problemOf(error));
      own.abort(); // several files are sent at one time: none goes on behind the next upload
    }
  };
  const drop = (event: DragEvent): void => {
    event.preventDefault();
    setOver(false);
    if (event.dataTransfer && !isBusy) void begin(dropped(event.dataTransfer.items));
  };
  const pick = (event: Event): void => {
    const input = event.target as HTMLInputElement;
    if (input.files && input.files.length > 0) void begin(chosen(input.files).finally(() => (input.value = ""))); // the same again is news
  };
  return html`<${Heading} title="Upload a drive" />
    <div class=${isOver ? "drop over" : "drop"} onDragOver=${(event: DragEvent) => { event.preventDefault(); setOver(true); }} onDragLeave=${() => setOver(false)} onDrop=${drop}>
      <p>Drop the folder of a drive here, the one with <code>${MANIFEST}</code>, or a zip, tar or tar.gz of it.</p>
      <p class="inline choices"><label class="button primary">Choose a folder<input class="hidden" type="file" name="folder" webkitdirectory multiple disabled=${isBusy} onChange=${pick} /></label>
        <label class="button">Choose an archive<input class="hidden" type="file" name="archive" accept=".zip,.tar,.tgz,.gz" disabled=${isBusy} onChange=${pick} /></label></p>
      <p class="muted small">Files that the service has already are not sent again. Close this page at any time: the same folder or archive goes on where it was, also in another browser. An archive that holds other files than the drive's is refused before anything is sent.</p>
    </div>
    ${problem && html`<${ProblemBox} problem=${problem} />`}
    ${progress && !problem && html`<${Steps} progress=${progress} extra=${extra} />`}
    ${drive && html`<p><a class="button primary" href=${link("drives", drive.id)}>Open ${drive.name}</a></p>`}`;
}

/** Files that are dropped beside the place for them would replace the page, and end its upload. */
function keepPage(): () => void {
  const over = (event: DragEvent): void => {
    if (event.defaultPrevented) return;
    event.preventDefault();
    if (event.dataTransfer) event.dataTransfer.dropEffect = "none";
  };
  const drop = (event: DragEvent): void => event.preventDefault();
  window.addEventListener("dragover", over);
  window.addEventListener("drop", drop);
  return () => {
    window.removeEventListener("dragover", over);
    window.removeEventListener("drop", drop);
  };
}

function Steps({ progress, extra }: { progress: Progress; extra: number }): Shown {
  const percent = progress.totalBytes > 0 ? (100 * progress.doneBytes) / progress.totalBytes : 0;
  return html`<section class="box" aria-live="polite" data-step=${progress.step}>
    <h2>${STEPS[progress.step]}</h2>
    <${Bar} percent=${progress.step === "done" ? 100 : percent} label="of the bytes" />
    <p class="number">${bytes(progress.doneBytes)} of ${bytes(progress.totalBytes)}${progress.step !== "hashes" && `, ${count(progress.sentFiles)} of ${plural(progress.files, "file")}`}</p>
    ${extra > 0 && html`<p class="muted small">${plural(extra, "file")} of the folder ${extra === 1 ? "is" : "are"} not named by the manifest and stay here.</p>`}
  </section>`;
}

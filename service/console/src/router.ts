// The page's address is the part behind #: `#/jobs/job_1` is ["jobs", "job_1"].
import { signal } from "@preact/signals";

function parts(): string[] {
  return location.hash.replace(/^#\/?/, "").split("/").filter(Boolean).map(decoded);
}

/** A part that was cut within a character is as it stands: it names nothing. */
function decoded(part: string): string {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

export const route = signal<readonly string[]>(parts());

window.addEventListener("hashchange", () => {
  route.value = parts();
});

export function link(...to: (string | number)[]): string {
  return `#/${to.map((part) => encodeURIComponent(part)).join("/")}`;
}

export function go(...to: (string | number)[]): void {
  location.hash = link(...to);
}

// A part of the page whose code is loaded when it is shown.
import type { ComponentType } from "preact";
import { useEffect, useState } from "preact/hooks";
import type { Problem } from "./client";
import { problemOf, ProblemBox } from "./components";
import { html, type Shown } from "./html";

interface Props<Module, Name extends keyof Module, Of> {
  load: () => Promise<Module>;
  name: Name;
  of: Of;
}

export function Lazy<Module, Name extends keyof Module, Of>({ load, name, of }: Props<Module, Name, Of>): Shown {
  const [part, setPart] = useState<{ show: ComponentType<Of> } | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    load().then(
      (module) => setPart({ show: module[name] as ComponentType<Of> }),
      (error: unknown) => setProblem(problemOf(error)),
    );
  }, []);
  if (problem) return html`<${ProblemBox} problem=${problem} />`;
  return part ? html`<${part.show} ...${of} />` : html`<p class="muted" aria-busy="true">Loading …</p>`;
}

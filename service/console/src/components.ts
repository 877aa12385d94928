// Parts that all pages are made of.
import { useEffect, useRef, useState } from "preact/hooks";
import { mayPass, ProblemError, type Finding, type Job, type Problem } from "./client";
import { duration, moment } from "./format";
import { html, type Children, type Shown } from "./html";
import { epoch } from "./live";
import { link } from "./router";

export interface Loaded<Value> {
  value: Value | null;
  problem: Problem | null;
  again: () => void;
}

const AGAIN_MS = 3000;

/** What `read` gives, read anew when `key` changes and, if `isLive`, when a job came or ended; also while it may come yet. */
export function useLoad<Value>(read: (abort: AbortSignal) => Promise<Value>, key: string, isLive = true): Loaded<Value> {
  const [state, setState] = useState<{ key: string; value: Value | null; problem: Problem | null }>({
    key,
    value: null,
    problem: null,
  });
  const [turn, setTurn] = useState(0);
  const at = isLive ? epoch.value : 0;
  useEffect(() => {
    const abort = new AbortController();
    let timer: ReturnType<typeof setTimeout> | undefined;
    read(abort.signal).then(
      (value) => !abort.signal.aborted && setState({ key, value, problem: null }),
      (error: unknown) => {
        if (abort.signal.aborted) return;
        setState((before) => ({ key, value: before.key === key ? before.value : null, problem: problemOf(error) }));
        if (error instanceof ProblemError && mayPass(error)) timer = setTimeout(() => setTurn((n) => n + 1), AGAIN_MS);
      },
    );
    return () => {
      abort.abort();
      clearTimeout(timer);
    };
  }, [key, at, turn]);
  const isCurrent = state.key === key;
  return { value: isCurrent ? state.value : null, problem: isCurrent ? state.problem : null, again: () => setTurn((n) => n + 1) };
}

export function problemOf(error: unknown): Problem {
  if (error instanceof ProblemError) return error.problem;
  return {
    title: "The page failed",
    detail: error instanceof Error ? error.message : String(error),
    remedy: "Load the page again.",
  };
}

export function ProblemBox({ problem }: { problem: Problem }): Shown {
  return html`<div class="box bad" role="alert">
    <strong>${problem.title}</strong>
    <p>${problem.detail}</p>
    <p class="remedy">${problem.remedy}</p>
    ${problem.errors && problem.errors.length > 0 &&
    html`<ul>
      ${problem.errors.slice(0, 20).map((item) => html`<li><code>${item.field}</code> ${item.detail}</li>`)}
    </ul>`}
    ${problem.findings && problem.findings.length > 0 && html`<${Findings} findings=${problem.findings} />`}
    ${problem.log_tail && html`<details open><summary>End of the log</summary><pre tabindex="0">${problem.log_tail}</pre></details>`}
  </div>`;
}

export function Findings({ findings }: { findings: readonly Finding[] }): Shown {
  return html`<ul class="findings">
    ${findings.map(
      (finding) => html`<li class=${finding.severity === "error" ? "bad" : "warn"}>
        <strong>${finding.severity === "error" ? "Error" : "Warning"}:</strong> ${finding.what}
        <div class="remedy">${finding.remedy}</div>
      </li>`,
    )}
  </ul>`;
}

/** Content once it is there; before that, the reason why it is not. */
export function Content<Value>({ of, children }: { of: Loaded<Value>; children: (value: Value) => Children }): Shown {
  return html`${of.problem && html`<${ProblemBox} problem=${of.problem} />`}
  ${of.value !== null ? children(of.value) : !of.problem && html`<p class="muted" aria-busy="true">Loading …</p>`}`;
}

export function Heading({ title, kind, children }: { title: string; kind?: string; children?: Children }): Shown {
  const heading = useRef<HTMLHeadingElement>(null);
  useEffect(() => {
    document.title = `${title} · MRASfM`;
  }, [title]);
  return html`<div class="heading">
    <div>${kind && html`<div class="kind">${kind}</div>`}<h1 ref=${heading} tabindex="-1">${title}</h1></div>
    <div class="actions">${children}</div>
  </div>`;
}

export function Empty({ children }: { children: Children }): Shown {
  return html`<div class="empty">${children}</div>`;
}

const STATES: Record<string, string> = {
  SUCCEEDED: "good", OK: "good", PASSED: "good", COMMITTED: "good", FAILED: "bad", REJECTED: "bad", RUNNING: "busy",
  PENDING: "busy", STALLED: "warn", DEGRADED: "warn", OPEN: "warn",
};

export function Badge({ state }: { state: string }): Shown {
  return html`<span class=${`badge ${STATES[state.toUpperCase()] ?? "plain"}`}>${state.toLowerCase()}</span>`;
}

export function Bar({ percent, label }: { percent: number; label: string }): Shown {
  return html`<div class="progress">
    <progress max="100" value=${percent} aria-label=${label}></progress><span class="number">${percent.toFixed(1)} %</span>
  </div>`;
}

export const KINDS: Record<Job["kind"], string> = {
  PREFLIGHT: "check of the images", RECONSTRUCTION: "reconstruction", AGGREGATION: "aggregation", SUBMAP: "sub-map",
  EXPORT: "export",
};

export function eta(job: Job): string {
  const { eta_low_s: low, eta_high_s: high } = job.progress;
  if (low === null || low === undefined || high === null || high === undefined) return "not known yet";
  if (high < 10) return "some seconds";
  return duration(low) === duration(high) ? duration(low) : `${duration(low)} to ${duration(high)}`;
}

export function stageOf(job: Job): string {
  const { stage, done, total, unit } = job.progress;
  if (!stage) return "–";
  const of = total === null || total === undefined ? "" : ` · ${done ?? 0} of ${total} ${unit ?? ""}`;
  return `${stage.replaceAll("-", " ")}${of}`;
}

export function Tile({ label, children }: { label: string; children: Children }): Shown {
  return html`<div class="tile"><dt>${label}</dt><dd>${children}</dd></div>`;
}

export function Time({ at }: { at: string | null | undefined }): Shown {
  return at ? html`<time datetime=${at} title=${at}>${moment(at)}</time>` : html`<span>–</span>`;
}

/** A button that asks once more. */
export function Confirm({ label, ask, run, danger = false }: { label: string; ask: string; run: () => Promise<void>; danger?: boolean }): Shown {
  const [step, setStep] = useState<"idle" | "asks" | "runs">("idle");
  const [problem, setProblem] = useState<Problem | null>(null);
  const focused = useRef<HTMLButtonElement>(null);
  const wasPressed = useRef(false);
  useEffect(() => {
    if (wasPressed.current) focused.current?.focus(); // the button that had the focus is gone
  }, [step]);
  const doIt = async (): Promise<void> => {
    setStep("runs");
    setProblem(null);
    try {
      await run();
    } catch (error) {
      setProblem(problemOf(error));
    }
    setStep("idle");
  };
  const begin = (): void => {
    wasPressed.current = true;
    setStep("asks");
  };
  return html`<span class="confirm">
    ${step === "idle" && html`<button type="button" class=${danger ? "danger" : ""} ref=${focused} onClick=${begin}>${label}</button>`}
    ${step === "asks" &&
    html`<span role="group" aria-label=${ask}><span>${ask}</span>
      <button type="button" class=${danger ? "danger" : "primary"} ref=${danger ? undefined : focused} onClick=${() => void doIt()}>Yes</button>
      <button type="button" ref=${danger ? focused : undefined} onClick=${() => setStep("idle")}>No</button></span>`}
    ${step === "runs" && html`<button type="button" disabled>${label} …</button>`}
    ${problem && html`<${ProblemBox} problem=${problem} />`}
  </span>`;
}

export interface Tab {
  name: string;
  label: string;
}

export function Tabs({ base, tabs, current }: { base: readonly string[]; tabs: readonly Tab[]; current: string }): Shown {
  return html`<nav class="tabs" aria-label="Parts of this page">
    ${tabs.map(
      (tab) => html`<a href=${link(...base, ...(tab.name ? [tab.name] : []))} aria-current=${tab.name === current ? "page" : undefined}>${tab.label}</a>`,
    )}
  </nav>`;
}

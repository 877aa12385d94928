// The console: the shell of all pages, and the page that the address names.
import { signal } from "@preact/signals";
import { render } from "preact";
import { useEffect, useState } from "preact/hooks";
import { get, identityOf, mayPass, ProblemError, remembersSession, session, setSession, watchSession, type Problem, type Session } from "./client";
import { Heading, problemOf, ProblemBox } from "./components";
import { html, type Children, type Shown } from "./html";
import { Lazy } from "./lazy";
import { connection, follow, unfollow } from "./live";
import { DrivePage, Drives } from "./pages/drives";
import { JobPage, Jobs } from "./pages/jobs";
import { Login } from "./pages/login";
import { MapPage, Maps } from "./pages/map";
import { Keys, logOut, StatusPage } from "./pages/operation";
import { ScenePage, Scenes } from "./pages/scene";
import { link, route } from "./router";

const PAGES: [string, string][] = [
  ["drives", "Drives"],
  ["jobs", "Jobs"],
  ["scenes", "Scenes"],
  ["maps", "Maps"],
  ["status", "Status"],
  ["keys", "Key"],
];
const CONNECTIONS = { connecting: "connecting …", live: "live", polling: "polling", offline: "offline, tries again" };

const AGAIN_MS = 3000;
const ID = /^\w[\w.-]*$/;
const NO_PAGE: Problem = { title: "There is no such page", detail: "The address names no page of the console.", remedy: "Check the end of the address, or choose a page above." };
/** The reason why it is not known yet who is logged in. */
const away = signal<Problem | null>(null);

function page(parts: readonly string[]): Children {
  const [name = "drives", id, tab = ""] = parts;
  if ((name !== "upload" && !PAGES.some(([known]) => known === name)) || (id !== undefined && !ID.test(id)))
    return html`<${Heading} title="No such page" /><${ProblemBox} problem=${NO_PAGE} />`;
  if (name === "upload") return html`<${Lazy} key="upload" load=${() => import("./upload/page")} name="UploadPage" of=${{}} />`;
  if (name === "jobs") return id ? html`<${JobPage} key=${id} id=${id} />` : html`<${Jobs} />`;
  if (name === "scenes") return id ? html`<${ScenePage} key=${`${id} ${tab}`} id=${id} tab=${tab} />` : html`<${Scenes} />`;
  if (name === "maps") return id ? html`<${MapPage} key=${`${id} ${tab}`} id=${id} tab=${tab} />` : html`<${Maps} />`;
  if (name === "status") return html`<${StatusPage} />`;
  if (name === "keys") return html`<${Keys} />`;
  return id ? html`<${DrivePage} key=${id} id=${id} />` : html`<${Drives} />`;
}

function Shell(): Shown {
  const parts = route.value;
  const [problem, setProblem] = useState<Problem | null>(null);
  const here = parts[0] === "upload" ? "drives" : (parts[0] ?? "drives");
  useEffect(() => {
    document.querySelector<HTMLElement>("main h1")?.focus({ preventScroll: true });
    window.scrollTo(0, 0);
  }, [parts.slice(0, 2).join("/")]);
  const end = (): void => {
    setProblem(null);
    logOut().catch((error: unknown) => setProblem({ ...problemOf(error), title: "The session goes on", remedy: "Log out again once the service answers." }));
  };
  return html`<a class="skip" href="#main" onClick=${skip}>Skip to the content</a>
    <header>
      <a class="brand" href=${link("drives")}>MRASfM</a>
      <nav aria-label="Pages">${PAGES.filter(([name]) => !isOpen() || name === "scenes" || name === "maps").map(([name, label]) => html`<a href=${link(name)} aria-current=${here === name ? "page" : undefined}>${label}</a>`)}</nav>
      <div class="session">${!isOpen() && html`<span class=${`connection ${connection.value}`} role="status" data-connection=${connection.value}>${CONNECTIONS[connection.value]}</span>`}
        <span class="muted project">${session.value?.project}</span>
        ${!isOpen() && html`<button type="button" onClick=${end}>Log out</button>`}</div>
    </header>
    <main id="main">${problem && html`<${ProblemBox} problem=${problem} />`}${page(parts)}</main>`;
}

function skip(event: Event): void {
  event.preventDefault(); // the address is the page's
  document.querySelector<HTMLElement>("main h1")?.focus();
}

function App(): Shown {
  const who = session.value;
  const identity = identityOf(who);
  useEffect(() => {
    if (!identity) return;
    follow();
    return unfollow;
  }, [identity]);
  if (who === undefined) return html`<main class="login">${away.value ? html`<${ProblemBox} problem=${away.value} />` : html`<p class="muted" aria-busy="true">Loading …</p>`}</main>`;
  return who === null ? html`<${Login} />` : html`<${Shell} key=${identity} />`;
}

/** `mrasfm view` asks for no key. */
function isOpen(): boolean {
  return document.querySelector("meta[name=mrasfm-session]")?.getAttribute("content") === "open";
}

async function begin(): Promise<void> {
  try {
    setSession(isOpen() || remembersSession() ? await get<Session>("v1/session") : null);
    away.value = null;
  } catch (error) {
    if (!(error instanceof ProblemError && mayPass(error))) return setSession(null);
    away.value = problemOf(error); // the cookie is good still
    setTimeout(() => void begin(), AGAIN_MS);
  }
}

render(html`<${App} />`, document.getElementById("app")!);
watchSession(() => void begin());
void begin();

// The console: the shell of all pages, and the page that the address names.
import { render } from "preact";
import { useEffect } from "preact/hooks";
import { get, remembersSession, session, setSession, type Session } from "./client";
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

function page(parts: readonly string[]): Children {
  const [name = "drives", id, tab = ""] = parts;
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
  const here = parts[0] === "upload" ? "drives" : (parts[0] ?? "drives");
  useEffect(() => {
    document.querySelector<HTMLElement>("main h1")?.focus({ preventScroll: true });
    window.scrollTo(0, 0);
  }, [parts.slice(0, 2).join("/")]);
  return html`<a class="skip" href="#main" onClick=${skip}>Skip to the content</a>
    <header>
      <a class="brand" href=${link("drives")}>MRASfM</a>
      <nav aria-label="Pages">${PAGES.filter(([name]) => !isOpen() || name === "scenes" || name === "maps").map(([name, label]) => html`<a href=${link(name)} aria-current=${here === name ? "page" : undefined}>${label}</a>`)}</nav>
      <div class="session">${!isOpen() && html`<span class=${`connection ${connection.value}`} role="status" data-connection=${connection.value}>${CONNECTIONS[connection.value]}</span>`}
        <span class="muted project">${session.value?.project}</span>
        ${!isOpen() && html`<button type="button" onClick=${() => void logOut()}>Log out</button>`}</div>
    </header>
    <main id="main">${page(parts)}</main>`;
}

function skip(event: Event): void {
  event.preventDefault(); // the address is the page's
  document.querySelector<HTMLElement>("main h1")?.focus();
}

function App(): Shown {
  const who = session.value;
  const isKnown = Boolean(who);
  useEffect(() => {
    if (isKnown) follow();
    else unfollow();
  }, [isKnown]);
  if (who === undefined) return html`<main class="login"><p class="muted" aria-busy="true">Loading …</p></main>`;
  return who === null ? html`<${Login} />` : html`<${Shell} />`;
}

/** `mrasfm view` asks for no key. */
function isOpen(): boolean {
  return document.querySelector("meta[name=mrasfm-session]")?.getAttribute("content") === "open";
}

async function begin(): Promise<void> {
  try {
    setSession(isOpen() || remembersSession() ? await get<Session>("v1/session") : null);
  } catch {
    setSession(null);
  }
}

render(html`<${App} />`, document.getElementById("app")!);
void begin();

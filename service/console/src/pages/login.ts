import { useState } from "preact/hooks";
import { send, setSession, type Problem, type Session } from "../client";
import { problemOf, ProblemBox } from "../components";
import { html, type Shown } from "../html";

export function Login(): Shown {
  const [problem, setProblem] = useState<Problem | null>(null);
  const [isBusy, setBusy] = useState(false);
  const submit = async (event: SubmitEvent): Promise<void> => {
    event.preventDefault();
    const field = (event.currentTarget as HTMLFormElement).elements.namedItem("key") as HTMLInputElement;
    const key = field.value.trim();
    setBusy(true);
    setProblem(null);
    try {
      const answer = await send("POST", "v1/session", { headers: { Authorization: `Bearer ${key}` } });
      field.value = "";
      setSession((await answer.json()) as Session);
    } catch (error) {
      setProblem(problemOf(error));
    }
    setBusy(false);
  };
  return html`<main class="login" id="main">
    <h1>MRASfM</h1>
    <p>Maps from the cameras of vehicles.</p>
    <form method="post" onSubmit=${(event: SubmitEvent) => void submit(event)}>
      <label for="key">API key</label>
      <input id="key" name="key" type="password" required autocomplete="off" spellcheck=${false} autofocus placeholder="mrasfm_…" aria-describedby="key-help" />
      <p id="key-help" class="muted">The key is exchanged for a cookie that lasts 12 hours; it is not kept in the browser.
      An operator makes keys with <code>mrasfm keys create</code>.</p>
      <button class="primary" disabled=${isBusy}>${isBusy ? "Logging in …" : "Log in"}</button>
    </form>
    ${problem && html`<${ProblemBox} problem=${problem} />`}
  </main>`;
}

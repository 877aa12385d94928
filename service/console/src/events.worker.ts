// Shared by all pages of a browser: the one stream, open while a page is seen.
import type { FromPage, FromWorker } from "./messages";
import { ProjectStream } from "./stream";

const scope = self as unknown as SharedWorkerGlobalScope;
const seen = new Map<MessagePort, boolean>();
let of = ""; // the session that the stream was opened with
const api = new URL("../../v1/", self.location.href).href;
const stream = new ProjectStream(api, (message: FromWorker) => {
  for (const port of seen.keys()) port.postMessage(message);
});

function update(): void {
  const isSeen = [...seen.values()].includes(true);
  if (isSeen && !stream.isOpen) stream.open();
  if (!isSeen && stream.isOpen) stream.close();
}

scope.onconnect = (event) => {
  const port = event.ports[0];
  if (!port) return;
  port.onmessage = ({ data }: MessageEvent<FromPage>) => {
    if (data.type === "leaves") seen.delete(port);
    else seen.set(port, data.type === "visible");
    if (data.type === "visible" && data.session !== of) {
      stream.close(); // it shows what the cookie opened that was there when it began
      of = data.session;
    }
    // A page that comes late missed that the stream is open.
    if (data.type === "visible" && stream.isOpen) port.postMessage({ type: "ready" } satisfies FromWorker);
    update();
  };
  port.start();
};

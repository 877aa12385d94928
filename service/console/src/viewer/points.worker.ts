// Reads points.copc.laz in parts and decompresses them, so that the page stays free.
import { Copc, type Hierarchy } from "copc";
import { createLazPerf, type LazPerf } from "laz-perf";

const BLOCK = 65536; // bytes; copc asks for tiny ranges, and neighbours share a request
const MOST_BLOCKS = 256;

export interface Start {
  type: "start";
  url: string;
  wasm: string;
  offset: [number, number, number];
}
export interface NodeInfo {
  key: string;
  points: number;
  bytes: number;
}
export type ToWorker = Start | { type: "load"; key: string };
export type FromPoints =
  | { type: "header"; nodes: NodeInfo[]; cube: number[]; spacing: number; points: number; size: number }
  | { type: "node"; key: string; positions: Float32Array; colors: Uint8Array; bytes: number }
  | { type: "failed"; detail: string };

/** The renderer computes with linear colours; files hold those of a screen. */
const LINEAR = Uint8Array.from({ length: 256 }, (_, value) => Math.round(255 * (value / 255) ** 2.2));

const scope = self as unknown as DedicatedWorkerGlobalScope;
const blocks = new Map<number, Promise<Uint8Array>>();
let url = "";
let size = 0;
let read = 0;
let copc: Copc;
let lazPerf: LazPerf;
let nodes: Record<string, Hierarchy.Node | undefined> = {};
let offset: [number, number, number] = [0, 0, 0];

async function range(begin: number, end: number): Promise<Uint8Array> {
  const answer = await fetch(url, { headers: { Range: `bytes=${begin}-${end - 1}` } });
  if (answer.status !== 206 && answer.status !== 200) throw new Error(`the points cannot be read: HTTP ${answer.status}`);
  size = Number(answer.headers.get("content-range")?.split("/")[1] ?? size);
  const data = new Uint8Array(await answer.arrayBuffer());
  read += data.length;
  return data;
}

function block(index: number): Promise<Uint8Array> {
  let found = blocks.get(index);
  if (!found) {
    if (blocks.size >= MOST_BLOCKS) blocks.delete(blocks.keys().next().value!);
    found = range(index * BLOCK, (index + 1) * BLOCK);
    found.catch(() => blocks.delete(index));
    blocks.set(index, found);
  }
  return found;
}

async function getter(begin: number, end: number): Promise<Uint8Array> {
  if (end - begin > BLOCK) return range(begin, end);
  const first = Math.floor(begin / BLOCK);
  const parts = await Promise.all(Array.from({ length: Math.floor((end - 1) / BLOCK) - first + 1 }, (_, at) => block(first + at)));
  const whole = new Uint8Array(end - begin);
  parts.forEach((part, at) => {
    const start = (first + at) * BLOCK;
    whole.set(part.subarray(Math.max(begin - start, 0), Math.min(end - start, part.length)), Math.max(start - begin, 0));
  });
  return whole;
}

async function start(message: Start): Promise<void> {
  url = message.url;
  offset = message.offset;
  [lazPerf, copc] = await Promise.all([createLazPerf({ locateFile: () => message.wasm }), Copc.create(getter)]);
  await readPage(copc.info.rootHierarchyPage);
  const infos = Object.entries(nodes).flatMap(([key, node]) => (node && node.pointCount > 0 ? [{ key, points: node.pointCount, bytes: node.pointDataLength }] : []));
  say({ type: "header", nodes: infos, cube: copc.info.cube, spacing: copc.info.spacing, points: copc.header.pointCount, size });
}

async function readPage(page: Hierarchy.Page): Promise<void> {
  const subtree = await Copc.loadHierarchyPage(getter, page);
  nodes = { ...nodes, ...subtree.nodes };
  for (const further of Object.values(subtree.pages)) if (further) await readPage(further);
}

async function load(key: string): Promise<void> {
  const view = await Copc.loadPointDataView(getter, copc, nodes[key]!, { lazPerf });
  const count = view.pointCount;
  const positions = new Float32Array(3 * count);
  const colors = new Uint8Array(3 * count);
  const place = (["X", "Y", "Z"] as const).map((name) => view.getter(name));
  const color = (["Red", "Green", "Blue"] as const).map((name) => view.getter(name));
  for (let point = 0; point < count; point += 1) {
    for (let axis = 0; axis < 3; axis += 1) {
      positions[3 * point + axis] = place[axis]!(point) - offset[axis]!;
      colors[3 * point + axis] = LINEAR[color[axis]!(point) >> 8]!;
    }
  }
  const message: FromPoints = { type: "node", key, positions, colors, bytes: read };
  scope.postMessage(message, [positions.buffer, colors.buffer]);
}

function say(message: FromPoints): void {
  scope.postMessage(message);
}

scope.onmessage = ({ data }: MessageEvent<ToWorker>) => {
  const work = data.type === "start" ? start(data) : load(data.key);
  work.catch((error: unknown) => say({ type: "failed", detail: error instanceof Error ? error.message : String(error) }));
};

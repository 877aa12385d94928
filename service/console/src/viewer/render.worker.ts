// Draws the scene in 3D, in a worker: where a graphics card is slow or missing a frame takes long, and the page must not wait.
import {
  BufferAttribute, BufferGeometry, Color, Line, LineBasicMaterial, LineSegments, PerspectiveCamera, Points, PointsMaterial,
  Scene, WebGLRenderer,
} from "three";

export interface View {
  position: [number, number, number];
  quaternion: [number, number, number, number];
  fovDeg: number;
  near: number;
  far: number;
  width: number; // CSS pixels
  height: number;
  pixelRatio: number;
}
export type ToRenderer =
  | { type: "start"; canvas: OffscreenCanvas }
  | { type: "line"; positions: Float32Array; color: string; order: number }
  | { type: "frusta"; positions: Float32Array; color: string }
  | { type: "mark"; positions: Float32Array }
  | { type: "points"; positions: Float32Array; colors: Uint8Array }
  | { type: "view"; view: View }
  | { type: "options"; pointSizePx: number; hasFrusta: boolean };
/** `drawn`: messages whose effect is on the screen. */
export type FromRenderer = { type: "drawn"; messages: number } | { type: "failed"; detail: string };

const SELECTED = "#ffffff";
const scope = self as unknown as DedicatedWorkerGlobalScope;
const scene = new Scene();
const camera = new PerspectiveCamera();
const material = new PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true });
const frusta: LineSegments[] = [];
let renderer: WebGLRenderer | null = null;
let marked: LineSegments | null = null;
let heard = 0;
let frame = 0;
let shown = "";

function geometryOf(positions: Float32Array): BufferGeometry {
  return new BufferGeometry().setAttribute("position", new BufferAttribute(positions, 3));
}

function segments(positions: Float32Array, color: string, opacity: number): LineSegments {
  const lines = new LineSegments(geometryOf(positions), new LineBasicMaterial({ color, transparent: true, opacity }));
  scene.add(lines);
  return lines;
}

function take(message: ToRenderer): void {
  if (message.type === "start") {
    renderer = new WebGLRenderer({ canvas: message.canvas, antialias: true });
    scene.background = new Color("#14181d");
  }
  if (message.type === "line") {
    const line = new Line(geometryOf(message.positions), new LineBasicMaterial({ color: message.color, depthTest: false, transparent: true }));
    line.renderOrder = message.order; // over the points: a path is never hidden by what the vehicle saw
    scene.add(line);
  }
  if (message.type === "frusta") frusta.push(segments(message.positions, message.color, 0.55));
  if (message.type === "mark") {
    if (marked) scene.remove(marked);
    marked = segments(message.positions, SELECTED, 1);
  }
  if (message.type === "points") {
    const geometry = geometryOf(message.positions);
    geometry.setAttribute("color", new BufferAttribute(message.colors, 3, true));
    scene.add(new Points(geometry, material));
  }
  if (message.type === "options") {
    material.size = message.pointSizePx;
    for (const lines of frusta) lines.visible = message.hasFrusta;
  }
  if (message.type === "view") look(message.view);
}

function look({ position, quaternion, fovDeg, near, far, width, height, pixelRatio }: View): void {
  camera.position.set(...position);
  camera.quaternion.set(...quaternion);
  Object.assign(camera, { fov: fovDeg, near, far, aspect: width / height });
  camera.updateProjectionMatrix();
  const size = `${width} ${height} ${pixelRatio}`;
  if (size === shown) return;
  shown = size;
  renderer?.setPixelRatio(pixelRatio);
  renderer?.setSize(width, height, false);
}

function draw(): void {
  frame = 0;
  const messages = heard;
  renderer?.render(scene, camera);
  scope.postMessage({ type: "drawn", messages } satisfies FromRenderer);
}

scope.onmessage = ({ data }: MessageEvent<ToRenderer>) => {
  try {
    take(data);
  } catch (error) {
    scope.postMessage({ type: "failed", detail: error instanceof Error ? error.message : String(error) } satisfies FromRenderer);
    return;
  }
  heard += 1;
  if (shown && !frame) frame = scope.requestAnimationFrame(draw);
};

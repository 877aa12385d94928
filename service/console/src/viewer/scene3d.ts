// The scene in 3D: points by their size on the screen, trajectories, frusta and seams.
import { MathUtils, PerspectiveCamera, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Point, ViewDocument, ViewImage, ViewScene } from "./document";
import type { FromPoints, NodeInfo, ToWorker } from "./points.worker";
import type { FromRenderer, ToRenderer } from "./render.worker";

const MOST_POINTS = 6_000_000;
const AT_ONE_TIME = 2; // nodes that are being loaded
const SPACING_PX = 2.2; // a node is loaded while its points are farther apart than this on the screen
const PICKED_PX = 6;
const EDGES: [number, number][] = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];
const DIRECTION = new Vector3(-0.3, -0.68, 0.67); // from which all of the scene is looked at
const AROUND_M = 4; // the frusta around a trajectory

export interface Figures {
  shown: number;
  total: number;
  nodes: number;
  bytes: number;
  size: number;
  firstMs: number | null;
  isIdle: boolean;
}
export interface Picked {
  scene: ViewScene;
  image: ViewImage;
}
interface Node extends NodeInfo {
  centre: Vector3;
  radius: number;
  spacing: number;
  state: "known" | "asked" | "shown";
}

export class Scene3D {
  readonly camera: PerspectiveCamera;
  readonly figures: Figures = { shown: 0, total: 0, nodes: 0, bytes: 0, size: 0, firstMs: null, isIdle: false };
  private readonly controls: OrbitControls;
  private readonly points: Worker;
  private readonly renderer: Worker;
  private readonly began = performance.now();
  private readonly resize: ResizeObserver;
  private readonly options = { pointSizePx: 2, hasFrusta: true };
  private nodes: Node[] = [];
  private drawing: { message: number; node: Node }[] = []; // sent to be drawn
  private asked = 0;
  private told = 0;
  private drawn = 0;
  private frame = 0;
  private isFitted = false; // to the canvas, whose size is known late

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly view: ViewDocument,
    urls: { points: string; worker: string; renderer: string; wasm: string },
    private readonly say: { figures: (figures: Figures) => void; failed: (detail: string) => void; without3d: (detail: string) => void; picked: (picked: Picked) => void },
  ) {
    this.renderer = new Worker(urls.renderer);
    this.renderer.onmessage = ({ data }: MessageEvent<FromRenderer>) => this.hearRenderer(data);
    this.renderer.onerror = (event) => this.say.without3d(event.message);
    const offscreen = canvas.transferControlToOffscreen();
    this.show({ type: "start", canvas: offscreen }, [offscreen]);
    this.camera = new PerspectiveCamera(50, 1, 0.2, 20000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.controls.listenToKeyEvents(canvas);
    for (const scene of view.scenes) {
      this.addLine(scene.trajectory_m, scene.color, 3);
      this.show({ type: "frusta", positions: flat(scene.images.flatMap(frustumPoints)), color: scene.color });
    }
    for (const seam of view.seams) if (seam.line_m && seam.accepted) this.addLine(seam.line_m, "#ffffff", 1);
    this.home();
    this.points = new Worker(urls.worker);
    this.points.onmessage = ({ data }: MessageEvent<FromPoints>) => this.hear(data);
    this.points.onerror = (event) => this.say.failed(event.message);
    this.tell({ type: "start", url: urls.points, wasm: urls.wasm, offset: view.offset_m });
    this.resize = new ResizeObserver(() => this.fit());
    this.resize.observe(canvas);
    let [x, y] = [0, 0];
    canvas.addEventListener("pointerdown", (event) => ([x, y] = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      if (Math.hypot(event.clientX - x, event.clientY - y) < 5) this.pick(event.clientX, event.clientY);
    });
  }

  /** Look at all trajectories, from the side. */
  home(): void {
    this.lookAt(this.view.scenes.flatMap((scene) => scene.trajectory_m), DIRECTION);
  }

  /** Look at some places, so that they just fit. */
  lookAt(places: readonly Point[], direction: Vector3): void {
    const points = (places.length > 0 ? places : [[0, 0, 0] as Point]).map((place) => new Vector3(...place));
    const low = points.reduce((a, b) => a.min(b), points[0]!.clone());
    const high = points.reduce((a, b) => a.max(b), points[0]!.clone());
    this.controls.target.copy(low).add(high).multiplyScalar(0.5);
    const back = direction.clone().normalize();
    const right = new Vector3().crossVectors(this.camera.up, back).normalize();
    const up = new Vector3().crossVectors(back, right);
    const tangent = Math.tan(MathUtils.degToRad(this.camera.fov) / 2);
    const distance = points.reduce((most, point) => {
      const from = point.clone().sub(this.controls.target);
      const across = (Math.abs(from.dot(right)) + AROUND_M) / (tangent * this.camera.aspect);
      const along = (Math.abs(from.dot(up)) + AROUND_M) / tangent;
      return Math.max(most, Math.max(across, along) + from.dot(back));
    }, 10);
    this.camera.position.copy(this.controls.target).addScaledVector(back, 1.08 * distance);
    this.controls.update();
    this.draw();
  }

  /** Look from straight above, north up. */
  above(): void {
    const distance = this.camera.position.distanceTo(this.controls.target);
    this.camera.position.copy(this.controls.target).add(new Vector3(0, -0.001 * distance, distance));
    this.controls.update();
    this.draw();
  }

  setPointSize(size: number): void {
    this.options.pointSizePx = size;
    this.show({ type: "options", ...this.options });
  }

  showFrusta(isShown: boolean): void {
    this.options.hasFrusta = isShown;
    this.show({ type: "options", ...this.options });
  }

  /** A picture's frustum is marked, and the view moves to it. */
  mark({ image }: Picked, look: boolean): void {
    this.show({ type: "mark", positions: flat(frustumPoints(image)) });
    if (!look) return;
    const centre = new Vector3(...image.frustum_m[0]!);
    const back = this.camera.position.clone().sub(this.controls.target).setLength(14);
    this.controls.target.copy(centre);
    this.camera.position.copy(centre).add(back);
    this.controls.update();
    this.draw();
  }

  /** Place of a point of view.json in pixels of the canvas, as tests and labels need it. */
  project(point: Point): [number, number] {
    this.camera.updateMatrixWorld();
    const { x, y } = new Vector3(...point).project(this.camera);
    return [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight];
  }

  close(): void {
    this.points.terminate();
    this.renderer.terminate();
    this.resize.disconnect();
    this.controls.dispose();
    cancelAnimationFrame(this.frame);
  }

  private tell(message: ToWorker): void {
    this.points.postMessage(message);
  }

  /** Give the renderer something to draw; the number of the message. */
  private show(message: ToRenderer, transferred: Transferable[] = []): number {
    this.renderer.postMessage(message, transferred);
    return ++this.told;
  }

  private hearRenderer(message: FromRenderer): void {
    if (message.type === "failed") return this.say.without3d(message.detail);
    this.drawn = message.messages;
    const seen = this.drawing.filter((one) => one.message <= message.messages);
    this.drawing = this.drawing.filter((one) => one.message > message.messages);
    for (const { node } of seen) {
      this.figures.shown += node.points;
      this.figures.nodes += 1;
      this.figures.firstMs ??= performance.now() - this.began;
    }
    this.sayFigures();
  }

  private addLine(points: readonly Point[], color: string, order: number): void {
    this.show({ type: "line", positions: flat(points), color, order });
  }

  private hear(message: FromPoints): void {
    if (message.type === "failed") this.say.failed(message.detail);
    if (message.type === "header") this.begin(message);
    if (message.type === "node") this.add(message);
  }

  private begin({ nodes, cube, spacing, points, size }: Extract<FromPoints, { type: "header" }>): void {
    const low = [0, 1, 2].map((axis) => cube[axis]! - this.view.offset_m[axis]!);
    const side = cube[3]! - cube[0]!;
    this.nodes = nodes.map((node) => {
      const [depth, ...place] = node.key.split("-").map(Number) as [number, number, number, number];
      const edge = side / 2 ** depth;
      const [x, y, z] = place.map((at, axis) => low[axis]! + (at + 0.5) * edge) as Point;
      return { ...node, centre: new Vector3(x, y, z), radius: (edge * Math.sqrt(3)) / 2, spacing: spacing / 2 ** depth, state: "known" };
    });
    this.figures.total = points;
    this.figures.size = size;
    this.draw();
  }

  private add({ key, positions, colors, bytes }: Extract<FromPoints, { type: "node" }>): void {
    this.asked -= 1;
    const node = this.nodes.find((one) => one.key === key)!;
    node.state = "shown";
    this.drawing.push({ message: this.show({ type: "points", positions, colors }, [positions.buffer, colors.buffer]), node });
    this.figures.bytes = bytes;
    this.request();
  }

  /** Nodes of which points would be seen apart, the coarsest on the screen first. */
  private request(): void {
    const scale = this.canvas.clientHeight / (2 * Math.tan(MathUtils.degToRad(this.camera.fov) / 2));
    this.camera.updateMatrixWorld();
    const wanted = this.nodes
      .filter((node) => node.state === "known")
      .map((node) => ({ node, px: this.isSeen(node) ? (node.spacing * scale) / Math.max(this.camera.position.distanceTo(node.centre) - node.radius, 0.5) : 0 }))
      .filter(({ node, px }) => px > SPACING_PX || node.key === "0-0-0-0")
      .sort((a, b) => b.px - a.px);
    let points = this.nodes.reduce((sum, node) => sum + (node.state === "known" ? 0 : node.points), 0);
    for (const { node } of wanted) {
      if (this.asked >= AT_ONE_TIME || points + node.points > MOST_POINTS) break;
      node.state = "asked";
      points += node.points;
      this.asked += 1;
      this.tell({ type: "load", key: node.key });
    }
    this.sayFigures();
  }

  private sayFigures(): void {
    this.figures.isIdle = this.asked === 0 && this.nodes.length > 0 && this.drawn === this.told && this.frame === 0;
    this.say.figures({ ...this.figures });
  }

  private isSeen(node: Node): boolean {
    const inView = node.centre.clone().applyMatrix4(this.camera.matrixWorldInverse);
    const half = Math.tan(MathUtils.degToRad(this.camera.fov) / 2);
    const reach = node.radius * 1.6;
    return -inView.z > -reach && Math.abs(inView.y) < Math.max(-inView.z, 0) * half + reach && Math.abs(inView.x) < Math.max(-inView.z, 0) * half * this.camera.aspect + reach;
  }

  /** The image whose frustum is drawn nearest to a place on the screen. */
  private pick(clientX: number, clientY: number): void {
    if (!this.options.hasFrusta) return;
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [clientX - box.left, clientY - box.top];
    let nearest: { picked: Picked; px: number } | null = null;
    for (const of of this.view.scenes) {
      for (const image of of.images) {
        const corners = image.frustum_m.map((point) => this.onScreen(point));
        for (const [a, b] of EDGES) {
          const px = distanceToSegment(x, y, corners[a]!, corners[b]!);
          if (px < (nearest?.px ?? PICKED_PX)) nearest = { picked: { scene: of, image }, px };
        }
      }
    }
    if (nearest) this.say.picked(nearest.picked);
  }

  private onScreen(point: Point): [number, number] | null {
    const place = new Vector3(...point).applyMatrix4(this.camera.matrixWorldInverse);
    return place.z > -this.camera.near ? null : this.project(point);
  }

  private fit(): void {
    const { clientWidth, clientHeight } = this.canvas;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    if (!this.isFitted) this.home();
    this.isFitted = true;
    this.draw();
  }

  private draw(): void {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      const { position, quaternion, fov, near, far } = this.camera;
      const { clientWidth: width, clientHeight: height } = this.canvas;
      if (width === 0 || height === 0) return;
      this.show({ type: "view", view: { position: position.toArray(), quaternion: quaternion.toArray(), fovDeg: fov, near, far, width, height, pixelRatio: Math.min(window.devicePixelRatio, 2) } });
      this.request();
    });
  }
}

function distanceToSegment(x: number, y: number, a: [number, number] | null, b: [number, number] | null): number {
  if (!a || !b) return Infinity;
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  const along = Math.min(1, Math.max(0, ((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x - a[0] - along * dx, y - a[1] - along * dy);
}

function frustumPoints(image: ViewImage): Point[] {
  return EDGES.flatMap(([a, b]) => [image.frustum_m[a]!, image.frustum_m[b]!]);
}

function flat(points: readonly Point[]): Float32Array {
  return Float32Array.from(points.flat());
}

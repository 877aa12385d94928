// The scene in 3D: points by their size on the screen, trajectories, frusta and seams.
import {
  BufferAttribute, BufferGeometry, Color, Line, LineBasicMaterial, LineSegments, MathUtils, PerspectiveCamera, Points,
  PointsMaterial, Scene, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Point, ViewDocument, ViewImage, ViewScene } from "./document";
import type { FromPoints, NodeInfo, ToWorker } from "./points.worker";

const MOST_POINTS = 6_000_000;
const AT_ONE_TIME = 2; // nodes that are being loaded
const SPACING_PX = 2.2; // a node is loaded while its points are farther apart than this on the screen
const PICKED_PX = 6;
const EDGES: [number, number][] = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];
const SELECTED = new Color("#ffffff");

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
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly controls: OrbitControls;
  private readonly worker: Worker;
  private readonly began = performance.now();
  private readonly material = new PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true });
  private readonly frusta: { lines: LineSegments; of: ViewScene }[] = [];
  private readonly resize: ResizeObserver;
  private marked: LineSegments | null = null;
  private nodes: Node[] = [];
  private asked = 0;
  private frame = 0;
  private isFitted = false; // to the canvas, whose size is known late

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly view: ViewDocument,
    urls: { points: string; worker: string; wasm: string },
    private readonly say: { figures: (figures: Figures) => void; failed: (detail: string) => void; picked: (picked: Picked) => void },
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene.background = new Color("#14181d");
    this.camera = new PerspectiveCamera(50, 1, 0.2, 20000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.controls.listenToKeyEvents(canvas);
    for (const scene of view.scenes) this.addScene(scene);
    for (const seam of view.seams) if (seam.line_m && seam.accepted) this.addLine(seam.line_m, "#ffffff", 1);
    this.home();
    this.worker = new Worker(urls.worker);
    this.worker.onmessage = ({ data }: MessageEvent<FromPoints>) => this.hear(data);
    this.worker.onerror = (event) => this.say.failed(event.message);
    this.tell({ type: "start", url: urls.points, wasm: urls.wasm, offset: view.offset_m });
    this.resize = new ResizeObserver(() => this.fit());
    this.resize.observe(canvas);
    let [x, y] = [0, 0];
    canvas.addEventListener("pointerdown", (event) => ([x, y] = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      if (Math.hypot(event.clientX - x, event.clientY - y) < 5) this.pick(event.clientX, event.clientY);
    });
  }

  /** Look at everything from the side of the first trajectory. */
  home(): void {
    const all = this.view.scenes.flatMap((scene) => scene.trajectory_m);
    const points = all.length > 0 ? all : [[0, 0, 0] as Point];
    const axis = (index: 0 | 1 | 2): [number, number] => {
      const values = points.map((point) => point[index]);
      return [values.reduce((a, b) => Math.min(a, b), Infinity), values.reduce((a, b) => Math.max(a, b), -Infinity)];
    };
    const [x, y, z] = [axis(0), axis(1), axis(2)];
    const radius = Math.max(0.5 * Math.hypot(x[1] - x[0], y[1] - y[0], z[1] - z[0]), 8) + 4; // with the frusta around it
    const half = MathUtils.degToRad(this.camera.fov) / 2;
    const narrower = Math.min(half, Math.atan(Math.tan(half) * this.camera.aspect));
    this.controls.target.set((x[0] + x[1]) / 2, (y[0] + y[1]) / 2, (z[0] + z[1]) / 2);
    this.camera.position.copy(this.controls.target).add(new Vector3(-0.3, -0.68, 0.67).setLength(radius / Math.sin(narrower)));
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
    this.material.size = size;
    this.draw();
  }

  showFrusta(isShown: boolean): void {
    for (const { lines } of this.frusta) lines.visible = isShown;
    this.draw();
  }

  /** A picture's frustum is marked, and the view moves to it. */
  mark({ image }: Picked, look: boolean): void {
    if (this.marked) this.scene.remove(this.marked);
    this.marked = this.lines(frustumPoints(image), SELECTED);
    this.scene.add(this.marked);
    if (look) {
      const centre = new Vector3(...image.frustum_m[0]!);
      const back = this.camera.position.clone().sub(this.controls.target).setLength(14);
      this.controls.target.copy(centre);
      this.camera.position.copy(centre).add(back);
      this.controls.update();
    }
    this.draw();
  }

  /** Place of a point of view.json in pixels of the canvas, as tests and labels need it. */
  project(point: Point): [number, number] {
    this.camera.updateMatrixWorld();
    const { x, y } = new Vector3(...point).project(this.camera);
    return [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight];
  }

  close(): void {
    this.worker.terminate();
    this.resize.disconnect();
    this.controls.dispose();
    this.scene.traverse((part) => {
      if (part instanceof Points || part instanceof Line) part.geometry.dispose();
    });
    this.renderer.dispose();
    cancelAnimationFrame(this.frame);
  }

  private tell(message: ToWorker): void {
    this.worker.postMessage(message);
  }

  private addScene(of: ViewScene): void {
    this.addLine(of.trajectory_m, of.color, 3);
    const lines = this.lines(of.images.flatMap(frustumPoints), new Color(of.color));
    this.frusta.push({ lines, of });
    this.scene.add(lines);
  }

  private addLine(points: readonly Point[], color: string, order: number): void {
    const geometry = new BufferGeometry().setFromPoints(points.map((point) => new Vector3(...point)));
    const line = new Line(geometry, new LineBasicMaterial({ color, depthTest: false, transparent: true }));
    line.renderOrder = order; // over the points: a path is never hidden by what the vehicle saw
    this.scene.add(line);
  }

  private lines(points: readonly Point[], color: Color): LineSegments {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(points.flat()), 3));
    return new LineSegments(geometry, new LineBasicMaterial({ color, transparent: true, opacity: color === SELECTED ? 1 : 0.55 }));
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
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(positions, 3));
    geometry.setAttribute("color", new BufferAttribute(linear(colors), 3, true));
    this.scene.add(new Points(geometry, this.material));
    this.figures.shown += node.points;
    this.figures.nodes += 1;
    this.figures.bytes = bytes;
    this.figures.firstMs ??= performance.now() - this.began;
    this.draw();
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
    let points = this.figures.shown;
    for (const { node } of wanted) {
      if (this.asked >= AT_ONE_TIME || points + node.points > MOST_POINTS) break;
      node.state = "asked";
      points += node.points;
      this.asked += 1;
      this.tell({ type: "load", key: node.key });
    }
    this.figures.isIdle = this.asked === 0 && this.nodes.length > 0;
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
    if (!this.frusta[0]?.lines.visible) return;
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [clientX - box.left, clientY - box.top];
    let nearest: { picked: Picked; px: number } | null = null;
    for (const { of } of this.frusta) {
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
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    if (!this.isFitted) this.home();
    this.isFitted = true;
    this.draw();
  }

  private draw(): void {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      this.renderer.render(this.scene, this.camera);
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

const LINEAR = Uint8Array.from({ length: 256 }, (_, value) => Math.round(255 * (value / 255) ** 2.2));

/** The renderer computes with linear colours; files hold those of a screen. */
function linear(colors: Uint8Array): Uint8Array {
  return colors.map((value) => LINEAR[value]!);
}

// Trajectories on a map. It needs no tiles; MRASFM_CONSOLE_TILES names some.
import { useEffect, useRef, useState } from "preact/hooks";
import { Map as MapLibre, NavigationControl, ScaleControl, setWorkerUrl, type LngLatLike } from "maplibre-gl";
import { fileUrl, get, session, type Problem } from "../client";
import { Content, ProblemBox, useLoad } from "../components";
import { count } from "../format";
import { html, type Shown } from "../html";
import type { ViewDocument } from "../viewer/document";

export function Place({ base }: { base: string }): Shown {
  const loaded = useLoad((abort) => get<ViewDocument>(fileUrl(base, "view.json"), abort), `place ${base}`, false);
  return html`<${Content} of=${loaded}>${(view: ViewDocument) => html`<${Lines} view=${view} tiles=${session.value?.console_tiles ?? null} />`}<//>`;
}

function Lines({ view, tiles }: { view: ViewDocument; tiles: string | null }): Shown {
  const box = useRef<HTMLDivElement>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    let map: MapLibre | null = null;
    try {
      map = draw(box.current!, view, tiles);
    } catch (error) {
      setProblem({ title: "This browser shows no map", detail: error instanceof Error ? error.message : String(error), remedy: "Switch on hardware acceleration, or open trajectory.gpkg in another program." });
    }
    return () => map?.remove();
  }, []);
  return html`${problem && html`<${ProblemBox} problem=${problem} />`}
    <div class="place" ref=${box}></div>
    <ul class="legend">${view.scenes.map((scene) => html`<li><span class="swatch" style=${{ background: scene.color }}></span>${scene.name}: ${count(scene.trajectory_m.length)} units</li>`)}
      <li class="muted">${tiles ? "" : "Without a background: the operator may name one with MRASFM_CONSOLE_TILES."}</li></ul>`;
}

function draw(container: HTMLDivElement, view: ViewDocument, tiles: string | null): MapLibre {
  const sheet = document.createElement("link");
  sheet.rel = "stylesheet";
  sheet.href = new URL("place.css", import.meta.url).href;
  document.head.append(sheet);
  setWorkerUrl(new URL("maplibre-gl-worker.mjs", import.meta.url).href);
  const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
  const lines = view.scenes.filter((scene) => scene.longitude_latitude_deg && scene.longitude_latitude_deg.length > 0);
  const positions = lines.flatMap((scene) => scene.longitude_latitude_deg!);
  const range = (axis: 0 | 1): [number, number] => positions.reduce<[number, number]>(([low, high], place) => [Math.min(low, place[axis]), Math.max(high, place[axis])], [Infinity, -Infinity]);
  const [[west, east], [south, north]] = [range(0), range(1)];
  const map = new MapLibre({
    container,
    attributionControl: false,
    maxZoom: 24,
    bounds: [[west, south], [east, north]] as [LngLatLike, LngLatLike],
    fitBoundsOptions: { padding: 60, maxZoom: 22 },
    style: {
      version: 8,
      sources: {
        ...(tiles ? { tiles: { type: "raster" as const, tiles: [tiles], tileSize: 256, maxzoom: 19 } } : {}),
        ...Object.fromEntries(lines.map((scene, index) => [`scene-${index}`, { type: "geojson" as const, data: { type: "Feature" as const, properties: {}, geometry: { type: "LineString" as const, coordinates: scene.longitude_latitude_deg! } } }])),
      },
      layers: [
        { id: "back", type: "background", paint: { "background-color": isDark ? "#1a2026" : "#eef1f3" } },
        ...(tiles ? [{ id: "tiles", type: "raster" as const, source: "tiles" }] : []),
        ...lines.map((scene, index) => ({ id: `scene-${index}`, type: "line" as const, source: `scene-${index}`, layout: { "line-cap": "round" as const, "line-join": "round" as const }, paint: { "line-color": scene.color, "line-width": 5 } })),
      ],
    },
  });
  map.addControl(new NavigationControl({ visualizePitch: false }));
  map.addControl(new ScaleControl({ unit: "metric" }));
  Object.assign(container, { map }); // tests ask where a position is on the screen
  return map;
}

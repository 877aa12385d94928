// Lines over time as SVG: some dozens of values need no library.
import { moment, significant } from "../format";
import { html, type Shown } from "../html";

export interface Series {
  name: string;
  points: { x: number; y: number; sigma: number }[];
}

export const COLORS = ["#0b8a8a", "#d1720a", "#7a4fc4", "#c2334d", "#3f7d20", "#1f6fc2", "#8a6d3b", "#b0479b"];
const [WIDTH, HEIGHT, LEFT, BOTTOM, TOP] = [800, 220, 64, 28, 10];

export function Chart({ title, unit, series }: { title: string; unit: string; series: readonly Series[] }): Shown {
  const points = series.flatMap((one) => one.points);
  const xs = points.map((point) => point.x);
  const [x0, x1] = [Math.min(...xs), Math.max(...xs)];
  const low = Math.min(0, ...points.map((point) => point.y - point.sigma));
  const high = Math.max(0, ...points.map((point) => point.y + point.sigma));
  const margin = (high - low || 1) * 0.06;
  const [y0, y1] = [low - margin, high + margin];
  const x = (value: number): number => LEFT + 8 + ((value - x0) / (x1 - x0 || 1)) * (WIDTH - LEFT - 24);
  const y = (value: number): number => TOP + (1 - (value - y0) / (y1 - y0)) * (HEIGHT - BOTTOM - TOP);
  return html`<figure class="chart"><figcaption>${title}</figcaption>
    <svg viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label=${title}>
      ${[low, 0, high].filter((value, index, all) => all.indexOf(value) === index).map((value) => html`<g>
        <line class="axis" x1=${LEFT} x2=${WIDTH} y1=${y(value)} y2=${y(value)} />
        <text x=${LEFT - 6} y=${y(value) + 4} text-anchor="end">${significant(value, 2)} ${unit}</text></g>`)}
      <text x=${LEFT} y=${HEIGHT - 8}>${moment(new Date(x0).toISOString()).slice(0, 16)}</text>
      <text x=${WIDTH} y=${HEIGHT - 8} text-anchor="end">${moment(new Date(x1).toISOString()).slice(0, 16)}</text>
      ${series.map((one, index) => html`<g stroke=${COLORS[index % COLORS.length]} fill="none" stroke-width="1.6">
        <polyline points=${one.points.map((point) => `${x(point.x)},${y(point.y)}`).join(" ")} />
        ${one.points.map((point) => html`<line x1=${x(point.x)} x2=${x(point.x)} y1=${y(point.y - point.sigma)} y2=${y(point.y + point.sigma)} /><circle cx=${x(point.x)} cy=${y(point.y)} r="3" fill=${COLORS[index % COLORS.length]} data-value=${point.y} />`)}
      </g>`)}
    </svg>
    <ul class="legend">${series.map((one, index) => html`<li><span class="swatch" style=${{ background: COLORS[index % COLORS.length] }}></span>${one.name}</li>`)}</ul>
  </figure>`;
}

import { useState } from "preact/hooks";
import type { FileResource } from "../client";
import { Empty } from "../components";
import { bytes, plural } from "../format";
import { html, type Shown } from "../html";

const MEANINGS: [RegExp, string][] = [
  [/^report\.html$/, "the report, for people: opens without the internet"],
  [/^report\.json$/, "findings, time and counts of every stage, uncertainty"],
  [/^points\.copc\.laz$/, "the points for GIS programs, cloud-optimised"],
  [/^points\.ply$/, "the points with colours, for any viewer"],
  [/^poses\.json$/, "poses of units and images with sigmas"],
  [/^poses\.tum$/, "poses of the vehicle"],
  [/^trajectory\.gpkg$/, "positions as a GeoPackage"],
  [/^calibration(\.json|\/)/, "every camera as given and as refined"],
  [/^frame\.json$/, "the coordinate frame and its place on the earth"],
  [/^view\.json$/, "trajectory and frusta for this console"],
  [/^features\.db$/, "keypoints and matches as a COLMAP database"],
  [/^model\//, "cameras, rig, images and points in COLMAP's format"],
  [/^rigs?\//, "the calibration for Kalibr, ROS and URDF"],
  [/^autoware\//, "the points for Autoware"],
  [/^pictures\/birds_eye_/, "the road from above, all cameras, before and after calibration"],
  [/^pictures\/road_(before|after)/, "points of the road, before and after those off its surface were dropped"],
  [/^pictures\/road\.tif$/, "the road from above as a GeoTIFF, the best view of each place"],
  [/^pictures\/road\.pgw$/, "the place of road.png on the earth (world file)"],
  [/^pictures\/road\.png$/, "the road from above, the best view of each place"],
  [/^pictures\/seam-/, "points of two scenes at their seam, before and after"],
  [/^pictures\//, "a picture"],
  [/^road\.json$/, "the surface of the road"],
  [/^map\.json$/, "scenes, seams and verdicts"],
  [/^manifest\.json$/, "the drive's manifest, in the engine's axes"],
  [/^(scenes|seams)\//, "data for the map's next version"],
  [/^own_car\//, "where the camera shows its own car"],
  [/^components\//, "of a part of the drive that nothing links to the rest"],
];

export function Files({ files }: { files: readonly FileResource[] }): Shown {
  const [wanted, setWanted] = useState("");
  const shown = files.filter((file) => file.path.toLowerCase().includes(wanted.toLowerCase()));
  const total = files.reduce((sum, file) => sum + file.size_bytes, 0);
  return html`<h2>Files</h2>
    <p class="muted">${plural(files.length, "file")}, ${bytes(total)} together.</p>
    <label class="filter">Find a file <input type="search" value=${wanted} onInput=${(event: Event) => setWanted((event.target as HTMLInputElement).value)} /></label>
    ${shown.length === 0
      ? html`<${Empty}>No file of this name.<//>`
      : html`<${FileTable} files=${shown} label="Files" />`}`;
}

export function FileTable({ files, label }: { files: readonly FileResource[]; label: string }): Shown {
  return html`<div class="scroll" tabindex="0" role="region" aria-label=${label}><table>
    <thead><tr><th scope="col">File</th><th scope="col" class="number">Size</th><th scope="col">Content</th></tr></thead>
    <tbody>${files.map(
      (file) => html`<tr key=${file.path}><td><a href=${file.url.replace(/^\//, "")} download>${file.path}</a></td>
        <td class="number">${bytes(file.size_bytes)}</td><td>${MEANINGS.find(([name]) => name.test(file.path))?.[1] ?? ""}</td></tr>`,
    )}</tbody></table></div>`;
}

// Builds the console: the same bytes from the same sources, wherever it runs.
import { build } from "esbuild";
import { createHash } from "node:crypto";
import { copyFile, mkdir, readFile, readdir, rm, writeFile } from "node:fs/promises";
import { dirname, join, relative, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const [console_ = join(here, "static"), report = join(here, "../../mrasfm_engine/visualization/static")] = process.argv
  .slice(2)
  .map((path) => resolve(path));
process.chdir(here);
const common = { bundle: true, minify: true, target: "es2022", legalComments: "none", metafile: true, logLevel: "warning", charset: "utf8" };

async function bundle(entryPoints, outdir, more) {
  const { metafile } = await build({ ...common, entryPoints, outdir, ...more });
  return metafile;
}

for (const folder of [console_, report]) {
  await rm(folder, { recursive: true, force: true });
  await mkdir(folder, { recursive: true });
}
const metafiles = [
  // Chunks are named by their content, so that no browser mixes two versions.
  await bundle({ console: "src/main.ts" }, console_, { format: "esm", splitting: true, chunkNames: "[name]-[hash]" }),
  await bundle({ events: "src/events.worker.ts", points: "src/viewer/points.worker.ts", render: "src/viewer/render.worker.ts", hash: "src/upload/hash.worker.ts" }, console_, { format: "iife" }),
  await bundle({ console: "src/style.css", place: "src/place/place.css" }, console_, { loader: { ".svg": "dataurl" } }),
  await bundle({ report: "src/report/report.ts" }, report, { format: "iife" }),
  await bundle({ report: "src/report/report.css" }, report, {}),
];
await copyFile("src/index.html", join(console_, "index.html"));
await copyFile("src/icon.svg", join(console_, "icon.svg"));
await copyFile("node_modules/laz-perf/lib/web/laz-perf.wasm", join(console_, "laz-perf.wasm"));
await copyFile("node_modules/maplibre-gl/dist/maplibre-gl-worker.mjs", join(console_, "maplibre-gl-worker.mjs"));
await writeFile(join(console_, "licences.txt"), await licences(metafiles));
await writeFile("build.sha256", await digests());

/** What was built of what, as sha256sum writes it: whoever changes a source sees without node that it is not built. */
async function digests() {
  const sources = (await readdir("src", { recursive: true, withFileTypes: true }))
    .filter((entry) => entry.isFile())
    .map((entry) => relative(here, join(entry.parentPath ?? entry.path, entry.name)));
  const fixed = ["build.mjs", "build/openapi.json", "package-lock.json", "package.json", "tsconfig.json"];
  const built = [];
  for (const folder of [console_, report]) {
    const as = folder === console_ ? "static" : "report";
    built.push(...(await readdir(folder)).map((name) => [`${as}/${name}`, join(folder, name)]));
  }
  const files = [...fixed, ...sources].map((name) => [name, join(here, name)]).concat(built);
  files.sort(([a], [b]) => (a < b ? -1 : 1));
  const lines = files.map(async ([name, path]) => {
    return `${createHash("sha256").update(await readFile(path)).digest("hex")}  ${name}\n`;
  });
  return (await Promise.all(lines)).join("");
}

/** Licences of all packages whose code is in a bundle. */
async function licences(all) {
  const inputs = all.flatMap((metafile) => Object.keys(metafile.inputs)).filter((path) => path.includes("node_modules/"));
  const folders = inputs.map((path) => relative(here, resolve(here, path)).match(/^(.*node_modules\/(?:@[^/]+\/)?[^/]+)/)[1]);
  const texts = [];
  for (const folder of [...new Set([...folders, "node_modules/laz-perf", "node_modules/maplibre-gl"])].sort()) {
    const { name, version, license } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
    texts.push(`${name} ${version}\n${license}\n\n${await licenceOf(folder)}`);
  }
  return texts.join(`\n${"=".repeat(80)}\n\n`);
}

async function licenceOf(folder) {
  for (const name of ["LICENSE", "LICENSE.txt", "LICENSE.md", "license", "LICENCE", "COPYING"]) {
    try {
      return (await readFile(join(folder, name), "utf8")).replaceAll("\r\n", "\n").trimEnd() + "\n";
    } catch {
      continue;
    }
  }
  return "The package has no file with the text of its licence.\n";
}

// Bundles three_parts.js into three.bundle.js, with the licence of three.js at its head.
import { readFileSync } from "node:fs";
import { build } from "esbuild";

const licence = readFileSync("node_modules/three/LICENSE", "utf8").trim();
const { version } = JSON.parse(readFileSync("node_modules/three/package.json", "utf8"));
await build({
  entryPoints: ["three_parts.js"],
  outfile: "three.bundle.js",
  bundle: true,
  minify: true,
  format: "iife",
  globalName: "THREE",
  target: "es2022",
  legalComments: "none",
  banner: { js: `/* three.js ${version}, https://threejs.org\n\n${licence}\n*/` },
});

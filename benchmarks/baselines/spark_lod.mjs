// Simplify a PLY by the level-of-detail tree of Spark (npm package @sparkjsdev/spark) and write cuts of COUNT splats each.
//
//   npm install @sparkjsdev/spark@2.2.0; NODE_PATH=node_modules node spark_lod.mjs tiny|bhatt IN.ply OUT.ply COUNT [OUT.ply COUNT ...]
//
// Its own compiled code decodes the file, builds the tree (bases 1.5 and 1.75, its defaults for splats of full precision) and
// cuts it at a budget, for a camera so far away that all splats have one distance, without foveation. What is written here is
// what its decoder gives, so SH above the constant band can be off by up to half (a scene that is only decoded still scores 58 dB and more);
// opacities above 1, which only its own shader can draw, become 0.9999.
import fs from "node:fs";
import path from "node:path";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const [mode, source, ...cuts] = process.argv.slice(2);
const require = createRequire(path.join(process.cwd(), "anything.js"));
const dist = path.dirname(require.resolve("@sparkjsdev/spark"));

// The package bundles its glue code and its wasm; the source map has the former as a file, the bundle the latter in base 64.
const assets = path.join(dist, "assets");
const map = JSON.parse(fs.readFileSync(path.join(assets, fs.readdirSync(assets).filter((name) => name.endsWith(".map")).sort()[0]), "utf8"));
const glue = map.sourcesContent[map.sources.findIndex((name) => name.endsWith("spark_rs.js"))];
const bundle = fs.readFileSync(path.join(dist, "spark.module.js"), "utf8");
const wasm = Buffer.from(bundle.match(/"(AGFzbQ[A-Za-z0-9+/=]+)"/)[1], "base64");
const temporary = fs.mkdtempSync(path.join(fs.realpathSync(require("node:os").tmpdir()), "spark-"));
fs.writeFileSync(path.join(temporary, "glue.mjs"), glue);
const spark = await import(pathToFileURL(path.join(temporary, "glue.mjs")));
fs.rmSync(temporary, { recursive: true });
spark.initSync({ module: wasm });

const decoder = spark.decode_to_gsplatarray("ply", source);
const bytes = fs.readFileSync(source);
for (let at = 0; at < bytes.length; at += 1 << 20) decoder.push(bytes.subarray(at, at + (1 << 20)));
const splats = decoder.finish();
const full = splats.len();
if (mode === "bhatt") splats.bhatt_lod(1.75);
else splats.tiny_lod(1.5, false);
const tree = splats.to_extsplats_lod();
const { lodId } = spark.init_lod_tree(tree.numSplats, tree.lodTree);

// A camera that looks at the scene from very far away: Spark orders nodes by size over distance.
const far = 1e6;
const view = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, far, 1]);
const one = (value) => new Float32Array([value]);
const cut = (budget) => spark.traverse_lod_trees(budget, 0, undefined, new Uint32Array([lodId]), new Uint32Array([0xffffffff]),
  view, one(1), one(1), one(1), one(0), one(180)).instanceIndices[0];

const half = (bits) => {
  const sign = bits & 0x8000 ? -1 : 1, power = (bits >> 10) & 31, part = bits & 1023;
  if (power === 0) return sign * 2 ** -24 * part;
  return power === 31 ? (part ? NaN : sign * Infinity) : sign * 2 ** (power - 15) * (1 + part / 1024);
};
const float = new Float32Array(1), word = new Uint32Array(float.buffer);
const single = (bits) => { word[0] = bits; return float[0]; };
const color = (bits) => {
  const unit = 2 ** ((bits >>> 27) - 15) / 255;
  return [0, 1, 2].map((k) => ((bits >>> (8 * k)) & 255) * unit * (bits & (1 << (24 + k)) ? -1 : 1));
};
const quaternion = (bits) => {
  // Axis in an octahedron of 10 + 10 bits, angle in 12 bits.
  let u = (bits & 1023) / 1023 * 2 - 1, v = ((bits >>> 10) & 1023) / 1023 * 2 - 1;
  let z = 1 - Math.abs(u) - Math.abs(v);
  const fold = Math.max(-z, 0);
  let x = u + (u >= 0 ? -fold : fold), y = v + (v >= 0 ? -fold : fold);
  const length = Math.hypot(x, y, z), theta = (bits >>> 20) / 4095 * Math.PI;
  const s = Math.sin(theta / 2) / length;
  return [Math.cos(theta / 2), x * s, y * s, z * s];
};
const { sh1, sh2, sh3a, sh3b } = tree;
const degree = sh3a ? 3 : sh2 ? 2 : sh1 ? 1 : 0;
const rest = (degree + 1) ** 2 - 1;
const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", ...Array.from({ length: 3 * rest }, (_, k) => `f_rest_${k}`), "opacity",
  "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
const logit = (value) => { const clipped = Math.min(Math.max(value, 1e-4), 0.9999); return Math.log(clipped / (1 - clipped)); };
const row = (i) => {
  const a = tree.ext0, b = tree.ext1;
  const rgb = [b[i] & 65535, b[i] >>> 16, b[i + 1] & 65535].map(half);
  const bands = degree ? [sh1[i], sh1[i + 1], sh1[i + 2]] : [];
  if (degree > 1) bands.push(sh1[i + 3], ...sh2.subarray(i, i + 4));
  if (degree > 2) bands.push(...sh3a.subarray(i, i + 4), ...sh3b.subarray(i, i + 3));
  const sh = bands.map(color);
  return [single(a[i]), single(a[i + 1]), single(a[i + 2]), ...rgb.map((value) => (value - 0.5) / 0.28209479177387814),
    ...[0, 1, 2].flatMap((channel) => sh.map((one) => one[channel])), logit(half(a[i + 3] & 65535)),
    half(b[i + 1] >>> 16), half(b[i + 2] & 65535), half(b[i + 2] >>> 16), ...quaternion(b[i + 3])];
};
for (let at = 0; at < cuts.length; at += 2) {
  const { numSplats, indices } = cut(Number(cuts[at + 1]));
  const rows = indices.subarray(0, numSplats);
  const above = rows.reduce((sum, n) => sum + (half(tree.ext0[4 * n + 3] & 65535) > 1), 0);
  console.error(`${mode}: ${full} -> tree of ${tree.numSplats}; asked for ${cuts[at + 1]}, cut of ${numSplats}, ${above} opacities above 1`);
  const out = new Float32Array(names.length * numSplats);
  rows.forEach((n, place) => out.set(row(4 * n), place * names.length));
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${numSplats}\n${names.map((name) => `property float ${name}\n`).join("")}end_header\n`;
  fs.writeFileSync(cuts[at], Buffer.concat([Buffer.from(header), Buffer.from(out.buffer)]));
}

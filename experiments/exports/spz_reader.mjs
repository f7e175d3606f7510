// Reads splats.spz and splats.ply of an export by spz-js, and prints how far they are apart in each quantity:
//     npm install --prefix OUT spz-js && node experiments/exports/spz_reader.mjs OUT runs/demo/exports/splats-3000
// Opacities are logits, scales logarithms, as in the files. An SPZ file holds rounded numbers, so the largest distances
// are those of its steps.
import {readFileSync} from "node:fs";
import {createRequire} from "node:module";
import {pathToFileURL} from "node:url";
import {resolve, join} from "node:path";

const [modules, folder] = process.argv.slice(2);
const found = createRequire(pathToFileURL(resolve(modules) + "/")).resolve("spz-js");
const reader = await import(pathToFileURL(found));
const spz = await reader.loadSpz(readFileSync(join(folder, "splats.spz")));
const ply = await reader.loadPly(new Blob([readFileSync(join(folder, "splats.ply"))]).stream());
console.log(`${spz.numPoints} Gaussians of degree ${spz.shDegree} in the SPZ file, ${ply.numPoints} of ${ply.shDegree} in the PLY file`);
for (const name of ["positions", "scales", "alphas", "colors", "sh"]) {
  const [a, b] = [spz[name], ply[name]];
  let [largest, sum] = [0, 0];
  for (let index = 0; index < Math.max(a.length, b.length); index++) {
    const distance = Math.abs(a[index] - b[index]);
    largest = distance > largest || Number.isNaN(distance) ? distance : largest;
    sum += distance;
  }
  console.log(`${name}: mean distance ${(sum / a.length).toPrecision(2)}, largest ${largest.toPrecision(2)}`);
}
// Half a turn about an axis of its own leaves a Gaussian as it is, so the axes are compared but for their signs.
const axes = (all, start) => {
  const [x, y, z, w] = all.slice(start, start + 4);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
};
let smallest = 1;
for (let start = 0; start < spz.rotations.length; start += 4) {
  const [a, b] = [axes(spz.rotations, start), axes(ply.rotations, start)];
  for (let axis = 0; axis < 3; axis++) {
    smallest = Math.min(smallest, Math.abs(a[axis].reduce((sum, value, index) => sum + value * b[axis][index], 0)));
  }
}
console.log(`axes: largest angle ${((180 / Math.PI) * Math.acos(smallest)).toPrecision(2)} degrees`);

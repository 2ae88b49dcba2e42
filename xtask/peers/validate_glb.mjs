// Runs the Khronos glTF validator: node validate_glb.mjs FOLDER_WITH_NODE_MODULES FILE.glb
// Prints the summary; exits with 1 on an error or a warning, with 3 when the validator isn't installed.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { resolve } from "node:path";

const [packages, file] = process.argv.slice(2);
if (!packages || !file) {
  console.error("usage: node validate_glb.mjs FOLDER_WITH_NODE_MODULES FILE.glb");
  process.exit(2);
}
let validator;
try {
  validator = createRequire(resolve(packages, "x.js"))("gltf-validator");
} catch {
  console.error(`gltf-validator isn't in ${packages}; npm install --prefix ${packages} gltf-validator`);
  process.exit(3);
}
const report = await validator.validateBytes(new Uint8Array(readFileSync(file)), { uri: file, maxIssues: 100 });
const { numErrors, numWarnings, numInfos, numHints, messages } = report.issues;
for (const m of messages) console.log(`${["error", "warning", "info", "hint"][m.severity]} ${m.code} ${m.pointer}: ${m.message}`);
console.log(`validator ${validator.version()}: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos, ${numHints} hints`);
const { totalVertexCount, totalTriangleCount, materialCount } = report.info;
console.log(`${totalVertexCount} vertices, ${totalTriangleCount} triangles, ${materialCount} material`);
process.exit(numErrors + numWarnings > 0 ? 1 : 0);

// Six pictures of a GLB, drawn by three.js in headless Chromium:
//   node view_glb.mjs FOLDER_WITH_NODE_MODULES FILE.glb FOLDER_FOR_PICTURES
// Exits with 1 on a console error or when a picture shows nothing.
import { createReadStream, existsSync, mkdirSync } from "node:fs";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { join, resolve } from "node:path";

const [packages, file, out] = process.argv.slice(2);
if (!out) {
  console.error("usage: node view_glb.mjs FOLDER_WITH_NODE_MODULES FILE.glb FOLDER_FOR_PICTURES");
  process.exit(2);
}
const { chromium } = createRequire(resolve(packages, "x.js"))("playwright-core");
const page = `<!doctype html><body style="margin:0"><canvas id="c" width="640" height="640"></canvas>
<script type="importmap">{"imports":{"three":"/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "/three/examples/jsm/loaders/GLTFLoader.js";
const renderer = new THREE.WebGLRenderer({ canvas: document.getElementById("c"), antialias: true, preserveDrawingBuffer: true });
const scene = new THREE.Scene();
scene.background = new THREE.Color(0x1144aa);
scene.add(new THREE.AmbientLight(0xffffff, 3));
const gltf = await new GLTFLoader().loadAsync("/model.glb");
scene.add(gltf.scene);
const box = new THREE.Box3().setFromObject(gltf.scene);
const sphere = box.getBoundingSphere(new THREE.Sphere());
const camera = new THREE.PerspectiveCamera(35, 1, sphere.radius / 10, sphere.radius * 20);
window.size = box.getSize(new THREE.Vector3()).toArray();
window.look = (direction) => {
  camera.position.copy(sphere.center).addScaledVector(new THREE.Vector3(...direction).normalize(), sphere.radius * 3.6);
  camera.lookAt(sphere.center);
  renderer.render(scene, camera);
  const gl = renderer.getContext();
  const pixels = new Uint8Array(640 * 640 * 4);
  gl.readPixels(0, 0, 640, 640, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  let drawn = 0, black = 0;
  const [r, g, b] = [pixels[0], pixels[1], pixels[2]];
  for (let i = 0; i < pixels.length; i += 4) {
    if (Math.abs(pixels[i] - r) + Math.abs(pixels[i + 1] - g) + Math.abs(pixels[i + 2] - b) > 12) drawn++;
    if (pixels[i] + pixels[i + 1] + pixels[i + 2] < 6) black++;
  }
  return { drawn: drawn / (640 * 640), black };
};
window.ready = true;
</script>`;
const server = createServer((request, response) => {
  const send = (path, type) => {
    response.setHeader("Content-Type", type);
    createReadStream(path).pipe(response);
  };
  if (request.url === "/") {
    response.setHeader("Content-Type", "text/html");
    response.end(page);
  } else if (request.url === "/model.glb") {
    send(file, "model/gltf-binary");
  } else if (request.url.startsWith("/three/") && !request.url.includes("..")) {
    const path = join(packages, "node_modules", request.url);
    if (existsSync(path)) send(path, "text/javascript");
    else response.writeHead(404).end();
  } else {
    response.writeHead(204).end();
  }
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
});
let failures = 0;
try {
  const tab = await browser.newPage({ viewport: { width: 640, height: 640 } });
  tab.on("console", (m) => {
    if (m.type() === "error") { failures++; console.log(`console: ${m.text()}`); }
  });
  tab.on("pageerror", (e) => { failures++; console.log(`page: ${e.message}`); });
  await tab.goto(`http://127.0.0.1:${server.address().port}/`);
  await tab.waitForFunction(() => window.ready, null, { timeout: 120000 });
  console.log("size (x, y, z), metres:", (await tab.evaluate(() => window.size)).map((v) => v.toFixed(4)).join(" "));
  mkdirSync(out, { recursive: true });
  const sides = { front: [0, 0.2, 1], right: [1, 0.2, 0], back: [0, 0.2, -1], left: [-1, 0.2, 0], top: [0.05, 1, 0.05], bottom: [0.05, -1, 0.05] };
  for (const [name, direction] of Object.entries(sides)) {
    const { drawn, black } = await tab.evaluate((d) => window.look(d), direction);
    await tab.screenshot({ path: join(out, `${name}.png`) });
    console.log(`${name}: ${(100 * drawn).toFixed(1)} % of the picture, ${black} black pixels`);
    if (drawn < 0.02) failures++;
  }
} finally {
  await browser.close();
  server.close();
}
process.exit(failures > 0 ? 1 : 0);

// The report's 3-D view: one GLB, lit without textures from the network, turned with the mouse or a finger.
//
// The page gives the model as base64 in <script id="model" type="model/gltf-binary"> and a <canvas id="view">. When
// the first frame is on the canvas, <html data-viewer> says "drawn" (or "failed", with the reason in #view-note).
import {
  AmbientLight, Box3, CanvasTexture, Color, ConeGeometry, CylinderGeometry, DirectionalLight, GridHelper, Group,
  HemisphereLight, Mesh, MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Scene, Sprite, SpriteMaterial,
  SRGBColorSpace, Vector3, WebGLRenderer,
} from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

function bytes(base64) {
  const text = atob(base64.trim());
  const out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out.buffer;
}

function fail(reason) {
  document.getElementById("view-note").textContent = `The model can't be shown here: ${reason}`;
  document.getElementById("view-note").hidden = false;
  document.getElementById("viewer").classList.add("off");
  document.documentElement.dataset.viewer = "failed";
}

// The axes of the object frame, coloured as in the overlays and not hidden inside the object. Lines would be one pixel
// wide in WebGL.
function arrows(length) {
  const group = new Group();
  [["x", "#f04848"], ["y", "#3cc860"], ["z", "#4a86ff"]].forEach(([name, color], i) => {
    const material = new MeshBasicMaterial({ color, depthTest: false, transparent: true });
    const shaft = new Mesh(new CylinderGeometry(0.012, 0.012, 0.9, 12).translate(0, 0.45, 0), material);
    const tip = new Mesh(new ConeGeometry(0.035, 0.12, 16).translate(0, 0.94, 0), material);
    const letter = label(name, color);
    letter.position.y = 1.12;
    const arrow = new Group().add(shaft, tip, letter);
    arrow.traverse((part) => { part.renderOrder = 1; });
    // A cylinder stands along y.
    if (i === 0) arrow.rotation.z = -Math.PI / 2;
    if (i === 2) arrow.rotation.x = Math.PI / 2;
    group.add(arrow);
  });
  group.scale.setScalar(length);
  return group;
}

function label(text, color) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const pen = canvas.getContext("2d");
  pen.font = "600 48px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillStyle = color;
  pen.fillText(text, 32, 32);
  const map = new CanvasTexture(canvas);
  map.colorSpace = SRGBColorSpace;
  const sprite = new Sprite(new SpriteMaterial({ map, depthTest: false }));
  sprite.scale.setScalar(0.22);
  return sprite;
}

async function start() {
  const source = document.getElementById("model");
  if (!source) return;
  const canvas = document.getElementById("view");
  let renderer;
  try {
    renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
  } catch {
    return fail("this browser has WebGL switched off.");
  }
  renderer.outputColorSpace = SRGBColorSpace;
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));

  const gltf = await new GLTFLoader().parseAsync(bytes(source.textContent), "");
  const scene = new Scene();
  const model = new Group();
  model.add(gltf.scene);
  scene.add(model);

  // The object frame has the first camera's axes: y down, z away. Turned so that the first view is upright.
  if (source.dataset.up !== "y") model.rotation.x = Math.PI;
  model.updateMatrixWorld(true);
  const box = new Box3().setFromObject(model);
  const size = box.getSize(new Vector3()).length() || 1;
  const centre = box.getCenter(new Vector3());

  const grid = new GridHelper(Math.ceil(size * 10 * 1.6) / 10, Math.ceil(size * 10 * 1.6) * 2, 0x888888, 0x888888);
  grid.position.set(centre.x, box.min.y, centre.z);
  grid.material.transparent = true;
  grid.material.opacity = 0.25;
  scene.add(grid);
  const axes = arrows(size * 0.3);
  // In the frame of the file's own coordinates, inside the node that turns them upright.
  (gltf.scene.children[0] ?? model).add(axes);
  axes.visible = false;

  scene.add(new HemisphereLight(0xffffff, 0x8d8d95, 1.7), new AmbientLight(0xffffff, 0.5));
  const key = new DirectionalLight(0xffffff, 1.6);
  const camera = new PerspectiveCamera(35, 1, size / 100, size * 20);
  camera.position.copy(centre).add(new Vector3(0.25, 0.25, 1).normalize().multiplyScalar(size * 1.55));
  camera.add(key);
  scene.add(camera);
  const home = camera.position.clone();

  const controls = new OrbitControls(camera, canvas);
  controls.target.copy(centre);
  controls.enableDamping = true;
  controls.autoRotateSpeed = 1.6;
  controls.update();

  const meshes = [];
  gltf.scene.traverse((node) => { if (node.isMesh) meshes.push(node); });
  const original = new Map(meshes.map((m) => [m, m.material]));
  const clay = new MeshStandardMaterial({ color: new Color(0xb9bcc4), roughness: 0.85, metalness: 0 });
  for (const mesh of meshes) {
    if (!mesh.geometry.attributes.normal) mesh.geometry.computeVertexNormals();
  }

  let dirty = true;
  const ask = () => { dirty = true; };
  controls.addEventListener("change", ask);
  new ResizeObserver(() => resize()).observe(canvas.parentElement);
  function resize() {
    const { clientWidth: w, clientHeight: h } = canvas.parentElement;
    if (!w || !h) return;
    renderer.setSize(w, h, false);
    camera.aspect = w / h;
    camera.updateProjectionMatrix();
    dirty = true;
  }
  resize();

  function draw() {
    renderer.render(scene, camera);
    dirty = false;
  }
  draw();
  document.documentElement.dataset.viewer = "drawn";

  const on = (id, action) => document.getElementById(id)?.addEventListener("click", (event) => {
    const pressed = event.currentTarget.getAttribute("aria-pressed") !== "true";
    if (event.currentTarget.hasAttribute("aria-pressed")) event.currentTarget.setAttribute("aria-pressed", pressed);
    action(pressed);
    ask();
  });
  on("view-clay", (pressed) => meshes.forEach((m) => { m.material = pressed ? clay : original.get(m); }));
  on("view-wire", (pressed) => meshes.forEach((m) => { clay.wireframe = pressed; original.get(m).wireframe = pressed; }));
  on("view-axes", (pressed) => { axes.visible = pressed; });
  on("view-turn", (pressed) => { controls.autoRotate = pressed; });
  on("view-home", () => {
    // What is left of the last swing would move the camera on from here.
    controls.enableDamping = false;
    controls.update();
    controls.enableDamping = true;
    camera.position.copy(home);
    controls.target.copy(centre);
    controls.update();
  });

  renderer.setAnimationLoop(() => {
    controls.update();
    if (dirty || controls.autoRotate) draw();
  });
}

start().catch((error) => fail(String(error?.message ?? error)));

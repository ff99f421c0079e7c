// The viewer of one page: camera, drawing, controls. Poses are those of gsopt: +x right, +y down, +z forward.
"use strict";
const NEAR = 0.01;
const STILL_MS = 160, SLOW_MS = 40, FAST_MS = 22, LEAST_QUALITY = 0.3, MOST_RATIO = 2;

const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => a.map(x => x / Math.hypot(...a));
// Rodrigues: v turned by an angle about a unit axis.
const turned = (v, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle), k = dot(axis, v) * (1 - c), n = cross(axis, v);
  return v.map((x, i) => x * c + n[i] * s + axis[i] * k);
};

// A pose: eye and the camera's axes in the world. A lens: focal lengths, principal point and size in px.
class Camera {
  constructor(view) {
    this.eye = view.eye;
    this.right = view.axes.slice(0, 3);
    this.down = view.axes.slice(3, 6);
    this.forward = view.axes.slice(6, 9);
    this.lens = view.lens;
  }
  between(other, share) {
    const mix = (a, b) => add(a.map(x => x * (1 - share)), b, share);
    const forward = unit(mix(this.forward, other.forward));
    const right = unit(cross(mix(this.down, other.down), forward));
    return new Camera({ eye: mix(this.eye, other.eye), axes: [...right, ...cross(forward, right), ...forward],
                        lens: mix(this.lens, other.lens) });
  }
  orbit(target, axis, angle) {
    this.eye = add(target, turned(add(this.eye, target, -1), axis, angle));
    for (const name of ["right", "down", "forward"]) this[name] = turned(this[name], axis, angle);
  }
  // The lens on a canvas: the whole image fits, in the middle.
  on(width, height) {
    const [fx, fy, cx, cy, w, h] = this.lens, s = Math.min(width / w, height / h);
    return [fx * s, fy * s, width / 2 + (cx - w / 2) * s, height / 2 + (cy - h / 2) * s];
  }
  // Turned to the middle of its image, where files of camera paths have the principal point.
  centered() {
    const [fx, fy, cx, cy, w, h] = this.lens, x = (w / 2 - cx) / fx, y = (h / 2 - cy) / fy;
    const forward = unit(add(add(this.forward, this.right, x), this.down, y)), f = fy * Math.hypot(1, x, y);
    const right = unit(cross(this.down, forward));
    return new Camera({ eye: [...this.eye], axes: [...right, ...cross(forward, right), ...forward],
                        lens: [f, f, w / 2, h / 2, w, h] });
  }
  depthRow() { return [...this.forward, -dot(this.forward, this.eye)]; }
  camFromWorld() {  // column by column
    const rows = [this.right, this.down, this.forward], t = rows.map(row => -dot(row, this.eye));
    return [0, 1, 2].flatMap(j => [...rows.map(row => row[j]), 0]).concat(t, 1);
  }
}

class Viewer {
  constructor(root) {
    this.root = root;
    this.part = name => root.querySelector(`[data-part=${name}]`);
    const scene = this.scene = JSON.parse(this.part("scene").textContent);
    this.views = scene.views.map(view => new Camera(view));
    this.turntable = { cameras: scene.path.map(view => new Camera(view)), seconds: scene.pathSeconds };
    this.look = { scale: 1, degree: scene.degree, background: scene.background, cameras: false };
    this.renderer = new Renderer(this.part("canvas"), scene);
    this.renderer.setWires(this.views.slice(0, scene.inputs), scene.cameraSize);
    this.quality = 1;
    this.moved = this.sortedFor = 0;
    this.goHome();
    this.readAddress();
    this.startWorker();
    new ResizeObserver(() => this.fit()).observe(this.part("canvas"));
    connectControls(this);
    this.fit();
  }
  readAddress() {
    const wish = new URLSearchParams(location.hash.slice(1)), view = Number(wish.get("view"));
    if (wish.has("plain")) this.root.classList.add("plain");
    if (view > 0 && view <= this.views.length) this.showView(Math.round(view) - 1);
  }
  startWorker() {
    const source = new Blob([this.part("worker").textContent], { type: "text/javascript" });
    this.worker = new Worker(URL.createObjectURL(source));
    this.worker.onmessage = ({ data }) => this.receive(data);
    const packed = this.part("splats"), { count, colorStride } = this.scene;
    const texels = count => { const [w, h] = this.renderer.extent(count); return w * h; };
    this.worker.postMessage({ base64: packed.textContent, scene: this.scene, geometryTexels: texels(2 * count),
                              colorTexels: texels(colorStride * count), orderTexels: texels(count) });
    packed.textContent = "";
  }
  receive({ error, shapes, tints, order, n, point }) {
    if (error) return this.say(error);
    if (point !== undefined) return this.measure.receive(point);
    if (shapes) {
      this.renderer.upload(shapes, tints);
      this.ready = true;
      this.say("");
    } else {
      this.sorting = false;
      this.renderer.reorder(order, n);
      this.sortedFor = this.asked;
    }
    this.sort();
    this.redraw();
  }
  sort() {
    if (!this.ready || this.sorting || this.sortedFor === this.moved) return;
    this.sorting = true;
    this.asked = this.moved;
    this.worker.postMessage({ depthRow: this.camera.depthRow(), near: NEAR });
  }
  say(text) {
    this.part("status").textContent = text;
    this.part("status").hidden = !text;
  }
  fit() {
    const canvas = this.part("canvas"), ratio = Math.min(devicePixelRatio || 1, MOST_RATIO);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    this.redraw();
  }
  goHome() {
    this.showView(0);
    this.camera = new Camera(this.scene.home);
  }
  showView(number) {
    const count = this.views.length;
    this.number = (number % count + count) % count;
    this.camera = new Camera(this.scene.views[this.number]);
    this.part("name").textContent = this.scene.views[this.number].name;
    this.move();
  }
  move() {
    ++this.moved;
    this.lastMove = performance.now();
    this.sort();
    this.redraw();
  }
  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(now => { this.waiting = false; this.frame(now); });
  }
  // One frame: coarser while the camera moves on a slow machine, whole when it rests.
  frame(now) {
    if (!this.ready || this.broken) return;
    if (this.playing) this.advance(now);
    const moving = performance.now() - this.lastMove < STILL_MS;
    if (moving && this.lastFrame) this.adapt(now - this.lastFrame);
    this.lastFrame = moving ? now : 0;
    this.renderer.draw(this.camera, this.look, moving ? this.quality : 1);
    this.measure.draw(this.camera);
    if (moving || this.playing) this.redraw();
    else if (this.sortedFor === this.moved) this.root.dataset.drawn = this.number + 1;
  }
  adapt(ms) {
    this.pace = 0.8 * (this.pace || ms) + 0.2 * ms;
    if (this.pace > SLOW_MS) this.quality = Math.max(LEAST_QUALITY, 0.93 * this.quality);
    else if (this.pace < FAST_MS) this.quality = Math.min(1, 1.03 * this.quality);
  }
  play(on) {
    this.playing = on;
    this.started = performance.now();
    this.part("play").textContent = on ? "Stop" : "Play";
    this.redraw();
  }
  advance(now) {
    const { cameras, seconds } = this.course, count = cameras.length;
    const at = Math.max(0, now - this.started) / 1000 / seconds * count, i = Math.floor(at) % count;
    this.camera = cameras[i].between(cameras[(i + 1) % count], at % 1);
    this.move();
  }
}

// Drag turns about the target, drag with the right button or two fingers moves, the wheel or a pinch approaches.
function connectControls(viewer) {
  const canvas = viewer.part("canvas"), fingers = new Map();
  const target = [...viewer.scene.target], up = viewer.scene.up;
  const distance = () => Math.max(1e-6, dot(add(target, viewer.camera.eye, -1), viewer.camera.forward));
  const turn = (dx, dy) => {
    viewer.camera.orbit(target, up, 2 * Math.PI * dx / canvas.clientWidth);
    viewer.camera.orbit(target, viewer.camera.right, -Math.PI * dy / canvas.clientHeight);
  };
  const shift = (dx, dy) => {
    const step = distance() / viewer.camera.on(canvas.clientWidth, canvas.clientHeight)[0];
    for (const place of ["eye", "target"]) {
      const from = place === "eye" ? viewer.camera.eye : target;
      const to = add(add(from, viewer.camera.right, -dx * step), viewer.camera.down, -dy * step);
      if (place === "eye") viewer.camera.eye = to; else target.splice(0, 3, ...to);
    }
  };
  const approach = factor => {
    viewer.camera.eye = add(viewer.camera.eye, viewer.camera.forward, distance() * (1 - factor));
  };
  const moved = () => { if (viewer.playing) viewer.play(false); viewer.move(); };
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const span = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    const wide = fingers.size === 2 ? span() : 0, many = fingers.size;
    const dx = (event.clientX - before[0]) / many, dy = (event.clientY - before[1]) / many;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (wide) approach(wide / Math.max(1, span()));
    if (wide || event.buttons & 6 || event.shiftKey) shift(dx, dy); else turn(dx, dy);
    moved();
  });
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    approach(Math.exp(0.001 * Math.max(-200, Math.min(200, event.deltaY))));
    moved();
  }, { passive: false });
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  const leave = () => { if (viewer.playing) viewer.play(false); target.splice(0, 3, ...viewer.scene.target); };
  const step = by => { leave(); viewer.showView(viewer.number + by); };
  const home = () => { leave(); viewer.goHome(); viewer.move(); };
  canvas.addEventListener("keydown", event => {
    const action = { ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: home,
                     k: () => viewer.keyframes.add(), " ": () => viewer.play(!viewer.playing) }[event.key];
    if (action) { event.preventDefault(); action(); }
  });
  viewer.part("before").onclick = () => step(-1);
  viewer.part("after").onclick = () => step(1);
  viewer.part("home").onclick = home;
  viewer.part("play").onclick = () => viewer.play(!viewer.playing);
  viewer.keyframes = new Keyframes(viewer);
  viewer.measure = new Measure(viewer);
  connectLook(viewer);
}

function connectLook(viewer) {
  const set = (name, value) => { viewer.look[name] = value; viewer.redraw(); };
  const hex = viewer.look.background.map(x => Math.round(255 * x).toString(16).padStart(2, "0")).join("");
  viewer.part("scale").oninput = event => set("scale", Number(event.target.value));
  viewer.part("degree").max = viewer.part("degree").value = viewer.scene.degree;
  viewer.part("degree").oninput = event => set("degree", Number(event.target.value));
  viewer.part("background").value = `#${hex}`;
  viewer.part("background").oninput = ({ target }) =>
    set("background", [1, 3, 5].map(i => parseInt(target.value.slice(i, i + 2), 16) / 255));
  viewer.part("cameras").onchange = event => set("cameras", event.target.checked);
  viewer.part("canvas").addEventListener("webglcontextlost", () => {
    viewer.broken = true;
    viewer.say("The graphics driver gave up. Load the page again.");
  });
}

for (const root of document.querySelectorAll(".gsopt-viewer")) {
  try { new Viewer(root); } catch (error) {
    const status = root.querySelector("[data-part=status]");
    status.textContent = error.message;
    status.hidden = false;
  }
}

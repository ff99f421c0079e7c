// Two points that the user picks: their distance, and the line that gives a run its scale.
"use strict";
const CLICK_PX = 4, METERS = { km: 1000, m: 1, cm: 0.01, mm: 0.001, in: 0.0254, ft: 0.3048 };

const lengthText = meters => {
  const unit = meters >= 1000 ? "km" : meters >= 1 ? "m" : meters >= 0.01 ? "cm" : "mm";
  return `${Number((meters / METERS[unit]).toPrecision(4))} ${unit}`;
};

class Measure {
  constructor(viewer) {
    this.viewer = viewer;
    this.points = [];
    this.scale = viewer.scene.metersPerUnit;
    const canvas = viewer.part("canvas");
    viewer.part("measure").onchange = () => { this.points = []; this.show(); };
    viewer.part("known").oninput = () => this.show();
    viewer.part("command").onclick = event => event.target.select();
    canvas.addEventListener("pointerdown", ({ clientX, clientY }) => { this.down = [clientX, clientY]; });
    canvas.addEventListener("pointerup", event => {
      const still = this.down && Math.hypot(event.clientX - this.down[0], event.clientY - this.down[1]) < CLICK_PX;
      if (viewer.part("measure").checked && still && event.button === 0) this.pick(event.offsetX, event.offsetY);
    });
    this.show();
  }
  pick(x, y) {
    const { viewer } = this, { camera } = viewer, { clientWidth, clientHeight, width, height } = viewer.part("canvas");
    const [fx, fy, cx, cy] = camera.on(clientWidth, clientHeight);
    const ray = add(add(camera.forward, camera.right, (x - cx) / fx), camera.down, (y - cy) / fy);
    viewer.worker.postMessage({ pick: { eye: camera.eye, ray, depthRow: camera.depthRow(), near: NEAR,
                                        blur: EPS2D / camera.on(width, height)[0] ** 2 } });
  }
  receive(point) {
    if (point) this.points = [...this.points.slice(this.points.length === 2 ? 2 : 0), point];
    this.show(point ? "" : "There is no surface.");
  }
  units() { return Math.hypot(...add(this.points[1], this.points[0], -1)); }
  // Meters between the points that the user knows; 0 when there is no such length.
  known() {
    const [, number, unit] = /^\s*(\d*\.?\d+)\s*([a-z]+)\s*$/i.exec(this.viewer.part("known").value) || [];
    return Number(number) * METERS[(unit || "").toLowerCase()] || 0;
  }
  show(complaint = "") {
    const { viewer, points } = this, on = viewer.part("measure").checked, both = points.length === 2;
    if (both && this.units() > 0 && this.known()) this.scale = this.known() / this.units();
    this.text = !both ? "" : this.scale ? lengthText(this.scale * this.units()) : `${this.units().toPrecision(4)} units`;
    viewer.part("length").textContent = on ? complaint || this.text || `Click ${points.length ? "another" : "two"} point${
      points.length ? "" : "s"}.` : "";
    viewer.part("true").hidden = viewer.part("command").hidden = !on || !both;
    const [from, to] = points.map(point => point.map(x => x.toPrecision(5)).join(","));
    viewer.part("command").value = `gsopt measure RUN --from=${from} --to=${to} --unit-length ${
      this.known() ? viewer.part("known").value.replace(/\s/g, "") : "0.25m"}`;
    this.draw(viewer.camera);
  }
  // The marks over the image.
  draw(camera) {
    const { clientWidth, clientHeight } = this.viewer.part("canvas"), marks = this.viewer.part("marks");
    const [fx, fy, cx, cy] = camera.on(clientWidth, clientHeight), [line, a, b, text] = marks.children;
    const seen = this.points.map(point => {
      const t = add(point, camera.eye, -1), z = dot(t, camera.forward);
      return z > NEAR ? [fx * dot(t, camera.right) / z + cx, fy * dot(t, camera.down) / z + cy] : null;
    });
    const place = (element, values) => { for (const name in values) element.setAttribute(name, values[name]); };
    [a, b].forEach((circle, i) => place(circle, seen[i] ? { cx: seen[i][0], cy: seen[i][1], r: 5 } : { r: 0 }));
    const [p, q] = seen, both = p && q;
    place(line, both ? { x1: p[0], y1: p[1], x2: q[0], y2: q[1] } : { x1: 0, y1: 0, x2: 0, y2: 0 });
    if (both) place(text, { x: (p[0] + q[0]) / 2, y: (p[1] + q[1]) / 2 - 8 });
    text.textContent = both ? this.text : "";
  }
}

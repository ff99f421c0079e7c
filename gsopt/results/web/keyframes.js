// Keyframes: cameras that the user adds, the path through them, and its file in nerfstudio's JSON.
"use strict";
const SEGMENT_SECONDS = 2, PATH_FPS = 24;

// A Catmull-Rom spline through the eyes, of which the first and the last stand twice; axes and lens are mixed.
function along(keyframes, at) {
  const last = keyframes.length - 1, i = Math.min(Math.floor(at), last - 1), t = at - i;
  const [a, b, c, d] = [-1, 0, 1, 2].map(step => keyframes[Math.max(0, Math.min(last, i + step))].eye);
  const camera = keyframes[i].between(keyframes[i + 1], t);
  camera.eye = b.map((p, k) => p + 0.5 * t * (c[k] - a[k]
    + t * (2 * a[k] - 5 * p + 4 * c[k] - d[k] + t * (3 * (p - c[k]) + d[k] - a[k]))));
  return camera;
}

class Keyframes {
  constructor(viewer) {
    this.viewer = viewer;
    this.cameras = [];
    viewer.part("keyframe").onclick = () => this.add();
    viewer.part("undo").onclick = () => this.remove();
    viewer.part("save").onclick = () => this.save();
    this.show();
  }
  add() {
    this.cameras.push(this.viewer.camera.centered());
    this.show();
  }
  remove() {
    this.cameras.pop();
    this.show();
  }
  show() {
    const { viewer, cameras } = this, count = cameras.length;
    for (const name of ["undo", "save"]) viewer.part(name).disabled = count < (name === "save" ? 2 : 1);
    viewer.part("path").textContent = count ? `${count} keyframe${count > 1 ? "s" : ""}, ${this.seconds()} s` : "";
    if (viewer.playing) viewer.play(false);
    viewer.course = count > 1 ? { cameras: this.path(), seconds: this.seconds() } : viewer.turntable;
    viewer.part("play").hidden = viewer.course.cameras.length < 2;
  }
  seconds() { return SEGMENT_SECONDS * (this.cameras.length - 1); }
  path() {
    const steps = PATH_FPS * this.seconds(), segments = this.cameras.length - 1;
    return Array.from({ length: steps + 1 }, (_, i) => along(this.cameras, i / steps * segments));
  }
  // As `gsopt render --path` reads it: world from camera in OpenGL axes, row by row, in the frame of the dataset.
  text() {
    const [, , , , width, height] = this.cameras[0].lens.map(Math.round), { origin } = this.viewer.scene;
    const entries = this.path().map(({ eye, right, down, forward, lens }) => ({
      camera_to_world: [0, 1, 2].flatMap(i => [right[i], -down[i], -forward[i], eye[i] + origin[i]]).concat(0, 0, 0, 1),
      fov: 2 * Math.atan(lens[5] / 2 / lens[1]) * 180 / Math.PI, aspect: width / height }));
    return JSON.stringify({ camera_type: "perspective", render_width: width, render_height: height, fps: PATH_FPS,
                            seconds: this.seconds(), camera_path: entries, keyframes: [] });
  }
  save() {
    const link = document.createElement("a"), address = URL.createObjectURL(new Blob([this.text()]));
    link.href = address;
    link.download = "camera-path.json";
    link.click();
    setTimeout(() => URL.revokeObjectURL(address), 60000);
  }
}

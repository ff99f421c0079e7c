// Draws splats with WebGL 2, in the order that the worker found, and the input cameras as wires.
"use strict";
const EPS2D = 0.3, VIEW_MARGIN = 0.3;

// Vertices of one instance, BATCH squares of two triangles: graphics drivers are slow where each square is an instance of its
// own, the software renderer by a factor of a hundred.
const cornerNumbers = () => {
  const numbers = new Uint16Array(6 * BATCH);
  for (let i = 0; i < BATCH; ++i) [0, 1, 2, 2, 1, 3].forEach((corner, k) => { numbers[6 * i + k] = 4 * i + corner; });
  return numbers;
};

class Renderer {
  constructor(canvas, scene) {
    this.canvas = canvas;
    this.scene = scene;
    const gl = this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2. Turn on its hardware acceleration, or take another one.");
    this.half = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.splats = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.screen = this.program(SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.wires = this.program(WIRE_VERTEX, WIRE_FRAGMENT);
    this.corners = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, cornerNumbers(), gl.STATIC_DRAW);
    this.wire = gl.createBuffer();
    this.image = gl.createTexture();
    this.frame = gl.createFramebuffer();
    this.n = this.width = this.height = 0;
  }
  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const uniforms = { program };
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
      const name = gl.getActiveUniform(program, i).name;
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return uniforms;
  }
  // Width and height of a texture with room for so many texels.
  extent(texels) {
    const width = Math.min(this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE), 4096);
    return [width, Math.max(1, Math.ceil(texels / width))];
  }
  texture(slot, internal, format, type, data, [width, height]) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + slot);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  }
  upload(shapes, tints) {
    const gl = this.gl;
    this.texture(1, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, shapes, this.extent(2 * this.scene.count));
    this.texture(2, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, tints, this.extent(this.scene.colorStride * this.scene.count));
    this.texture(3, gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, null, this.extent(this.scene.count));
  }
  // The first n of `order`, a whole texture, are drawn.
  reorder(order, n) {
    const gl = this.gl, [width] = this.extent(this.scene.count), rows = Math.ceil(n / width);
    gl.activeTexture(gl.TEXTURE3);
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    this.n = n;
  }
  // The image between splats and screen: half floats, so that thousands of thin layers add up.
  resize(width, height) {
    const gl = this.gl;
    if (width === this.width && height === this.height) return;
    [this.width, this.height] = [width, height];
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    if (this.half) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
  }
  draw(camera, look, quality) {
    const gl = this.gl, { width, height } = this.canvas;
    this.resize(Math.max(1, Math.round(width * quality)), Math.max(1, Math.round(height * quality)));
    this.drawSplats(camera, look);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    gl.useProgram(this.screen.program);
    gl.uniform1i(this.screen.image, 0);
    gl.uniform3fv(this.screen.background, look.background);
    gl.uniform2f(this.screen.ratio, this.width / width, this.height / height);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    if (look.cameras) this.drawWires(camera);
  }
  drawSplats(camera, look) {
    const gl = this.gl, u = this.splats, [fx, fy, cx, cy] = camera.on(this.width, this.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.viewport(0, 0, this.width, this.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!this.n) return;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(u.program);
    gl.uniform1i(u.shapes, 1);
    gl.uniform1i(u.tints, 2);
    gl.uniform1i(u.order, 3);
    gl.uniform1i(u.drawn, this.n);
    gl.uniformMatrix4fv(u.camFromWorld, false, camera.camFromWorld());
    gl.uniform3fv(u.center, camera.eye);
    gl.uniform4f(u.intrinsics, fx, fy, cx, cy);
    const mx = VIEW_MARGIN * 0.5 * this.width / fx, my = VIEW_MARGIN * 0.5 * this.height / fy;
    gl.uniform4f(u.bounds, -cx / fx - mx, -cy / fy - my, (this.width - cx) / fx + mx, (this.height - cy) / fy + my);
    gl.uniform2f(u.size, this.width, this.height);
    gl.uniform1f(u.scale, look.scale);
    gl.uniform1f(u.eps2d, EPS2D);
    gl.uniform1i(u.degree, Math.min(look.degree, this.scene.degree));
    gl.uniform1i(u.stride, this.scene.colorStride);
    gl.uniform1i(u.antialiased, this.scene.antialiased ? 1 : 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.n / BATCH));
  }
  // Pyramids of the input cameras.
  setWires(cameras, depth) {
    const points = cameras.flatMap(camera => {
      const [fx, fy, cx, cy, w, h] = camera.lens;
      const corner = (x, y) => [0, 1, 2].map(i => camera.eye[i] + depth * (camera.forward[i]
        + (x - cx) / fx * camera.right[i] + (y - cy) / fy * camera.down[i]));
      const corners = [corner(0, 0), corner(w, 0), corner(w, h), corner(0, h)];
      return corners.flatMap((c, i) => [camera.eye, c, c, corners[(i + 1) % 4]]);
    });
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.wire);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, new Float32Array(points.flat()), this.gl.STATIC_DRAW);
    this.wireCount = points.length;
  }
  drawWires(camera) {
    const gl = this.gl, u = this.wires, { width, height } = this.canvas;
    gl.useProgram(u.program);
    gl.uniformMatrix4fv(u.camFromWorld, false, camera.camFromWorld());
    gl.uniform4f(u.intrinsics, ...camera.on(width, height));
    gl.uniform2f(u.size, width, height);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.wire);
    const point = gl.getAttribLocation(u.program, "point");
    gl.enableVertexAttribArray(point);
    gl.vertexAttribPointer(point, 3, gl.FLOAT, false, 0, 0);
    gl.drawArrays(gl.LINES, 0, this.wireCount);
    gl.disableVertexAttribArray(point);
  }
}

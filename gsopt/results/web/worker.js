// Unpacks the splats once, then sorts them for each view: farthest first.
// The payload is a deflated sequence of byte planes; gsopt/results/web/payload.py writes it and names every plane.
"use strict";
let means, count, orderTexels, scaleCodes, turnCodes, opacityCodes;

function decoded(base64) {
  const letters = atob(base64), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; ++i) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// 24-bit numbers: three planes of differences to the splat before, one after the other for x, y and z.
function positions(planes, unit) {
  const out = new Float32Array(3 * count);
  for (let axis = 0; axis < 3; ++axis) {
    const low = planes.next(), middle = planes.next(), high = planes.next();
    let code = 0;
    for (let i = 0; i < count; ++i) {
      code = (code + (low[i] | middle[i] << 8 | high[i] << 16)) & 0xffffff;
      out[3 * i + axis] = (code << 8 >> 8) * unit;
    }
  }
  return out;
}

// Two texels of four uint32 per splat: x, y, z as bits of float32, scales; rotation, three unused.
function geometry(planes, texels) {
  const out = new Uint32Array(4 * texels), bits = new Uint32Array(means.buffer);
  const words = [[], []].map((_, i) => Array.from({ length: i ? 4 : 3 }, () => planes.next()));
  const [s, q] = [scaleCodes, turnCodes] = words;
  for (let i = 0; i < count; ++i) {
    out[8 * i] = bits[3 * i];
    out[8 * i + 1] = bits[3 * i + 1];
    out[8 * i + 2] = bits[3 * i + 2];
    out[8 * i + 3] = s[0][i] | s[1][i] << 8 | s[2][i] << 16;
    out[8 * i + 4] = q[0][i] | q[1][i] << 8 | q[2][i] << 16 | q[3][i] << 24;
  }
  return out;
}

// `stride` texels of four bytes per splat: base color and opacity, then one coefficient of the harmonics each.
function colors(planes, stride, texels) {
  const out = new Uint8Array(4 * texels);
  for (let k = 0; k < stride; ++k)
    for (let channel = 0; channel < (k ? 3 : 4); ++channel) {
      const plane = planes.next();
      if (channel === 3) opacityCodes = plane;
      for (let i = 0; i < count; ++i) out[4 * (stride * i + k) + channel] = plane[i];
    }
  return out;
}

async function unpack({ base64, scene, geometryTexels, colorTexels, orderTexels: texels }) {
  const plain = await inflated(decoded(base64));
  [count, orderTexels] = [scene.count, texels];
  let at = 0;
  const planes = { next: () => plain.subarray(at, at += count) };
  means = positions(planes, 2 ** -scene.fractionBits);
  const shapes = geometry(planes, geometryTexels), tints = colors(planes, scene.colorStride, colorTexels);
  postMessage({ shapes, tints }, [shapes.buffer, tints.buffer]);
}

// Stable radix sort of the depths' bits; those of positive floats are in order. Splats behind the near plane are left out.
// The n numbers begin an array that fills a texture.
function sorted([a, b, c, d], near) {
  const keys = new Float32Array(count), bits = new Uint32Array(keys.buffer);
  let order = new Uint32Array(orderTexels), n = 0;
  for (let i = 0; i < count; ++i) {
    const z = a * means[3 * i] + b * means[3 * i + 1] + c * means[3 * i + 2] + d;
    if (z > near) { keys[i] = z; order[n++] = i; }
  }
  let next = new Uint32Array(orderTexels);
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (let i = 0; i < n; ++i) ++starts[(~bits[order[i]] >>> shift & 0xffff) + 1];
    for (let i = 0; i < 65536; ++i) starts[i + 1] += starts[i];
    for (let i = 0; i < n; ++i) next[starts[~bits[order[i]] >>> shift & 0xffff]++] = order[i];
    [order, next] = [next, order];
  }
  return { order, n };
}

// Columns of the rotation of a splat: the codes are those of `quaternion` in shaders.js.
function axes(i) {
  let code = turnCodes[0][i] | turnCodes[1][i] << 8 | turnCodes[2][i] << 16 | turnCodes[3][i] << 24;
  const largest = code >>> 30, v = [0, 0, 0, 0];
  for (let k = 3; k >= 0; --k) {
    if (k === largest) continue;
    v[k] = (code >>> 9 & 1 ? -1 : 1) * (code & 511) * Math.SQRT1_2 / 511;
    code >>>= 10;
  }
  v[largest] = Math.sqrt(Math.max(0, 1 - v.reduce((sum, x) => sum + x * x, 0)));
  const [x, y, z, w] = v;
  return [[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
          [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
          [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]];
}

// The point of a ray at which half of the light is gone, or null. A splat stands where its density along the ray is
// greatest; the blur of the image model makes it wider by so many pixels (gsopt/results/picking.py does the same).
function picked({ eye, ray, depthRow, near, blur }) {
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2], length2 = dot(ray, ray), hits = [];
  for (let i = 0; i < count; ++i) {
    const from = [eye[0] - means[3 * i], eye[1] - means[3 * i + 1], eye[2] - means[3 * i + 2]];
    const depth = depthRow[3] + depthRow[0] * means[3 * i] + depthRow[1] * means[3 * i + 1] + depthRow[2] * means[3 * i + 2];
    if (depth <= near) continue;
    const scales = scaleCodes.map(plane => Math.exp(plane[i] / 16 - 10)), along = dot(from, ray) / length2;
    const aside = dot(from, from) - along * along * length2, extra = blur * depth * depth;
    if (aside > 12 * (Math.max(...scales) ** 2 + extra)) continue;
    const turn = axes(i), widths = scales.map(scale => Math.sqrt(scale * scale + extra));
    const o = turn.map((axis, k) => dot(axis, from) / widths[k]), d = turn.map((axis, k) => dot(axis, ray) / widths[k]);
    const at = -dot(o, d) / dot(d, d), power = dot(o, o) - at * at * dot(d, d);
    const alpha = opacityCodes[i] / 255 * Math.exp(-0.5 * power);
    if (at > near && alpha >= 1 / 255) hits.push([at, Math.min(alpha, 0.99)]);
  }
  let left = 1;
  for (const [at, alpha] of hits.sort((a, b) => a[0] - b[0]))
    if ((left *= 1 - alpha) <= 0.5) return ray.map((x, k) => eye[k] + at * x);
  return null;
}

onmessage = ({ data }) => {
  if (data.pick) postMessage({ point: picked(data.pick) });
  else if (data.base64) unpack(data).catch(error => postMessage({ error: String(error) }));
  else {
    const { order, n } = sorted(data.depthRow, data.near);
    postMessage({ order, n }, [order.buffer]);
  }
};

// Unpacks the splats once, then sorts them for each view: farthest first.
// The payload is a deflated sequence of byte planes; gsopt/results/web/payload.py writes it and names every plane.
"use strict";
let means, count;

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
  const [s, q] = words;
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
      for (let i = 0; i < count; ++i) out[4 * (stride * i + k) + channel] = plane[i];
    }
  return out;
}

async function unpack({ bytes, scene, geometryTexels, colorTexels }) {
  const plain = await inflated(bytes);
  count = scene.count;
  let at = 0;
  const planes = { next: () => plain.subarray(at, at += count) };
  means = positions(planes, 2 ** -scene.fractionBits);
  const shapes = geometry(planes, geometryTexels), tints = colors(planes, scene.colorStride, colorTexels);
  postMessage({ shapes, tints }, [shapes.buffer, tints.buffer]);
}

// Stable radix sort of the depths' bits; those of positive floats are in order. Splats behind the near plane are left out.
function sorted([a, b, c, d], near) {
  const keys = new Float32Array(count), bits = new Uint32Array(keys.buffer);
  let order = new Uint32Array(count), n = 0;
  for (let i = 0; i < count; ++i) {
    const z = a * means[3 * i] + b * means[3 * i + 1] + c * means[3 * i + 2] + d;
    if (z > near) { keys[i] = z; order[n++] = i; }
  }
  let next = new Uint32Array(n);
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (let i = 0; i < n; ++i) ++starts[(~bits[order[i]] >>> shift & 0xffff) + 1];
    for (let i = 0; i < 65536; ++i) starts[i + 1] += starts[i];
    for (let i = 0; i < n; ++i) next[starts[~bits[order[i]] >>> shift & 0xffff]++] = order[i];
    [order, next] = [next, order];
  }
  return order.slice(0, n);
}

onmessage = ({ data }) => {
  if (data.bytes) unpack(data).catch(error => postMessage({ error: String(error) }));
  else {
    const order = sorted(data.depthRow, data.near);
    postMessage({ order }, [order.buffer]);
  }
};

// The image model of docs/math.md (equations 1 to 9). Four vertices are a splat, BATCH splats are an instance.
"use strict";
const BATCH = 4096;
const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D shapes;
uniform sampler2D tints;
uniform usampler2D order;  // numbers of the splats, farthest first
uniform int drawn;         // how many of them
uniform mat4 camFromWorld;
uniform vec3 center;      // of the camera
uniform vec4 intrinsics;  // fx, fy, cx, cy in px
uniform vec4 bounds;      // of t_x/t_z and t_y/t_z inside the Jacobian
uniform vec2 size;        // of the image, px
uniform float scale;      // of every splat; 0 shows points
uniform float eps2d;
uniform int degree;
uniform int stride;
uniform bool antialiased;
out vec3 color;
out vec2 offset;
out float opacity;

const int BATCH = ${BATCH};
const float C0 = 0.28209479177387814, HALF = 0.7071067811865476;

uvec4 shape(int texel) { int w = textureSize(shapes, 0).x; return texelFetch(shapes, ivec2(texel % w, texel / w), 0); }
vec4 tint(int texel) { int w = textureSize(tints, 0).x; return texelFetch(tints, ivec2(texel % w, texel / w), 0) * 255.0; }

// Smallest three of x y z w: two bits name the largest, the others have a sign and nine bits each.
vec4 quaternion(uint code) {
  int largest = int(code >> 30u);
  vec4 q = vec4(0.0);
  for (int i = 3; i >= 0; --i) {
    if (i == largest) continue;
    float part = float(code & 511u) * (HALF / 511.0);
    q[i] = (code >> 9u & 1u) == 1u ? -part : part;
    code >>= 10u;
  }
  q[largest] = sqrt(max(0.0, 1.0 - dot(q, q)));
  return q;
}

mat3 rotation(vec4 q) {
  float x = q.x, y = q.y, z = q.z, w = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 band(int splat, int k) { return (tint(stride * splat + k).rgb - 128.0) / 128.0; }

vec3 seen(int splat, vec3 base, vec3 d) {
  float x = d.x, y = d.y, z = d.z;
  vec3 c = 0.5 + C0 * base;
  if (degree > 0)
    c += 0.4886025119029199 * (-y * band(splat, 1) + z * band(splat, 2) - x * band(splat, 3));
  if (degree > 1)
    c += 1.0925484305920792 * (x * y * band(splat, 4) - y * z * band(splat, 5) - x * z * band(splat, 7))
       + 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * band(splat, 6)
       + 0.5462742152960396 * (x * x - y * y) * band(splat, 8);
  if (degree > 2)
    c += -0.5900435899266435 * y * (3.0 * x * x - y * y) * band(splat, 9)
       + 2.890611442640554 * x * y * z * band(splat, 10)
       - 0.4570457994644658 * y * (4.0 * z * z - x * x - y * y) * band(splat, 11)
       + 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * band(splat, 12)
       - 0.4570457994644658 * x * (4.0 * z * z - x * x - y * y) * band(splat, 13)
       + 1.445305721320277 * z * (x * x - y * y) * band(splat, 14)
       - 0.5900435899266435 * x * (x * x - 3.0 * y * y) * band(splat, 15);
  return max(c, 0.0);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside: nothing is drawn
  int place = BATCH * gl_InstanceID + (gl_VertexID >> 2), width = textureSize(order, 0).x;
  if (place >= drawn) return;
  int splat = int(texelFetch(order, ivec2(place % width, place / width), 0).x);
  uvec4 word = shape(2 * splat);
  vec3 mean = uintBitsToFloat(word.xyz);
  vec3 t = (camFromWorld * vec4(mean, 1.0)).xyz;
  vec3 scales = scale * exp(vec3(word.w & 255u, word.w >> 8u & 255u, word.w >> 16u & 255u) / 16.0 - 10.0);
  vec4 base = tint(stride * splat);
  vec2 ray = clamp(t.xy / t.z, bounds.xy, bounds.zw);
  mat3 W = transpose(mat3(camFromWorld));
  vec3 j0 = (W[0] - W[2] * ray.x) * (intrinsics.x / t.z), j1 = (W[1] - W[2] * ray.y) * (intrinsics.y / t.z);
  mat3 R = rotation(quaternion(shape(2 * splat + 1).x));
  vec3 m0 = (j0 * R) * scales, m1 = (j1 * R) * scales;
  vec3 n = cross(m0, m1);
  float xx = dot(m0, m0) + eps2d, yy = dot(m1, m1) + eps2d, xy = dot(m0, m1);
  float sharp = dot(n, n), det = sharp + (xx + yy - 2.0 * eps2d) * eps2d + eps2d * eps2d;
  opacity = base.a / 255.0;
  if (antialiased) opacity *= sqrt(sharp / det);
  if (255.0 * opacity < 1.0) return;
  // Principal axes of the ellipse in which alpha exceeds 1/255.
  float reach = sqrt(2.0 * log(255.0 * opacity)), mid = 0.5 * (xx + yy);
  float spread = length(vec2(0.5 * (xx - yy), xy)), wide = mid + spread, thin = max(det / wide, 1e-6);
  vec2 axis = abs(xy) > 1e-6 * mid ? normalize(vec2(wide - yy, xy)) : xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
  offset = reach * (vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0);
  vec2 pixel = t.xy / t.z * intrinsics.xy + intrinsics.zw
             + offset.x * sqrt(wide) * axis + offset.y * sqrt(thin) * vec2(-axis.y, axis.x);
  color = seen(splat, (base.rgb / 255.0 - 0.5) / 0.15, normalize(mean - center));
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec3 color;
in vec2 offset;
in float opacity;
out vec4 premultiplied;
void main() {
  float alpha = opacity * exp(-0.5 * dot(offset, offset));
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, 0.99);
  premultiplied = vec4(color * alpha, alpha);
}`;

const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D image;
uniform vec3 background;
uniform vec2 ratio;  // image pixels per screen pixel
out vec4 color;
void main() {
  vec4 drawn = texture(image, gl_FragCoord.xy * ratio / vec2(textureSize(image, 0)));
  color = vec4(drawn.rgb + (1.0 - drawn.a) * background, 1.0);
}`;

const WIRE_VERTEX = `#version 300 es
uniform mat4 camFromWorld;
uniform vec4 intrinsics;
uniform vec2 size;
in vec3 point;
void main() {
  vec3 t = (camFromWorld * vec4(point, 1.0)).xyz;
  vec2 px = t.xy * intrinsics.xy + intrinsics.zw * t.z;
  gl_Position = vec4(2.0 * px.x / size.x - t.z, t.z - 2.0 * px.y / size.y, 0.0, t.z);
}`;

const WIRE_FRAGMENT = `#version 300 es
precision mediump float;
out vec4 color;
void main() { color = vec4(0.95, 0.6, 0.15, 1.0); }`;

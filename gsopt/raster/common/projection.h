// From a Gaussian in the world to a splat on the image plane, and the gradient on the way back.
// F = float (one thread, one Gaussian) or a vector of floats; the including file provides sqrt, min, max, clamp,
// select, exp, log2 and splat for F. Numbers in parentheses are equations of docs/math.md.
#pragma once
#include "constants.h"

namespace gsopt {

struct Camera {
  // cam_from_world is R (x - pivot) + t. The pivot is a round point near the camera, the origin unless that is far
  // away: float32 differences keep their digits where float32 coordinates have few.
  float R[9], t[3], pivot[3];
  float center[3];  // of the camera, from the pivot
  float fx, fy, cx, cy;
  float x_min, x_max, y_min, y_max;  // bounds on t_x/t_z and t_y/t_z inside the Jacobian
  float near_plane, far_plane, eps2d;
  int width, height;
  bool antialiased;
};

}  // namespace gsopt

namespace gsopt::GSOPT_ISA {

template <class F> struct Vec3 {
  F x, y, z;
};
template <class F> inline Vec3<F> operator+(Vec3<F> a, Vec3<F> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class F> inline Vec3<F> operator-(Vec3<F> a, Vec3<F> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class F, class S> inline Vec3<F> operator*(Vec3<F> a, S s) { return {a.x * s, a.y * s, a.z * s}; }
template <class F> inline F dot(Vec3<F> a, Vec3<F> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class F> inline Vec3<F> cross(Vec3<F> a, Vec3<F> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class F> inline Vec3<F> splat3(const float* p) { return {splat<F>(p[0]), splat<F>(p[1]), splat<F>(p[2])}; }

// Columns of the rotation of a unit quaternion (w, x, y, z), (3).
template <class F> struct Rotation {
  Vec3<F> c0, c1, c2;
};
template <class F> inline Rotation<F> rotation(F w, F x, F y, F z) {
  const F one = splat<F>(1.f);
  return {{one - (y * y + z * z) * 2.f, (x * y + w * z) * 2.f, (x * z - w * y) * 2.f},
      {(x * y - w * z) * 2.f, one - (x * x + z * z) * 2.f, (y * z + w * x) * 2.f},
      {(x * z + w * y) * 2.f, (y * z - w * x) * 2.f, one - (x * x + y * y) * 2.f}};
}

// One Gaussian (or a vector of them) as the optimizer stores it.
template <class F> struct Splat3D {
  Vec3<F> mean;
  F qw, qx, qy, qz;
  Vec3<F> log_scale;
  F logit;
};

// Everything that forward and backward both need.
template <class F> struct Projected {
  Vec3<F> offset;                        // mean - pivot
  Vec3<F> t;                             // camera space
  F iz, ray_x, ray_y, bound_x, bound_y;  // 1/t_z; t_x/t_z, t_y/t_z; the same clamped
  F qn, qw, qx, qy, qz;                  // norm of the quaternion, unit quaternion
  Rotation<F> R;
  Vec3<F> scale;
  Vec3<F> JW0, JW1;         // rows of J W
  Vec3<F> M0, M1;           // rows of J W R S: cov2d = M Mᵀ + eps2d
  F mx, my, xx, xy, yy;     // mean2d and cov2d
  F det0, det;              // determinants of M Mᵀ and of cov2d
  Vec3<F> n;                // M0 x M1
  F opacity;                // sigmoid, times the antialiasing factor
  F sigmoid, transparency;  // of the logit; 1 - sigmoid without a difference
};

// Equations (1) to (5).
template <class F> inline Projected<F> project(const Camera& cam, const Splat3D<F>& g) {
  Projected<F> p;
  const Vec3<F> W0 = splat3<F>(cam.R), W1 = splat3<F>(cam.R + 3), W2 = splat3<F>(cam.R + 6);
  p.offset = g.mean - splat3<F>(cam.pivot);
  p.t = {dot(W0, p.offset) + cam.t[0], dot(W1, p.offset) + cam.t[1], dot(W2, p.offset) + cam.t[2]};
  p.iz = splat<F>(1.f) / p.t.z;
  p.ray_x = p.t.x * p.iz;
  p.ray_y = p.t.y * p.iz;
  p.mx = p.ray_x * cam.fx + cam.cx;
  p.my = p.ray_y * cam.fy + cam.cy;
  p.bound_x = clamp(p.ray_x, splat<F>(cam.x_min), splat<F>(cam.x_max));
  p.bound_y = clamp(p.ray_y, splat<F>(cam.y_min), splat<F>(cam.y_max));
  p.JW0 = (W0 - W2 * p.bound_x) * (p.iz * cam.fx);
  p.JW1 = (W1 - W2 * p.bound_y) * (p.iz * cam.fy);

  // Divide by the largest component first: the squares of tiny and huge quaternions would leave the range of float.
  const F big = max(max(abs(g.qw), abs(g.qx)), max(abs(g.qy), abs(g.qz)));
  const F ib = splat<F>(1.f) / big;
  const F w = g.qw * ib, x = g.qx * ib, y = g.qy * ib, z = g.qz * ib;
  const F norm = sqrt(w * w + x * x + y * y + z * z), in = splat<F>(1.f) / norm;
  p.qn = norm * big;
  p.qw = w * in;
  p.qx = x * in;
  p.qy = y * in;
  p.qz = z * in;
  p.R = rotation(p.qw, p.qx, p.qy, p.qz);
  p.scale = {exp(g.log_scale.x), exp(g.log_scale.y), exp(g.log_scale.z)};

  p.M0 = {dot(p.JW0, p.R.c0) * p.scale.x, dot(p.JW0, p.R.c1) * p.scale.y, dot(p.JW0, p.R.c2) * p.scale.z};
  p.M1 = {dot(p.JW1, p.R.c0) * p.scale.x, dot(p.JW1, p.R.c1) * p.scale.y, dot(p.JW1, p.R.c2) * p.scale.z};
  const F d0 = dot(p.M0, p.M0), d1 = dot(p.M1, p.M1);
  p.xx = d0 + cam.eps2d;
  p.yy = d1 + cam.eps2d;
  p.xy = dot(p.M0, p.M1);
  // det(M Mᵀ) = |M0 x M1|²: no difference of large squares, so needles keep their width.
  p.n = cross(p.M0, p.M1);
  p.det0 = dot(p.n, p.n);
  p.det = p.det0 + (d0 + d1) * cam.eps2d + cam.eps2d * cam.eps2d;

  const F odds = exp(splat<F>(0.f) - g.logit);
  p.sigmoid = splat<F>(1.f) / (odds + 1.f);
  p.transparency = odds * p.sigmoid;
  p.opacity = cam.antialiased ? p.sigmoid * sqrt(p.det0 / p.det) : p.sigmoid;
  return p;
}

// The upper triangular factor L of the conic Q = Lᵀ L, (11): (u, v) = L d has dᵀ Q d = u² + v². In these whitened
// coordinates every splat is a round unit blob: sums over its pixels neither cancel nor overflow, however thin it is.
template <class F> struct Whitening {
  F A, B, C;  // u = A dx + B dy, v = C dy
};
template <class F> inline Whitening<F> whitening(const Projected<F>& p) {
  const F A = sqrt(p.yy / p.det);
  return {A, splat<F>(0.f) - A * (p.xy / p.yy), splat<F>(1.f) / sqrt(p.yy)};
}

// The splat as it is blended, L in units in which its exponent of 2 is log2_opacity - u² - v² (8a), and the half-sides
// of its box (6).
template <class F> struct Ellipse {
  F A, B, C, log2_opacity, reach_x, reach_y;
};
template <class F> inline Ellipse<F> ellipse(const Projected<F>& p) {
  const Whitening<F> L = whitening(p);
  const F lo = log2(max(p.opacity, splat<F>(1e-37f)));
  const F reach = max(lo - kLog2AlphaMin, splat<F>(0.f)) / splat<F>(kHalfLog2E);
  return {L.A * kSqrtHalfLog2E, L.B * kSqrtHalfLog2E, L.C * kSqrtHalfLog2E, lo, sqrt(reach * p.xx), sqrt(reach * p.yy)};
}

// Whether a splat is in the image: neither culled nor without area.
template <class F> inline auto is_visible(const Camera& cam, const Projected<F>& p, const Ellipse<F>& e) {
  return (p.t.z > cam.near_plane) & (p.t.z < cam.far_plane) & (p.opacity >= kAlphaMin) & (p.det >= kDetMin) &
         (p.det < 1e37f) & (p.mx + e.reach_x > 0.f) & (p.mx - e.reach_x < static_cast<float>(cam.width)) &
         (p.my + e.reach_y > 0.f) & (p.my - e.reach_y < static_cast<float>(cam.height));
}

// Moments of s = dLoss/d ln(alpha) over the splat's pixels, (11).
template <class F> struct SplatGradient {
  F u, v, uu, uv, vv;  // Σ s u, ...
  F log_opacity;       // Σ s: natural logarithm of the effective opacity
  F mx, my;            // mean2d: Lᵀ (Σ s u, Σ s v)
  F depth;
};

// One row of gradient sums: moments of s in units of the ellipse, then color, depth, |gradient|.
enum RowField { kS, kSu, kSv, kSuu, kSuv, kSvv, kWr, kWg, kWb, kWz, kAbsX, kAbsY, kRowFields };

template <class F> inline SplatGradient<F> splat_gradient(const Whitening<F>& L, const F* row) {
  constexpr float length = 1.f / kSqrtHalfLog2E, square = 1.f / kHalfLog2E;  // of what blending measures u and v in
  const F su = row[kSu] * length, sv = row[kSv] * length;
  return {su, sv, row[kSuu] * square, row[kSuv] * square, row[kSvv] * square, row[kS], L.A * su, L.B * su + L.C * sv,
      row[kWz]};
}

// Equations (12) to (16).
template <class F> inline Splat3D<F> project_backward(
    const Camera& cam, const Projected<F>& p, const Whitening<F>& L, const SplatGradient<F>& v) {
  // JW and M of project(), whitened: dLoss/d(cov2d) is half of Lᵀ [uu uv; uv vv] L, so that L never has to be undone.
  const Vec3<F> JW0 = p.JW0 * L.A + p.JW1 * L.B, JW1 = p.JW1 * L.C;
  // A M0 + B M1 without its difference: M1·M1 M0 - M0·M1 M1 = M1 x (M0 x M1).
  const Vec3<F> M0 = (p.M0 * cam.eps2d + cross(p.M1, p.n)) * (L.A / p.yy), M1 = p.M1 * L.C;
  F uu = v.uu, uv = v.uv, vv = v.vv;
  Splat3D<F> out;
  out.logit = v.log_opacity * p.transparency;
  if (cam.antialiased) {  // (12)
    const F h = v.log_opacity, ratio = p.det / max(p.det0, splat<F>(1e-30f));
    uu = uu + h * (dot(M1, M1) * ratio - 1.f);
    vv = vv + h * (dot(M0, M0) * ratio - 1.f);
    uv = uv - h * dot(M0, M1) * ratio;
  }
  const Vec3<F> v_M0 = M0 * uu + M1 * uv, v_M1 = M0 * uv + M1 * vv;
  out.log_scale = {v_M0.x * M0.x + v_M1.x * M1.x, v_M0.y * M0.y + v_M1.y * M1.y, v_M0.z * M0.z + v_M1.z * M1.z};

  const Vec3<F> P0 = {v_M0.x * p.scale.x, v_M0.y * p.scale.y, v_M0.z * p.scale.z};
  const Vec3<F> P1 = {v_M1.x * p.scale.x, v_M1.y * p.scale.y, v_M1.z * p.scale.z};
  const Vec3<F> r0 = JW0 * P0.x + JW1 * P1.x, r1 = JW0 * P0.y + JW1 * P1.y, r2 = JW0 * P0.z + JW1 * P1.z;
  // dLoss/dR has columns r0, r1, r2; (15) takes it to the quaternion.
  const F w = p.qw, x = p.qx, y = p.qy, z = p.qz;
  const F a12 = r1.z - r2.y, a20 = r2.x - r0.z, a01 = r0.y - r1.x;
  const F s01 = r1.x + r0.y, s02 = r2.x + r0.z, s12 = r2.y + r1.z;
  const F gw = (x * a12 + y * a20 + z * a01) * 2.f;
  const F gx = (y * s01 + z * s02 + w * a12 - x * (r1.y + r2.z) * 2.f) * 2.f;
  const F gy = (x * s01 + z * s12 + w * a20 - y * (r0.x + r2.z) * 2.f) * 2.f;
  const F gz = (x * s02 + y * s12 + w * a01 - z * (r0.x + r1.y) * 2.f) * 2.f;
  const F radial = w * gw + x * gx + y * gy + z * gz, iq = splat<F>(1.f) / p.qn;
  out.qw = (gw - w * radial) * iq;
  out.qx = (gx - x * radial) * iq;
  out.qy = (gy - y * radial) * iq;
  out.qz = (gz - z * radial) * iq;

  const Vec3<F> v_white0 = p.R.c0 * P0.x + p.R.c1 * P0.y + p.R.c2 * P0.z;  // of the whitened JW
  const Vec3<F> v_white1 = p.R.c0 * P1.x + p.R.c1 * P1.y + p.R.c2 * P1.z;
  const Vec3<F> v_JW0 = v_white0 * L.A, v_JW1 = v_white0 * L.B + v_white1 * L.C;
  const Vec3<F> W0 = splat3<F>(cam.R), W1 = splat3<F>(cam.R + 3), W2 = splat3<F>(cam.R + 6);
  const F h0 = p.iz * cam.fx, h1 = p.iz * cam.fy;
  const F zero = splat<F>(0.f);
  const F v_ray_x = v.mx * cam.fx + select(p.ray_x == p.bound_x, zero - h0 * dot(v_JW0, W2), zero);
  const F v_ray_y = v.my * cam.fy + select(p.ray_y == p.bound_y, zero - h1 * dot(v_JW1, W2), zero);
  const F v_tx = v_ray_x * p.iz, v_ty = v_ray_y * p.iz;
  const F v_tz = v.depth - (dot(v_white0, JW0) + dot(v_white1, JW1) + v_ray_x * p.ray_x + v_ray_y * p.ray_y) * p.iz;
  out.mean = W0 * v_tx + W1 * v_ty + W2 * v_tz;
  return out;
}

}  // namespace gsopt::GSOPT_ISA

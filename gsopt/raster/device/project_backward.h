// The gradients of splats to gradients of Gaussians (docs/math.md, 12 to 18). One thread, one Gaussian, which adds the
// sums of its tiles in the order of its slots.
#pragma once
#include "frame.h"

namespace gsopt::GSOPT_ISA {

struct ProjectBackwardArguments {
  Camera camera;
  Parameters P;
  GLOBAL const Record* records;
  GLOBAL const Index* first_slot;
  GLOBAL const int* tiles;
  GLOBAL const Sums* sums;
  // shN and the last may be null.
  GLOBAL float *means, *quats, *log_scales, *logit_opacities, *sh0, *shN, *means2d, *means2d_abs;
};

// False when all are zero, or there are none: no pixel saw it.
inline bool sum_tiles(const ProjectBackwardArguments& a, Index n, Sums& total) {
  GLOBAL const Sums* rows = a.sums + a.first_slot[n];
  bool any = false;
  total = {};
  for (int k = 0; k < a.tiles[n]; ++k) {
    const Sums row = rows[k];
    for (int f = 0; f < kRowFields; ++f) total.at[f] += row.at[f];
  }
  for (int f = 0; f < kRowFields; ++f) any = any || total.at[f] != 0.f;
  return any;
}

// v_c of (10), none where a color was clamped at black.
inline Vec3<float> color_gradient(GLOBAL const Record& r, const Sums& v) {
  return {keep(r.r > 0.f, v.at[kWr]), keep(r.g > 0.f, v.at[kWg]), keep(r.b > 0.f, v.at[kWb])};
}

// v_e of (18).
inline Vec3<float> direction_gradient(const Parameters& P, Index n, const Vec3<float>& d, const Vec3<float>& v_color) {
  Vec3<float> Y[kMaxBands], out = {0.f, 0.f, 0.f};
  sh_basis_gradient(P.sh_degree, d.x, d.y, d.z, Y);
  const int bands = (P.sh_degree + 1) * (P.sh_degree + 1) - 1;
  GLOBAL const float* shN = P.shN + 3 * P.sh_rest * n;
  for (int k = 0; k < kMaxBands; ++k)
    if (k < bands) out = out + Y[k] * dot(v_color, load3(shN, k));
  return out;
}

// The bands of a Gaussian that is seen from the direction d, and how its color pulls at them: v_sh,k = Y_k v_color.
struct BandPull {
  float Y[kMaxBands];
  Vec3<float> v_color;
};
// From dLoss/d(sh0) as it is written: whoever makes the gradient of the bands makes the same bits.
NOT_INLINED BandPull band_pull(
    const Camera* cam, int degree, GLOBAL const float* means, GLOBAL const float* v_sh0, Index n) {
  BandPull out;
  float inverse_distance;
  const Vec3<float> offset = load3(means, n) - splat3<float>(cam->pivot),
                    d = view_directions(*cam, offset, inverse_distance);
  for (int k = 0; k < kMaxBands; ++k) out.Y[k] = 0.f;
  sh_basis(degree, d.x, d.y, d.z, out.Y);
  out.v_color = load3(v_sh0, n) * (1.f / kSH0);
  return out;
}

inline void write_bands(const ProjectBackwardArguments& a, Index n) {
  const BandPull pull = band_pull(&a.camera, a.P.sh_degree, a.P.means, a.sh0, n);
  GLOBAL float* to = a.shN + 3 * a.P.sh_rest * n;
  for (int k = 0; k < kMaxBands; ++k)
    if (k < a.P.sh_rest) store3(to, k, pull.v_color * pull.Y[k]);
}

inline void write_zeros(const ProjectBackwardArguments& a, Index n) {
  const Vec3<float> zero = {0.f, 0.f, 0.f};
  store3(a.means, n, zero);
  store3(a.log_scales, n, zero);
  store3(a.sh0, n, zero);
  for (int k = 0; k < 4; ++k) a.quats[4 * n + k] = 0.f;
  a.logit_opacities[n] = a.means2d[2 * n] = a.means2d[2 * n + 1] = 0.f;
  if (a.means2d_abs) a.means2d_abs[2 * n] = a.means2d_abs[2 * n + 1] = 0.f;
  if (a.shN)
    for (int k = 0; k < a.P.sh_rest; ++k) store3(a.shN + 3 * a.P.sh_rest * n, k, zero);
}

inline void write_gradient(const ProjectBackwardArguments& a, Index n, const Sums& sums) {
  const Splat3D<float> splat = load_splat(a.P, n);
  const Projected<float> p = project(a.camera, splat);
  const Whitening<float> L = whitening(p);
  const SplatGradient<float> v = splat_gradient(L, sums.at);
  const Splat3D<float> out = project_backward(a.camera, p, L, v);
  float inverse_distance;
  const Vec3<float> d = view_directions(a.camera, p.offset, inverse_distance),
                    color = color_gradient(a.records[n], sums), u = direction_gradient(a.P, n, d, color);
  store3(a.sh0, n, color * kSH0);
  store3(a.means, n, out.mean + (u - d * dot(u, d)) * inverse_distance);
  store3(a.log_scales, n, out.log_scale);
  const float q[4] = {out.qw, out.qx, out.qy, out.qz};
  for (int k = 0; k < 4; ++k) a.quats[4 * n + k] = q[k];
  a.logit_opacities[n] = out.logit;
  a.means2d[2 * n] = v.mx;
  a.means2d[2 * n + 1] = v.my;
  if (a.means2d_abs) {
    a.means2d_abs[2 * n] = sums.at[kAbsX];
    a.means2d_abs[2 * n + 1] = sums.at[kAbsY];
  }
  if (a.shN) write_bands(a, n);
}

KERNEL(project_backward_gaussians, ProjectBackwardArguments) {
  PHASE(t) {
    const Index n = static_cast<Index>(block()) * kThreads + t;
    Sums sums;
    if (n < a.P.count) {
      if (sum_tiles(a, n, sums)) {
        write_gradient(a, n, sums);
      } else {
        write_zeros(a, n);
      }
    }
  }
}

}  // namespace gsopt::GSOPT_ISA

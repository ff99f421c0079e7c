// Stage 5: the gradients of splats to gradients of Gaussians (docs/math.md, 12 to 18), a vector at a time.
#pragma once
#include "project.h"

namespace gsopt::GSOPT_ISA {

constexpr int kSumsAhead = 32;  // rows

inline void store_vec3(float* rows, const int64_t index[kWide], const Vec3<wide>& v) {
  store_fours({v.x, v.y, v.z, v.z}, [&](int l, f4 row) { std::memcpy(rows + 3 * index[l], &row, sizeof(float) * 3); });
}

// v_c of (10), none where a color was clamped at black.
inline Vec3<wide> color_gradient(const Frame& frame, const int64_t index[kWide], const wide field[kRow]) {
  wide drawn[4];
  load_fours([&](int l) { return load4(&frame.records.as<Record>()[index[l]].r); }, drawn);
  return {keep(drawn[0] > 0.f, field[kWr]), keep(drawn[1] > 0.f, field[kWg]), keep(drawn[2] > 0.f, field[kWb])};
}

// v_e of (18).
inline Vec3<wide> sh_backward(
    const Parameters& P, const int64_t index[kWide], int degree, const Vec3<wide>& d, const Vec3<wide>& v_color) {
  const int bands = (degree + 1) * (degree + 1) - 1;
  wide sh[3 * kMaxBands + 3];
  Vec3<wide> Y[kMaxBands];
  load_bands(P, index, bands, sh);
  sh_basis_gradient(degree, d.x, d.y, d.z, Y);
  const wide zero = splat<wide>(0.f);
  Vec3<wide> out = {zero, zero, zero};
  for (int k = 0; k < bands; ++k) out = out + Y[k] * dot(v_color, {sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]});
  return out;
}

// v_sh,k of (18) of a vector of Gaussians whose dLoss/d(sh0) is written.
inline void write_bands_gradient(const Frame& frame, const Parameters& P, const ParameterGradients& G,
    const int64_t index[kWide], const Vec3<wide>& mean) {
  const int bands = (frame.sh_degree + 1) * (frame.sh_degree + 1) - 1;
  alignas(64) float Y[kMaxBands][kWide];
  view_basis(frame.camera, mean, frame.sh_degree, Y);
  for (int l = 0; l < kWide; ++l) {
    float row[3 * kMaxBands + 1] = {};
    bands_gradient(G.sh0, index[l], bands, Y, l, row);
    std::memcpy(G.shN + 3 * P.sh_rest * index[l], row, sizeof(float) * 3 * P.sh_rest);
  }
}

// The rows of one splat, summed in slot order; false when all are zero, or there are none: no pixel saw it.
inline bool sum_rows(const Frame& frame, const Cover* cover, float out[kRow]) {
  const float* row = frame.rows.as<float>() + static_cast<int64_t>(cover->slot) * kRow;
  wide sum[kRow / kWide] = {};
  for (uint32_t k = cover[0].slot; k < cover[1].slot; ++k, row += kRow) {
    __builtin_prefetch(row + kSumsAhead * kRow);
    for (int h = 0; h < kRow / kWide; ++h) sum[h] += load_wide(row + h * kWide);
  }
  widei nonzero = splat_widei(0);
  for (int h = 0; h < kRow / kWide; ++h) {
    store_wide(out + h * kWide, sum[h]);
    nonzero |= sum[h] != 0.f;
  }
  return any(nonzero);
}

// A full vector, always: a compiler that knew how many lanes count might round the last vector otherwise.
inline void project_backward_lanes(const Frame& frame, const Parameters& P, const ParameterGradients& G,
    const int64_t index[kWide], const float sums[kWide][kRow]) {
  const Camera& cam = frame.camera;
  wide field[kRow];
  for (int h = 0; h < kRow; h += 8) load_eights([&](int l) { return load8(sums[l] + h); }, field + h);
  const Splat3D<wide> g = load_splats(P, index);
  const Projected<wide> p = project(cam, g);
  const Whitening<wide> L = whitening(p);
  const SplatGradient<wide> v = splat_gradient(L, field);
  Splat3D<wide> out = project_backward(cam, p, L, v);

  wide inv;
  const Vec3<wide> d = view_directions(cam, p.offset, inv), color = color_gradient(frame, index, field);
  store_vec3(G.sh0, index, color * kSH0);
  const Vec3<wide> u = sh_backward(P, index, frame.sh_degree, d, color);
  out.mean = out.mean + (u - d * dot(u, d)) * inv;
  if (G.shN) write_bands_gradient(frame, P, G, index, g.mean);

  store_vec3(G.means, index, out.mean);
  store_vec3(G.log_scales, index, out.log_scale);
  store_fours({out.qw, out.qx, out.qy, out.qz}, [&](int l, f4 v) { store4(G.quats + 4 * index[l], v); });
  alignas(64) float logits[kWide];
  store_wide(logits, out.logit);
  for (int l = 0; l < kWide; ++l) G.logit_opacities[index[l]] = logits[l];
  store_fours({v.mx, v.my, field[kAbsX], field[kAbsY]}, [&](int l, f4 v2) {
    std::memcpy(G.means2d + 2 * index[l], &v2, sizeof(float) * 2);
    if (G.means2d_abs)
      std::memcpy(G.means2d_abs + 2 * index[l], reinterpret_cast<const float*>(&v2) + 2, sizeof(float) * 2);
  });
}

inline void zero_gradient(const Parameters& P, const ParameterGradients& G, int64_t n) {
  for (int k = 0; k < 3; ++k) G.means[3 * n + k] = G.log_scales[3 * n + k] = G.sh0[3 * n + k] = 0.f;
  for (int k = 0; k < 4; ++k) G.quats[4 * n + k] = 0.f;
  G.logit_opacities[n] = 0.f;
  G.means2d[2 * n] = G.means2d[2 * n + 1] = 0.f;
  if (G.means2d_abs) G.means2d_abs[2 * n] = G.means2d_abs[2 * n + 1] = 0.f;
  if (G.shN && P.sh_rest) std::memset(G.shN + 3 * P.sh_rest * n, 0, sizeof(float) * 3 * P.sh_rest);
}

// The record of Gaussian n and, once for every four, where their gradients go.
inline void ask_for_gradient(const Frame& frame, const ParameterGradients& G, int64_t n) {
  __builtin_prefetch(&frame.records.as<Record>()[n].r);
  if (n % 4) return;
  for (const float* to : {G.means, G.log_scales, G.sh0}) __builtin_prefetch(to + 3 * n, 1);
  __builtin_prefetch(G.quats + 4 * n, 1);
  __builtin_prefetch(G.means2d + 2 * n, 1);
}

// Gaussians that no pixel saw get zeros; the others are packed into full vectors, in index order.
inline void project_backward_stage(Pool& pool, Frame& frame, const Parameters& P, const ParameterGradients& G) {
  const Cover* covers = frame.covers.as<Cover>();
  parallel(pool, divide_up(P.count, kProjectChunk), [&](int chunk, int) {
    const int64_t begin = static_cast<int64_t>(chunk) * kProjectChunk;
    const int64_t end = begin + kProjectChunk < P.count ? begin + kProjectChunk : P.count;
    int64_t index[kWide];
    alignas(64) float sums[kWide][kRow] = {};
    int lanes = 0;
    for (int64_t n = begin; n < end; ++n) {
      ask_for_gradient(frame, G, n + kGaussiansAhead);
      if (!sum_rows(frame, &covers[n], sums[lanes])) {
        zero_gradient(P, G, n);
        continue;
      }
      index[lanes++] = n;
      if (lanes == kWide) {
        project_backward_lanes(frame, P, G, index, sums);
        lanes = 0;
      }
    }
    if (lanes) {
      for (int l = lanes; l < kWide; ++l) {
        index[l] = index[0];
        std::memcpy(sums[l], sums[0], sizeof(sums[0]));
      }
      project_backward_lanes(frame, P, G, index, sums);
    }
  });
}

}  // namespace gsopt::GSOPT_ISA

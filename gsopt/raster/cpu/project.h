// Stage 1 and its mirror image: Gaussians to splats, a vector at a time, and gradients of splats to gradients of Gaussians.
#pragma once
#include "../common/sh.h"
#include "frame.h"
#include "parallel.h"
#include "tiles.h"

namespace gsopt::GSOPT_ISA {

constexpr int kBandsAhead = 32;

// A vector of Gaussians from arrays of structures to one vector per field. `rows` may repeat an index: the tail is padded.
inline Splat3D<wide> load_splats(const Parameters& P, const int64_t rows[kWide]) {
  alignas(64) float v[11][kWide];
  for (int l = 0; l < kWide; ++l) {
    const int64_t n = rows[l];
    const float *m = P.means + 3 * n, *q = P.quats + 4 * n, *s = P.log_scales + 3 * n;
    v[0][l] = m[0], v[1][l] = m[1], v[2][l] = m[2];
    v[3][l] = q[0], v[4][l] = q[1], v[5][l] = q[2], v[6][l] = q[3];
    v[7][l] = s[0], v[8][l] = s[1], v[9][l] = s[2];
    v[10][l] = P.logit_opacities[n];
  }
  wide f[11];
  for (int k = 0; k < 11; ++k) f[k] = load_wide(v[k]);
  return {{f[0], f[1], f[2]}, f[3], f[4], f[5], f[6], {f[7], f[8], f[9]}, f[10]};
}

template <class F> inline Vec3<F> view_directions(const Camera& cam, const Vec3<F>& offset, F& inverse_distance) {
  const Vec3<F> d = offset - splat3<F>(cam.center);
  inverse_distance = splat<F>(1.f) / sqrt(max(dot(d, d), splat<F>(1e-30f)));
  return d * inverse_distance;
}

// The bands at the directions in which a vector of Gaussians is seen. Not inlined: all who ask must get the same bits.
[[gnu::noinline]] inline void view_basis(const Camera& cam, const Vec3<wide>& mean, int degree, float Y[15][kWide]) {
  wide basis[15], inverse_distance;
  const Vec3<wide> d = view_directions(cam, mean - splat3<wide>(cam.pivot), inverse_distance);
  sh_basis(degree, d.x, d.y, d.z, basis);
  for (int k = 0; k < (degree + 1) * (degree + 1) - 1; ++k) store_wide(Y[k], basis[k]);
}

// Calls visit(k, (r, g, b, anything)) for the first `bands` coefficients of row n of shN. Four floats are read for each, but for the
// last of a row, behind which there may be nothing.
template <class Visit> inline void for_each_band(const Parameters& P, int64_t n, int bands, Visit&& visit) {
  const float* sh = P.shN + 3 * P.sh_rest * n;
  const int safe = bands < P.sh_rest ? bands : bands - 1;
  for (int k = 0; k < safe; ++k) visit(k, load4(sh + 3 * k));
  for (int k = safe > 0 ? safe : 0; k < bands; ++k) visit(k, f4{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2], 0.f});
}

// Bands of a Gaussian that is needed soon: a page of memory ends every twenty of them, where processors stop to look ahead.
inline void prefetch_bands(const Parameters& P, int64_t n) {
  const float* row = P.shN + 3 * P.sh_rest * (n + kBandsAhead < P.count ? n + kBandsAhead : n);
  for (int k = 0; k < 3 * P.sh_rest; k += 16) __builtin_prefetch(row + k);
}

inline f4 sh_color(const Parameters& P, int64_t n, const float Y[][kWide], int lane, int bands) {
  const float* dc = P.sh0 + 3 * n;
  f4 c = f4{dc[0], dc[1], dc[2], 0.f} * kSH0 + 0.5f;
  for_each_band(P, n, bands, [&](int k, f4 sh) { c += sh * Y[k][lane]; });
  return c;
}

// Where a chunk of Gaussians leaves the ids and depth keys of those that are visible, in index order.
struct Visible {
  uint32_t *ids, *keys;
  Found found;
};

// One vector of Gaussians.
inline void project_lanes(const Frame& frame, const Parameters& P, int64_t first, int lanes, int32_t* radii, Visible& visible) {
  const Camera& cam = frame.camera;
  int64_t index[kWide];
  for (int l = 0; l < kWide; ++l) index[l] = first + (l < lanes ? l : 0);
  const Splat3D<wide> g = load_splats(P, index);
  const Projected<wide> p = project(cam, g);

  const wide k = splat<wide>(kHalfLog2E);
  const Whitening<wide> L = whitening(p);
  const wide A = L.A * kSqrtHalfLog2E, B = L.B * kSqrtHalfLog2E, C = L.C * kSqrtHalfLog2E;
  const wide lo = log2(max(p.opacity, splat<wide>(1e-37f)));
  const wide reach = max(lo - kLog2AlphaMin, splat<wide>(0.f)) / k;  // dᵀ conic d where alpha = 1/255
  const wide rx = sqrt(reach * p.xx), ry = sqrt(reach * p.yy);
  const widei ok = (p.t.z > cam.near_plane) & (p.t.z < cam.far_plane) & (p.opacity >= kAlphaMin) & (p.det >= kDetMin) &
                (p.det < 1e37f) & (p.mx + rx > 0.f) & (p.mx - rx < static_cast<float>(cam.width)) & (p.my + ry > 0.f) &
                (p.my - ry < static_cast<float>(cam.height));
  const int mask = movemask(ok) & ((1 << lanes) - 1);

  alignas(64) float Y[15][kWide], out[10][kWide], rad[2][kWide];
  const int bands = (frame.sh_degree + 1) * (frame.sh_degree + 1) - 1;
  if (mask) {
    view_basis(cam, g.mean, frame.sh_degree, Y);
    const wide fields[8] = {p.mx, p.my, A, B, C, lo, p.t.z, p.t.z};
    for (int f = 0; f < 7; ++f) store_wide(out[f], fields[f]);
    store_wide(rad[0], rx), store_wide(rad[1], ry);
  }
  TileBox boxes[kWide] = {};
  uint64_t tiles[kWide] = {};
  for (int l = 0; l < lanes; ++l)
    if (mask >> l & 1) boxes[l] = tile_box(frame, out[0][l], out[1][l], rad[0][l], rad[1][l]);
  if (mask && frame.skips.tiles) tile_masks(p.mx, p.my, A, B, C, lo, boxes, tiles);
  Record* records = frame.records.as<Record>();
  Cover* covers = frame.covers.as<Cover>();
  for (int l = 0; l < lanes; ++l) {
    const uint32_t id = static_cast<uint32_t>(first + l);
    radii[2 * (first + l)] = radii[2 * (first + l) + 1] = 0;
    covers[id] = {};
    if (!(mask >> l & 1)) continue;
    Record& r = records[id];
    const f4 c = sh_color(P, first + l, Y, l, bands);
    r.mx = out[0][l], r.my = out[1][l], r.A = out[2][l], r.B = out[3][l], r.C = out[4][l], r.log2_opacity = out[5][l];
    r.r = c[0] > 0.f ? c[0] : 0.f, r.g = c[1] > 0.f ? c[1] : 0.f, r.b = c[2] > 0.f ? c[2] : 0.f, r.depth = out[6][l];
    r.x0 = static_cast<uint16_t>(boxes[l].x0), r.x1 = static_cast<uint16_t>(boxes[l].x1);
    r.y0 = static_cast<uint16_t>(boxes[l].y0), r.y1 = static_cast<uint16_t>(boxes[l].y1);
    covers[id] = cover_of(frame, id, boxes[l], tiles[l]);
    for (int a = 0; a < 2; ++a) radii[2 * (first + l) + a] = clamp_int(__builtin_ceilf(rad[a][l]), 1 << 30);
    visible.ids[visible.found.visible] = id;
    std::memcpy(&visible.keys[visible.found.visible++], &r.depth, 4);  // positive floats sort like their bits
    visible.found.intersections += covers[id].slot;
  }
}

// Fills records, covers and radii, and leaves ids and depth keys of the visible Gaussians, in index order, for the sort.
inline void project_stage(Pool& pool, Frame& frame, const Parameters& P, int32_t* radii) {
  const int chunks = divide_up(P.count, kProjectChunk);
  uint32_t *ids = frame.order2.as<uint32_t>(), *keys = frame.keys2.as<uint32_t>();
  Found* found = frame.found.as<Found>();
  const auto end_of = [&](int64_t begin) { return begin + kProjectChunk < P.count ? begin + kProjectChunk : P.count; };
  parallel(pool, chunks, [&](int chunk, int) {
    const int64_t begin = static_cast<int64_t>(chunk) * kProjectChunk, end = end_of(begin);
    Visible visible = {ids + begin, keys + begin, {}};
    for (int64_t i = begin; i < end; i += kWide) project_lanes(frame, P, i, end - i < kWide ? static_cast<int>(end - i) : kWide, radii, visible);
    found[chunk] = visible.found;
  });
  frame.visible = frame.intersections = 0;
  for (int chunk = 0; chunk < chunks; ++chunk) {  // from here on: what came before
    const Found mine = found[chunk];
    found[chunk] = {static_cast<uint32_t>(frame.visible), frame.intersections};
    frame.visible += mine.visible, frame.intersections += mine.intersections;
  }
  Cover* covers = frame.covers.as<Cover>();
  parallel(pool, chunks, [&](int chunk, int) {
    const int64_t begin = static_cast<int64_t>(chunk) * kProjectChunk, end = end_of(begin), to = found[chunk].visible;
    const size_t n = static_cast<size_t>((chunk + 1 < chunks ? found[chunk + 1].visible : frame.visible) - to);
    std::memcpy(frame.order.as<uint32_t>() + to, ids + begin, sizeof(uint32_t) * n);
    std::memcpy(frame.keys.as<uint32_t>() + to, keys + begin, sizeof(uint32_t) * n);
    uint32_t slot = static_cast<uint32_t>(found[chunk].intersections);
    for (int64_t i = begin; i < end; ++i) {
      const uint32_t count = covers[i].slot;
      covers[i].slot = slot, slot += count;
    }
  });
  covers[P.count].slot = static_cast<uint32_t>(frame.intersections);
}

// dLoss/d(direction), before normalisation.
inline void sh_backward(const Parameters& P, int64_t n, int bands, const float (*Yx)[kWide], const float (*Yy)[kWide],
                        const float (*Yz)[kWide], int lane, const float* v_color, float* v_direction) {
  const f4 v = {v_color[0], v_color[1], v_color[2], 0.f};
  f4 dx = splat<f4>(0.f), dy = dx, dz = dx;
  for_each_band(P, n, bands, [&](int k, f4 sh) { dx += sh * Yx[k][lane], dy += sh * Yy[k][lane], dz += sh * Yz[k][lane]; });
  dx *= v, dy *= v, dz *= v;
  v_direction[0] = dx[0] + dx[1] + dx[2], v_direction[1] = dy[0] + dy[1] + dy[2], v_direction[2] = dz[0] + dz[1] + dz[2];
}

// Row n of dLoss/d(shN) = Y ⊗ dLoss/d(sh0) / Y_0 at `row`, but for bands that are not drawn. Writes one float more, which is the
// next row's or spare.
inline void bands_gradient(const float* v_sh0, int64_t n, int bands, const float (*Y)[kWide], int lane, float* row) {
  const float* v = v_sh0 + 3 * n;
  const f4 v_color = f4{v[0], v[1], v[2], 0.f} * (1.f / kSH0);
  for (int k = 0; k < bands; ++k) store4(row + 3 * k, v_color * Y[k][lane]);
}

// The rows of one splat, summed in slot order; false when all are zero, or there are none: no pixel saw it.
inline bool sum_rows(const Frame& frame, const Cover* cover, float out[kRow]) {
  const float* row = frame.rows.as<float>() + static_cast<int64_t>(cover->slot) * kRow;
  wide sum[kRow / kWide] = {};
  for (uint32_t k = cover[0].slot; k < cover[1].slot; ++k, row += kRow)
    for (int h = 0; h < kRow / kWide; ++h) sum[h] += load_wide(row + h * kWide);
  widei nonzero = splat_widei(0);
  for (int h = 0; h < kRow / kWide; ++h) store_wide(out + h * kWide, sum[h]), nonzero |= sum[h] != 0.f;
  return any(nonzero);
}

// A full vector, always: a compiler that knew how many lanes count would round otherwise for whole vectors than for the last one.
inline void project_backward_lanes(const Frame& frame, const Parameters& P, const ParameterGradients& G, const int64_t index[kWide],
                                   const float sums[kWide][kRow]) {
  const Camera& cam = frame.camera;
  const Record* records = frame.records.as<Record>();
  wide field[kRow];
  for (int h = 0; h < kRow; h += 8) load_columns(sums[0] + h, kRow, field + h);
  const Splat3D<wide> g = load_splats(P, index);
  const Projected<wide> p = project(cam, g);
  const Whitening<wide> L = whitening(p);
  // Blending measures u and v in units of sqrt(kHalfLog2E).
  constexpr float length = 1.f / kSqrtHalfLog2E, square = 1.f / kHalfLog2E;
  const wide su = field[kSu] * length, sv = field[kSv] * length;
  const SplatGradient<wide> v = {su, sv, field[kSuu] * square, field[kSuv] * square, field[kSvv] * square, field[kS],
                               L.A * su, L.B * su + L.C * sv, field[kWz]};
  Splat3D<wide> out = project_backward(cam, p, L, v);

  wide bx[15], by[15], bz[15], inv;
  alignas(64) float Y[15][kWide], Yx[15][kWide], Yy[15][kWide], Yz[15][kWide];
  const Vec3<wide> d = view_directions(cam, p.offset, inv);
  const int degree = frame.sh_degree, bands = (degree + 1) * (degree + 1) - 1;
  if (G.shN) view_basis(cam, g.mean, degree, Y);
  sh_basis_gradient(degree, d.x, d.y, d.z, bx, by, bz);
  for (int k = 0; k < bands; ++k) store_wide(Yx[k], bx[k]), store_wide(Yy[k], by[k]), store_wide(Yz[k], bz[k]);
  alignas(64) float vd[3][kWide] = {};
  for (int l = 0; l < kWide; ++l) {
    const int64_t n = index[l];
    const Record& r = records[n];
    float direction[3];
    const float color[3] = {r.r > 0.f ? sums[l][kWr] : 0.f, r.g > 0.f ? sums[l][kWg] : 0.f, r.b > 0.f ? sums[l][kWb] : 0.f};
    for (int ch = 0; ch < 3; ++ch) G.sh0[3 * n + ch] = color[ch] * kSH0;
    sh_backward(P, n, bands, Yx, Yy, Yz, l, color, direction);
    if (G.shN) {
      float row[3 * kMaxBands + 1] = {};
      bands_gradient(G.sh0, n, bands, Y, l, row);
      std::memcpy(G.shN + 3 * P.sh_rest * n, row, sizeof(float) * 3 * P.sh_rest);
    }
    for (int a3 = 0; a3 < 3; ++a3) vd[a3][l] = direction[a3];
  }
  Vec3<wide> u = {load_wide(vd[0]), load_wide(vd[1]), load_wide(vd[2])};
  u = (u - d * dot(u, d)) * inv;
  out.mean = out.mean + u;

  const wide results[15] = {out.mean.x, out.mean.y,      out.mean.z,      out.qw,          out.qx,    out.qy, out.qz, out.log_scale.x,
                          out.log_scale.y, out.log_scale.z, out.logit, v.mx, v.my, field[kAbsX], field[kAbsY]};
  alignas(64) float t[15][kWide];
  for (int k = 0; k < 15; ++k) store_wide(t[k], results[k]);
  for (int l = 0; l < kWide; ++l) {
    const int64_t n = index[l];
    for (int k = 0; k < 3; ++k) G.means[3 * n + k] = t[k][l], G.log_scales[3 * n + k] = t[7 + k][l];
    for (int k = 0; k < 4; ++k) G.quats[4 * n + k] = t[3 + k][l];
    G.logit_opacities[n] = t[10][l];
    for (int k = 0; k < 2; ++k) G.means2d[2 * n + k] = t[11 + k][l];
    if (G.means2d_abs)
      for (int k = 0; k < 2; ++k) G.means2d_abs[2 * n + k] = t[13 + k][l];
  }
}

inline void zero_gradient(const Parameters& P, const ParameterGradients& G, int64_t n) {
  for (int k = 0; k < 3; ++k) G.means[3 * n + k] = G.log_scales[3 * n + k] = G.sh0[3 * n + k] = 0.f;
  for (int k = 0; k < 4; ++k) G.quats[4 * n + k] = 0.f;
  G.logit_opacities[n] = 0.f;
  G.means2d[2 * n] = G.means2d[2 * n + 1] = 0.f;
  if (G.means2d_abs) G.means2d_abs[2 * n] = G.means2d_abs[2 * n + 1] = 0.f;
  if (G.shN && P.sh_rest) std::memset(G.shN + 3 * P.sh_rest * n, 0, sizeof(float) * 3 * P.sh_rest);
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
      if (!sum_rows(frame, &covers[n], sums[lanes])) {
        zero_gradient(P, G, n);
        continue;
      }
      prefetch_bands(P, n);
      index[lanes++] = n;
      if (lanes == kWide) project_backward_lanes(frame, P, G, index, sums), lanes = 0;
    }
    if (lanes) {
      for (int l = lanes; l < kWide; ++l) index[l] = index[0], std::memcpy(sums[l], sums[0], sizeof(sums[0]));
      project_backward_lanes(frame, P, G, index, sums);
    }
  });
}

}  // namespace gsopt::GSOPT_ISA

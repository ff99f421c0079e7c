// Stage 1: Gaussians to splats (docs/math.md, 1 to 6, 17), a vector at a time.
#pragma once
#include "../common/sh.h"
#include "columns.h"
#include "frame.h"
#include "parallel.h"
#include "tiles.h"

namespace gsopt::GSOPT_ISA {

// Gaussians are visited in their order, but in more arrays than a processor foresees: what this many further on will be
// read or written is asked for. It may lie behind an array's end, where asking does no harm.
constexpr int kGaussiansAhead = 24;

// Three numbers of row n, and anything: four are read, but for the last of all rows, behind which there may be nothing.
inline f4 load_three(const float* rows, int64_t n, int64_t count) {
  const float* p = rows + 3 * n;
  return n + 1 < count ? load4(p) : f4{p[0], p[1], p[2], 0.f};
}

// Rows of three numbers of a vector of Gaussians; `index` may repeat one: the tail is padded.
inline Vec3<wide> load_vec3(const float* rows, const int64_t index[kWide], int64_t count) {
  wide v[4];
  load_fours([&](int l) { return load_three(rows, index[l], count); }, v);
  return {v[0], v[1], v[2]};
}

inline Splat3D<wide> load_splats(const Parameters& P, const int64_t index[kWide]) {
  alignas(64) float logits[kWide];
  for (int l = 0; l < kWide; ++l) logits[l] = P.logit_opacities[index[l]];
  wide q[4];
  load_fours([&](int l) { return load4(P.quats + 4 * index[l]); }, q);
  return {load_vec3(P.means, index, P.count), q[0], q[1], q[2], q[3], load_vec3(P.log_scales, index, P.count),
      load_wide(logits)};
}

// The bands at the directions in which a vector of Gaussians is seen. Not inlined: all who ask must get the same bits.
[[gnu::noinline]] inline void view_basis(const Camera& cam, const Vec3<wide>& mean, int degree, float Y[15][kWide]) {
  wide basis[15], inverse_distance;
  const Vec3<wide> d = view_directions(cam, mean - splat3<wide>(cam.pivot), inverse_distance);
  sh_basis(degree, d.x, d.y, d.z, basis);
  for (int k = 0; k < (degree + 1) * (degree + 1) - 1; ++k) store_wide(Y[k], basis[k]);
}

// The first `bands` coefficients of shN of a vector of Gaussians: red, green and blue of one band after the other. The
// last eight numbers are read from the end of a row, so that nothing behind it is.
inline void load_bands(const Parameters& P, const int64_t index[kWide], int bands, wide sh[3 * kMaxBands + 3]) {
  const int stride = 3 * P.sh_rest;
  for (int from = 0; from < 3 * bands; from += 8) {
    const int at = from + 8 <= stride ? from : stride - 8;
    const auto row = [&](int l) {
      const float* p = P.shN + stride * index[l] + at;
      __builtin_prefetch(p + stride * kGaussiansAhead);
      return load8(p);
    };
    load_eights(row, sh + at);
  }
}

inline Vec3<wide> sh_color(
    const Frame& frame, const Parameters& P, const int64_t index[kWide], const Vec3<wide>& mean) {
  const int bands = (frame.sh_degree + 1) * (frame.sh_degree + 1) - 1;
  alignas(64) float Y[kMaxBands][kWide];
  wide sh[3 * kMaxBands + 3];
  view_basis(frame.camera, mean, frame.sh_degree, Y);
  load_bands(P, index, bands, sh);
  const Vec3<wide> dc = load_vec3(P.sh0, index, P.count);
  Vec3<wide> c = {dc.x * kSH0 + 0.5f, dc.y * kSH0 + 0.5f, dc.z * kSH0 + 0.5f};
  for (int k = 0; k < bands; ++k) c = c + Vec3<wide>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]} * load_wide(Y[k]);
  const wide zero = splat<wide>(0.f);
  return {max(c.x, zero), max(c.y, zero), max(c.z, zero)};
}

// Where a chunk of Gaussians leaves the ids and depth keys of those that are visible, in index order.
struct Visible {
  uint32_t *ids, *keys;
  Found found;
};

// Records of a vector of splats, field by field; there is room for a full one.
inline void write_records(Record* records, const wide (&field)[12]) {
  const auto four = [&](int f) {
    store_fours(
        {field[f], field[f + 1], field[f + 2], field[f + 3]}, [&](int l, f4 v) { store4(&records[l].mx + f, v); });
  };
  four(0);
  four(4);
  four(8);
}

// The least whole number that is not less; 2^30 at most.
inline widei ceiling(wide x) {
  const wide y = min(x, splat<wide>(1073741824.f));
  const widei whole = to_int(y);
  return whole - (to_float(whole) < y);  // true is -1
}

// One vector of Gaussians.
inline void project_lanes(
    const Frame& frame, const Parameters& P, int64_t first, int lanes, int32_t* radii, Visible& visible) {
  const Camera& cam = frame.camera;
  int64_t index[kWide];
  for (int l = 0; l < kWide; ++l) index[l] = first + (l < lanes ? l : 0);
  const Splat3D<wide> g = load_splats(P, index);
  Record* records = frame.records.as<Record>() + first;
  Cover* covers = frame.covers.as<Cover>() + first;
  for (int l = 0; l < kWide; ++l) __builtin_prefetch(records + kGaussiansAhead + l, 1);
  for (int l = 0; l < kWide; l += 4) __builtin_prefetch(covers + kGaussiansAhead + l, 1);
  const Projected<wide> p = project(cam, g);

  const Ellipse<wide> e = ellipse(p);
  const widei ok = is_visible(cam, p, e);
  const int mask = movemask(ok) & ((1 << lanes) - 1);
  radii += 2 * first;
  if (!mask) {
    std::memset(radii, 0, sizeof(int32_t) * 2 * lanes);
    for (int l = 0; l < lanes; ++l) covers[l] = {};
    return;
  }
  const TileBoxes boxes = tile_boxes(frame, p.mx, p.my, e.reach_x, e.reach_y, ok);
  const Vec3<wide> color = sh_color(frame, P, index, g.mean);
  write_records(records, {p.mx, p.my, e.A, e.B, e.C, e.log2_opacity, color.x, color.y, color.z, p.t.z,
                             from_bits(boxes.x0 | boxes.x1 << 16), from_bits(boxes.y0 | boxes.y1 << 16)});
  alignas(64) int32_t box[4][kWide], tiles[2][kWide] = {}, radius[2][kWide], keys[kWide];
  store_widei(box[0], boxes.x0);
  store_widei(box[1], boxes.x1);
  store_widei(box[2], boxes.y0);
  store_widei(box[3], boxes.y1);
  store_widei(radius[0], ceiling(e.reach_x) & ok);
  store_widei(radius[1], ceiling(e.reach_y) & ok);
  store_widei(keys, bits(p.t.z));  // positive floats sort like their bits
  if (frame.skips.tiles) {
    const TileMasks masks = tile_masks(p.mx, p.my, e.A, e.B, e.C, e.log2_opacity, boxes);
    store_widei(tiles[0], masks.low);
    store_widei(tiles[1], masks.high);
  }
  for (int l = 0; l < lanes; ++l) {
    const uint32_t id = static_cast<uint32_t>(first + l);
    const int seen = mask >> l & 1;
    const uint64_t touched = static_cast<uint32_t>(tiles[0][l]) | static_cast<uint64_t>(tiles[1][l]) << 32;
    covers[l] = seen ? cover_of(frame, id, {box[0][l], box[1][l], box[2][l], box[3][l]}, touched) : Cover{};
    radii[2 * l] = radius[0][l];
    radii[2 * l + 1] = radius[1][l];
    visible.ids[visible.found.visible] = id;
    visible.keys[visible.found.visible] = static_cast<uint32_t>(keys[l]);
    visible.found.visible += seen;  // what was written is overwritten if not
    visible.found.intersections += covers[l].slot;
  }
}

// Fills records, covers and radii, and lists ids and depth keys of the visible Gaussians in index order.
inline void project_stage(Pool& pool, Frame& frame, const Parameters& P, int32_t* radii) {
  const int chunks = divide_up(P.count, kProjectChunk);
  uint32_t *ids = frame.order2.as<uint32_t>(), *keys = frame.keys2.as<uint32_t>();
  Found* found = frame.found.as<Found>();
  const auto end_of = [&](int64_t begin) { return begin + kProjectChunk < P.count ? begin + kProjectChunk : P.count; };
  parallel(pool, chunks, [&](int chunk, int) {
    const int64_t begin = static_cast<int64_t>(chunk) * kProjectChunk, end = end_of(begin);
    Visible visible = {ids + begin, keys + begin, {}};
    for (int64_t i = begin; i < end; i += kWide)
      project_lanes(frame, P, i, end - i < kWide ? static_cast<int>(end - i) : kWide, radii, visible);
    found[chunk] = visible.found;
  });
  frame.visible = frame.intersections = 0;
  for (int chunk = 0; chunk < chunks; ++chunk) {  // from here on: what came before
    const Found mine = found[chunk];
    found[chunk] = {static_cast<uint32_t>(frame.visible), frame.intersections};
    frame.visible += mine.visible;
    frame.intersections += mine.intersections;
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
      covers[i].slot = slot;
      slot += count;
    }
  });
  covers[P.count].slot = static_cast<uint32_t>(frame.intersections);
}

// Row n of dLoss/d(shN) = Y ⊗ dLoss/d(sh0) / Y_0 (18) at `row`, but for bands that are not drawn. Writes one float
// more, which is the next row's or spare.
inline void bands_gradient(const float* v_sh0, int64_t n, int bands, const float (*Y)[kWide], int lane, float* row) {
  const float* v = v_sh0 + 3 * n;
  const f4 v_color = f4{v[0], v[1], v[2], 0.f} * (1.f / kSH0);
  for (int k = 0; k < bands; ++k) store4(row + 3 * k, v_color * Y[k][lane]);
}

}  // namespace gsopt::GSOPT_ISA

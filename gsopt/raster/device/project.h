// Gaussians to splats (docs/math.md, 1 to 6, 17), and the tiles of each splat (8c). One thread, one Gaussian.
#pragma once
#include "frame.h"

namespace gsopt::GSOPT_ISA {

struct ProjectArguments {
  Camera camera;
  Parameters P;
  int tiles_x, tiles_y;
  GLOBAL Record* records;
  GLOBAL int *radii, *depths,
      *tiles;  // depths: bits of positive floats sort like these; of what is not visible, the largest
};

constexpr int kNotVisible = 0x7fffffff;

inline Vec3<float> color_of(const Camera& cam, const Parameters& P, Index n, const Vec3<float>& offset) {
  float Y[kMaxBands], inverse_distance;
  const Vec3<float> d = view_directions(cam, offset, inverse_distance), base = load3(P.sh0, n);
  sh_basis(P.sh_degree, d.x, d.y, d.z, Y);
  Vec3<float> c = {base.x * kSH0 + 0.5f, base.y * kSH0 + 0.5f, base.z * kSH0 + 0.5f};
  const int bands = (P.sh_degree + 1) * (P.sh_degree + 1) - 1;
  GLOBAL const float* shN = P.shN + 3 * P.sh_rest * n;
  for (int k = 0; k < kMaxBands; ++k)  // as many as are known when it is compiled: then they need no memory
    if (k < bands) c = c + load3(shN, k) * Y[k];
  return {max(c.x, 0.f), max(c.y, 0.f), max(c.z, 0.f)};
}

// The tiles of row y that a splat touches. Not inlined: counting tiles and listing them must agree to the bit.
NOT_INLINED Span tiles_of_row(GLOBAL const Record* r, int y) {
  const float top = static_cast<float>(y * kTile) + 0.5f - r->my;
  const Span span = span_of(r->mx, top, r->A, r->B, r->C, r->log2_opacity, static_cast<float>((r->x1 + 1) * kTile));
  return {span.x0 > r->x0 ? span.x0 : r->x0, span.x1 < r->x1 ? span.x1 : r->x1};
}

inline unsigned short tile_at(float x, int tiles) {
  return static_cast<unsigned short>(clamp(x * (1.f / kTile), 0.f, static_cast<float>(tiles)));
}

inline int count_tiles(GLOBAL const Record* r) {
  int count = 0;
  for (int y = r->y0; y < r->y1; ++y) {
    const Span span = tiles_of_row(r, y);
    count += span.x1 > span.x0 ? span.x1 - span.x0 : 0;
  }
  return count;
}

inline int radius_of(float reach) { return static_cast<int>(ceil(min(reach, 1073741824.f))); }

inline void project_one(const ProjectArguments& a, Index n) {
  const Splat3D<float> splat = load_splat(a.P, n);
  const Projected<float> p = project(a.camera, splat);
  const Ellipse<float> e = ellipse(p);
  const bool visible = is_visible(a.camera, p, e);
  a.radii[2 * n] = visible ? radius_of(e.reach_x) : 0;
  a.radii[2 * n + 1] = visible ? radius_of(e.reach_y) : 0;
  a.depths[n] = visible ? float_bits(p.t.z) : kNotVisible;
  a.tiles[n] = 0;
  if (!visible) return;
  const Vec3<float> c = color_of(a.camera, a.P, n, p.offset);
  a.records[n] = {p.mx, p.my, e.A, e.B, e.C, e.log2_opacity, c.x, c.y, c.z, p.t.z, tile_at(p.mx - e.reach_x, a.tiles_x),
      tile_at(p.mx + e.reach_x + kTile, a.tiles_x), tile_at(p.my - e.reach_y, a.tiles_y),
      tile_at(p.my + e.reach_y + kTile, a.tiles_y)};
  a.tiles[n] = count_tiles(a.records + n);
}

KERNEL(project_gaussians, ProjectArguments) {
  PHASE(t) {
    const Index n = static_cast<Index>(block()) * kThreads + t;
    if (n < a.P.count) project_one(a, n);
  }
}

// Tiles of the splats, front to back: those of one splat in its slots.
struct ListArguments {
  int count, tiles_x, no_tile;
  GLOBAL const Record* records;
  GLOBAL const Index *order, *ends;  // [count] ids front to back; end of the slots of each of these
  GLOBAL const int* tiles;           // [count] number of tiles of every Gaussian
  GLOBAL Index* first_slot;          // [count] of every Gaussian
  GLOBAL int* ids;                   // [slots]
  GLOBAL short* short_tiles;         // [slots], or null
  GLOBAL int* long_tiles;            // the same where a short does not hold them
};

inline void list_tile(const ListArguments& a, Index slot, Index id, int tile) {
  a.ids[slot] = static_cast<int>(id);
  if (a.short_tiles) a.short_tiles[slot] = static_cast<short>(tile);
  if (a.long_tiles) a.long_tiles[slot] = tile;
}

inline void list_one(const ListArguments& a, Index i) {
  const Index id = a.order[i], end = a.ends[i];
  Index slot = end - a.tiles[id];
  a.first_slot[id] = slot;
  GLOBAL const Record* r = a.records + id;
  if (slot == end) return;
  for (int y = r->y0; y < r->y1; ++y) {
    const Span span = tiles_of_row(r, y);
    for (int x = span.x0; x < span.x1 && slot < end; ++x) list_tile(a, slot++, id, y * a.tiles_x + x);
  }
  while (slot < end) list_tile(a, slot++, id, a.no_tile);
}

KERNEL(list_tiles, ListArguments) {
  PHASE(t) {
    const Index i = static_cast<Index>(block()) * kThreads + t;
    if (i < a.count) list_one(a, i);
  }
}

}  // namespace gsopt::GSOPT_ISA

// What forward and backward share inside one tile: splats in tile coordinates, and its pixels in blocks of 4x2 or 4x4.
// Coordinates are relative to the tile's center, so the numbers stay small wherever the tile lies in the image.
#pragma once
#include "../common/blend.h"
#include "columns.h"
#include "frame.h"
#include "parallel.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRecordsAhead = 16;  // splats of a tile lie anywhere in memory: ask for them early
constexpr int kBlockRows = kPixels / 4, kStrips = kTile / kBlockRows;

// The splats of a chunk as their records begin, x and y from the tile's center.
struct Local {
  struct alignas(32) Row {
    float x, y, A, B, C, log2_opacity, r, g;
  };
  Row row[kChunk];
  float b[kChunk], depth[kChunk];
};

struct TileGeometry {
  float x, y;  // its center, px
};
inline TileGeometry tile_geometry(const Frame& frame, int tile) {
  return {static_cast<float>(tile % frame.tiles_x * kTile + kTile / 2),
      static_cast<float>(tile / frame.tiles_x * kTile + kTile / 2)};
}

// Records lie anywhere in memory: those of entries [begin, end) of the frame are asked for long before they are needed,
// into the second cache; `load_chunk` asks again, for the first.
inline void prefetch_records(const Frame& frame, int64_t begin, int64_t end) {
  const Entry* entries = frame.entries.as<Entry>();
  const Record* records = frame.records.as<Record>();
  end = end < frame.intersections ? end : frame.intersections;
  for (int64_t k = begin > 0 ? begin : 0; k < end; ++k) __builtin_prefetch(&records[entries[k].id], 0, 2);
}

// Calls body(k, worker) for k = 0 ... tiles - 1. A worker gets several in a row: a tile prefetches the records of the
// next.
template <class Body> inline void for_each_tile_of(Pool& pool, const Frame& frame, Body&& body) {
  const int fair = frame.tiles() / (16 * pool.threads()), run = fair < 1 ? 1 : (fair < 16 ? fair : 16);
  parallel(pool, divide_up(frame.tiles(), run), [&](int item, int worker) {
    for (int k = item * run; k < frame.tiles() && k < (item + 1) * run; ++k) body(k, worker);
  });
}

inline void load_chunk(const Frame& frame, const Entry* entries, int n, TileGeometry tile, Local& local) {
  const Record* records = frame.records.as<Record>();
  const f8 origin = {tile.x, tile.y, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f};
  for (int i = 0; i < n; ++i) {
    __builtin_prefetch(&records[entries[i + kRecordsAhead < n ? i + kRecordsAhead : i].id]);
    const Record& r = records[entries[i].id];
    store8(&local.row[i].x, load8(&r.mx) - origin);
    local.b[i] = r.b;
    local.depth[i] = r.depth;
  }
}

// The pixel coordinates of every block's lanes, rows of four, from the tile's center.
struct alignas(64) BlockPixels {
  float x[kBlocks][kPixels], y[kBlocks][kPixels];
  constexpr BlockPixels() : x(), y() {
    for (int block = 0; block < kBlocks; ++block)
      for (int k = 0; k < kPixels; ++k) {
        x[block][k] = static_cast<float>(4 * (block % 4) + k % 4) - 7.5f;
        y[block][k] = static_cast<float>(kBlockRows * (block / 4) + k / 4) - 7.5f;
      }
  }
};
inline constexpr BlockPixels kBlockPixels;

// A splat in every lane.
inline Spread<px> spread(const Local::Row& s, float u0, float v0) {
  return {splat<px>(s.A), splat<px>(s.B), splat<px>(s.C), splat<px>(u0), splat<px>(v0), splat<px>(s.log2_opacity)};
}

inline Vec3<px> splat_color(const Local& local, int i) {
  return {splat<px>(local.row[i].r), splat<px>(local.row[i].g), splat<px>(local.b[i])};
}

// Calls visit(pixel of the image, lane, n) for the rows of a block, n <= 4 of whose pixels lie inside the image.
template <class Visit> inline void for_each_row(const Frame& frame, int tile, int block, Visit&& visit) {
  const int x0 = tile % frame.tiles_x * kTile + 4 * (block % 4),
            y0 = tile / frame.tiles_x * kTile + kBlockRows * (block / 4);
  const int w = frame.camera.width, h = frame.camera.height, n = w - x0 < 4 ? w - x0 : 4;
  for (int row = 0; n > 0 && row < kBlockRows && y0 + row < h; ++row)
    visit(static_cast<int64_t>(y0 + row) * w + x0, 4 * row, n);
}

// The first n of four floats, and of four pixels of interleaved RGB; zeros instead of the others.
inline f4 load4_first(const float* p, int n) {
  if (n == 4) return load4(p);
  float v[4] = {};
  std::memcpy(v, p, sizeof(float) * n);
  return load4(v);
}
inline void store4_first(float* p, f4 v, int n) {
  if (n == 4) return store4(p, v);
  std::memcpy(p, &v, sizeof(float) * n);
}
struct Rgb {
  f4 r, g, b;
};
inline Rgb load_rgb(const float* p, int n) {
  if (n < 4) {
    float v[12] = {};
    std::memcpy(v, p, sizeof(float) * 3 * n);
    return load_rgb(v, 4);
  }
  const f4 low = load4(p), mid = load4(p + 4), high = load4(p + 8);
  return {__builtin_shufflevector(__builtin_shufflevector(low, mid, 0, 3, 6, 6), high, 0, 1, 2, 5),
      __builtin_shufflevector(__builtin_shufflevector(low, mid, 1, 4, 7, 7), high, 0, 1, 2, 6),
      __builtin_shufflevector(__builtin_shufflevector(low, mid, 2, 5, 5, 5), high, 0, 1, 4, 7)};
}
inline void store_rgb(float* p, const Rgb& c, int n) {
  if (n < 4) {
    float v[12];
    store_rgb(v, c, 4);
    std::memcpy(p, v, sizeof(float) * 3 * n);
    return;
  }
  const f4 low = __builtin_shufflevector(c.r, c.g, 0, 4, 1, 5), high = __builtin_shufflevector(c.r, c.g, 2, 6, 3, 7);
  store4(p, __builtin_shufflevector(low, c.b, 0, 1, 4, 2));
  store4(p + 4, __builtin_shufflevector(__builtin_shufflevector(low, c.b, 3, 5, 5, 5), high, 0, 1, 4, 5));
  store4(p + 8, __builtin_shufflevector(high, c.b, 6, 2, 3, 7));
}

}  // namespace gsopt::GSOPT_ISA

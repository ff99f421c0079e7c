// What forward and backward share inside one tile: splats in tile coordinates, and which blocks of 4x2 or 4x4 pixels each one touches.
// Coordinates are relative to the tile's centre, so the numbers stay small wherever the tile lies in the image.
#pragma once
#include "frame.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRecordsAhead = 16;  // splats of a tile lie anywhere in memory: ask for them early
constexpr int kBlockRows = kPixels / 4, kStrips = kTile / kBlockRows;

// The splats of a chunk as their records begin, x and y from the tile's centre.
struct Local {
  struct alignas(32) Row {
    float x, y, A, B, C, log2_opacity, r, g;
  };
  Row row[kChunk];
  float b[kChunk], depth[kChunk];
};

struct TileGeometry {
  float x, y;  // its centre, px
};
inline TileGeometry tile_geometry(const Frame& frame, int tile) {
  return {static_cast<float>(tile % frame.tiles_x * kTile + kTile / 2),
          static_cast<float>(tile / frame.tiles_x * kTile + kTile / 2)};
}

// Per lane the bits of the blocks with a pixel that the ellipse alpha >= 1/255 reaches: bit 4 strip + column. A row of
// pixels crosses the ellipse from c - h to c + h, c = dx - B/A y and (A h)² = t - (C y)²; a strip is as wide as its rows
// together. `sqrt_near` is off by 4e-4 at most, so h is taken 4e-4 too large.
inline i8 block_masks(f8 A, f8 B, f8 C, f8 lo, f8 dx, f8 dy) {
  const f8 zero = splat<f8>(0.f), huge = splat<f8>(1e30f), t = (lo - kLog2AlphaMin) * 1.0001f + 1e-3f;
  const f8 iA = splat<f8>(1.0004f) / A, slope = B / A;
  const f8 margin = (abs(dx) + abs(slope) * (abs(dy) + 8.f)) * 2e-6f + 0.02f;
  i8 mask = splat8i(0);
  for (int strip = 0; strip < kStrips; ++strip) {
    f8 left = huge, right = zero - huge;
    for (int row = 0; row < kBlockRows; ++row) {
      const f8 y = splat<f8>(static_cast<float>(kBlockRows * strip + row) - 7.5f) - dy, center = dx - slope * y, v = C * y;
      const f8 half = sqrt_near(t - v * v) * iA;  // NaN, which leaves both bounds alone, where the row misses the ellipse
      left = min(center - half, left), right = max(center + half, right);
    }
    // Column k holds the centres 4 k - 7.5 ... 4 k - 4.5: those from `first` on and before `behind` are touched.
    const i8 behind = to_int(clamp((right + margin) * 0.25f + 2.875f, zero, splat<f8>(4.5f)));
    const i8 first = splat8i(4) - to_int(clamp((margin - left) * 0.25f + 2.875f, zero, splat<f8>(4.5f)));
    mask |= (shift_left(splat8i(15), first) & ~shift_left(splat8i(255), behind)) << (4 * strip);
  }
  return mask;
}

inline void load_chunk(const Frame& frame, const Entry* entries, int n, TileGeometry tile, Local& local) {
  const Record* records = frame.records.as<Record>();
  const f8 origin = {tile.x, tile.y, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f};
  for (int i = 0; i < n; ++i) {
    __builtin_prefetch(&records[entries[i + kRecordsAhead < n ? i + kRecordsAhead : i].id]);
    const Record& r = records[entries[i].id];
    store8(&local.row[i].x, load8(&r.mx) - origin);
    local.b[i] = r.b, local.depth[i] = r.depth;
  }
}

// The blocks that each of n splats touches.
inline void touched_blocks(const Local& local, int n, uint32_t masks[kChunk]) {
  for (int i = 0; i < n; i += kLanes) {
    f8 v[8];
    for (int l = 0; l < kLanes; ++l) v[l] = load8(&local.row[i + l < n ? i + l : i].x);
    transpose8(v);
    store8i(reinterpret_cast<int32_t*>(masks) + i, block_masks(v[2], v[3], v[4], v[5], v[0], v[1]));
  }
}

// The pixel coordinates of every block's lanes, rows of four, from the tile's centre.
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

// One splat with its numbers spread over the lanes, and its exponent at a block's pixels:
// exponent(X, Y) = log2_opacity - (A X + B Y + u0)² - (C Y + v0)²
struct Spread {
  px A, B, C, u0, v0, log2_opacity;
  explicit Spread(const Local::Row& r)
      : A(splat<px>(r.A)), B(splat<px>(r.B)), C(splat<px>(r.C)), u0(splat<px>(-(r.A * r.x + r.B * r.y))), v0(splat<px>(-r.C * r.y)),
        log2_opacity(splat<px>(r.log2_opacity)) {}
};
struct Exponent {
  px u, v, e;
};
inline Exponent exponent(const Spread& s, int block) {
  const px X = load_px(kBlockPixels.x[block]), Y = load_px(kBlockPixels.y[block]);
  Exponent out;
  out.u = s.A * X + (s.B * Y + s.u0), out.v = s.C * Y + s.v0;
  out.e = s.log2_opacity - out.v * out.v - out.u * out.u;  // v is ready first
  return out;
}

// The alphas of one splat at the pixels of the blocks of a mask, one block after the other; 0 where they are not drawn.
struct Alphas {
  px alpha[kBlocks], u[kBlocks], v[kBlocks];
};
template <bool Moments> inline void alphas_of(const Spread& splat_i, uint32_t mask, Alphas& out) {
  const px threshold = splat<px>(kLog2AlphaMin), alpha_max = splat<px>(kAlphaMax);
  int n = 0;
  for (uint32_t rest = mask; rest; rest &= rest - 1, ++n) {
    const Exponent x = exponent(splat_i, __builtin_ctz(rest));
    out.alpha[n] = keep(x.e >= threshold, min(exp2(x.e), alpha_max));
    if (Moments) out.u[n] = x.u, out.v[n] = x.v;
  }
}

// Calls visit(pixel of the image, lane, n) for the rows of a block, each the n <= 4 of its pixels that lie inside the image.
template <class Visit> inline void for_each_row(const Frame& frame, int tile, int block, Visit&& visit) {
  const int x0 = tile % frame.tiles_x * kTile + 4 * (block % 4), y0 = tile / frame.tiles_x * kTile + kBlockRows * (block / 4);
  const int w = frame.camera.width, h = frame.camera.height, n = w - x0 < 4 ? w - x0 : 4;
  for (int row = 0; n > 0 && row < kBlockRows && y0 + row < h; ++row) visit(static_cast<int64_t>(y0 + row) * w + x0, 4 * row, n);
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
  float v[12] = {};
  if (n < 4) p = static_cast<const float*>(std::memcpy(v, p, sizeof(float) * 3 * n));
  const f4 low = load4(p), mid = load4(p + 4), high = load4(p + 8);
  return {__builtin_shufflevector(__builtin_shufflevector(low, mid, 0, 3, 6, 6), high, 0, 1, 2, 5),
          __builtin_shufflevector(__builtin_shufflevector(low, mid, 1, 4, 7, 7), high, 0, 1, 2, 6),
          __builtin_shufflevector(__builtin_shufflevector(low, mid, 2, 5, 5, 5), high, 0, 1, 4, 7)};
}
inline void store_rgb(float* p, const Rgb& c, int n) {
  const f4 low = __builtin_shufflevector(c.r, c.g, 0, 4, 1, 5), high = __builtin_shufflevector(c.r, c.g, 2, 6, 3, 7);
  const f4 v[3] = {__builtin_shufflevector(low, c.b, 0, 1, 4, 2),
                   __builtin_shufflevector(__builtin_shufflevector(low, c.b, 3, 5, 5, 5), high, 0, 1, 4, 5),
                   __builtin_shufflevector(high, c.b, 6, 2, 3, 7)};
  if (n < 4) {
    std::memcpy(p, v, sizeof(float) * 3 * n);
  } else {
    for (int k = 0; k < 3; ++k) store4(p + 4 * k, v[k]);
  }
}

}  // namespace gsopt::GSOPT_ISA

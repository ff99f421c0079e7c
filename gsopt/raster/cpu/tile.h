// What forward and backward share inside one tile: splats in tile coordinates, and which blocks of 4x2 or 4x4 pixels each one touches.
// Coordinates are relative to the tile's centre, so the numbers stay small wherever the tile lies in the image.
#pragma once
#include "frame.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kBlockRows = kPixels / 4, kStrips = kTile / kBlockRows;

// exponent(X, Y) = log2_opacity - (A X + B Y + u0)² - (C Y + v0)²
struct Local {
  static constexpr int kSize = kChunk;
  alignas(64) float A[kSize], B[kSize], C[kSize], u0[kSize], v0[kSize], log2_opacity[kSize];
  alignas(64) float r[kSize], g[kSize], b[kSize], depth[kSize];
};

struct TileGeometry {
  float x, y;  // its centre, px
};
inline TileGeometry tile_geometry(const Frame& frame, int tile) {
  return {static_cast<float>(tile % frame.tiles_x * kTile + kTile / 2),
          static_cast<float>(tile / frame.tiles_x * kTile + kTile / 2)};
}

// Per lane the bits of the blocks that the ellipse alpha >= 1/255 touches: bit 4 strip + column. Over a strip of
// pixel rows the ellipse's right end lies at the strip's y nearest to that of its rightmost point; left mirrors it.
inline i8 block_masks(f8 A, f8 B, f8 C, f8 lo, f8 dx, f8 dy) {
  const f8 zero = splat<f8>(0.f), t = (lo - kLog2AlphaMin) * 1.0001f + 1e-3f;
  const f8 iA = splat<f8>(1.f) / A, slope = B * iA;
  const f8 extreme = zero - B / C * sqrt(max(t, zero) / (B * B + C * C));
  i8 mask = splat8i(0);
  for (int strip = 0; strip < kStrips; ++strip) {
    const f8 top = splat<f8>(static_cast<float>(kBlockRows * strip) - 7.5f) - dy, bottom = top + (kBlockRows - 1.f);
    const f8 yr = clamp(extreme, top, bottom), yl = clamp(zero - extreme, top, bottom);
    const f8 cr = C * yr, cl = C * yl, sr = t - cr * cr, sl = t - cl * cl;
    const f8 margin = abs(slope * yr) * 2e-6f + abs(dx) * 2e-6f + 0.02f;
    const f8 right = dx - slope * yr + sqrt(max(sr, zero)) * iA + margin;
    const f8 left = dx - slope * yl - sqrt(max(sl, zero)) * iA - margin;
    // Column k holds the centres 4 k - 7.5 ... 4 k - 4.5: columns [first, behind) are touched.
    const i8 behind = to_int(clamp((right + 11.5f) * 0.25f, zero, splat<f8>(4.5f)));
    const i8 first = splat8i(4) - to_int(clamp(splat<f8>(4.f) - (left + 4.5f) * 0.25f, zero, splat<f8>(4.5f)));
    const i8 one = splat8i(1);
    const i8 columns = (shift_left(one, behind) - one) & ~(shift_left(one, first) - one);
    mask |= (columns & ((sr >= 0.f) | (sl >= 0.f))) << (4 * strip);
  }
  return mask & (t > 0.f);
}

// Loads entries [0, n) of a chunk, eight at a time; with `masks`, also the blocks that each one touches.
inline void load_chunk(const Frame& frame, const Entry* entries, int n, TileGeometry tile, Local& local, uint32_t* masks) {
  const Record* records = frame.records.as<Record>();
  for (int i = 0; i < n; i += kLanes) {
    f8 v[8];
    for (int l = 0; l < kLanes; ++l) {
      const Record& r = records[entries[i + l < n ? i + l : i].id];
      v[l] = load8(&r.mx);
      local.b[i + l] = r.b, local.depth[i + l] = r.depth;
    }
    transpose8(v);
    const f8 dx = v[0] - tile.x, dy = v[1] - tile.y, A = v[2], B = v[3], C = v[4], lo = v[5];
    store8(local.A + i, A), store8(local.B + i, B), store8(local.C + i, C);
    store8(local.u0 + i, splat<f8>(0.f) - (A * dx + B * dy)), store8(local.v0 + i, splat<f8>(0.f) - C * dy);
    store8(local.log2_opacity + i, lo), store8(local.r + i, v[6]), store8(local.g + i, v[7]);
    if (masks) store8i(reinterpret_cast<int32_t*>(masks) + i, block_masks(A, B, C, lo, dx, dy));
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

// One splat with its numbers spread over the lanes, and its exponent at a block's pixels.
struct Spread {
  px A, B, C, u0, v0, log2_opacity;
  Spread(const Local& l, int i)
      : A(splat<px>(l.A[i])), B(splat<px>(l.B[i])), C(splat<px>(l.C[i])), u0(splat<px>(l.u0[i])), v0(splat<px>(l.v0[i])), log2_opacity(splat<px>(l.log2_opacity[i])) {}
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

// Calls visit(pixel of the image, lane) for the lanes of a block that lie inside the image.
template <class Visit> inline void for_each_pixel(const Frame& frame, int tile, int block, Visit&& visit) {
  const int x0 = tile % frame.tiles_x * kTile + 4 * (block % 4), y0 = tile / frame.tiles_x * kTile + kBlockRows * (block / 4);
  const int w = frame.camera.width, h = frame.camera.height;
  for (int y = 0; y < kBlockRows && y0 + y < h; ++y)
    for (int x = 0; x < 4 && x0 + x < w; ++x) visit(static_cast<int64_t>(y0 + y) * w + x0 + x, 4 * y + x);
}

}  // namespace gsopt::GSOPT_ISA

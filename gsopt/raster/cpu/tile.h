// What forward and backward share inside one tile: splats in tile coordinates, and which blocks of 4x2 or 4x4 pixels each one touches.
// Coordinates are relative to the tile's centre, so the numbers stay small wherever the tile lies in the image.
#pragma once
#include "frame.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kBlockRows = kPixels / 4, kStrips = kTile / kBlockRows;

// exponent(X, Y) = log2_opacity - (A X + B Y + u0)² - (C Y + v0)²
struct Local {
  static constexpr int kSize = kChunk + kLanes;  // the entry behind the last one is nowhere: it pads odd lists
  alignas(64) float A[kSize], B[kSize], C[kSize], u0[kSize], v0[kSize], log2_opacity[kSize];
  alignas(64) float r[kSize], g[kSize], b[kSize], depth[kSize], dx[kSize], dy[kSize];
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

// 0, 1, 2, ...: a broadcast from memory is cheaper than moving a counter into a vector register.
struct Counting {
  int32_t at[kChunk + 1];
  constexpr Counting() : at() {
    for (int k = 0; k <= kChunk; ++k) at[k] = k + 1;
  }
};
inline constexpr Counting kOneBased;

// The positions of the set bits of every byte, ascending.
struct BitPositions {
  alignas(16) uint16_t of[256][8];
  constexpr BitPositions() : of() {
    for (int byte = 0; byte < 256; ++byte)
      for (int bit = 0, n = 0; bit < 8; ++bit)
        if (byte >> bit & 1) of[byte][n++] = static_cast<uint16_t>(bit);
  }
};
inline constexpr BitPositions kBitPositions;

constexpr int kListSize = kChunk + 2 + 8;  // one entry in front, one behind, and room for whole vectors

// Indices of the set bits of a block's words, ascending, up to `highest`; then one that is nowhere. Returns how many.
// Eight bits at a time, without a branch that depends on them.
inline int list_block(const uint64_t (*words)[kBlocks], int n_words, int block, int highest, int nowhere, uint16_t* list) {
  using u16x8 = uint16_t __attribute__((vector_size(16), aligned(2), may_alias));
  int n = 1;  // one nowhere in front as well, for lists that are read from the back
  list[0] = static_cast<uint16_t>(nowhere);
  for (int w = 0; w < n_words; ++w) {
    uint64_t rest = words[w][block];
    const int above = highest - 64 * w;
    if (above < 63) rest &= above < 0 ? 0 : (uint64_t{2} << above) - 1;
    for (int first = 64 * w; rest; rest >>= 8, first += 8) {
      const int byte = static_cast<int>(rest & 255);
      *reinterpret_cast<u16x8*>(list + n) = *reinterpret_cast<const u16x8*>(kBitPositions.of[byte]) + static_cast<uint16_t>(first);
      n += __builtin_popcount(byte);
    }
  }
  list[n] = static_cast<uint16_t>(nowhere);
  return n - 1;
}

// Exponents of two splats at a block's pixels, and what their gradients are made of.
struct Exponents {
  px2 u, v, e;
};
inline px2 splat_two(const float* p, int i, int j) { return {splat<px>(p[i]), splat<px>(p[j])}; }
inline Exponents exponents(const Local& l, int i, int j, px X, px Y) {
  const px2 XX = {X, X}, YY = {Y, Y};
  Exponents out;
  out.u = splat_two(l.A, i, j) * XX + (splat_two(l.B, i, j) * YY + splat_two(l.u0, i, j));
  out.v = splat_two(l.C, i, j) * YY + splat_two(l.v0, i, j);
  out.e = splat_two(l.log2_opacity, i, j) - out.v * out.v - out.u * out.u;  // v is ready first
  return out;
}

constexpr float kNowhere = -1e30f;  // log2_opacity of the padding

// Loads entries [0, n) of a chunk; pads to a multiple of eight, and at least by one. With `words`, also the block masks: bit k of
// words[w][block] says whether splat 64 w + k touches the block.
inline void load_chunk(const Frame& frame, const Entry* entries, int n, TileGeometry tile, Local& local, uint64_t (*words)[kBlocks]) {
  static const Record nowhere = {0.f, 0.f, 1.f, 0.f, 1.f, kNowhere, 0.f, 0.f, 0.f, 1.f, 0, 0, 0, 0, 0, 0, 0};
  const Record* records = frame.records.as<Record>();
  if (words) std::memset(words, 0, sizeof(uint64_t) * kBlocks * ((n + 63) / 64));
  for (int i = 0; i <= n; i += kLanes) {
    f8 v[8];
    for (int l = 0; l < kLanes; ++l) {
      const Record& r = i + l < n ? records[entries[i + l].id] : nowhere;
      v[l] = load8(&r.mx);
      local.b[i + l] = r.b, local.depth[i + l] = r.depth;
    }
    transpose8(v);
    const f8 dx = v[0] - tile.x, dy = v[1] - tile.y, A = v[2], B = v[3], C = v[4], lo = v[5];
    store8(local.A + i, A), store8(local.B + i, B), store8(local.C + i, C);
    store8(local.dx + i, dx), store8(local.dy + i, dy);
    store8(local.u0 + i, splat<f8>(0.f) - (A * dx + B * dy)), store8(local.v0 + i, splat<f8>(0.f) - C * dy);
    store8(local.log2_opacity + i, lo), store8(local.r + i, v[6]), store8(local.g + i, v[7]);
    if (!words || i >= n) continue;
    const i8 mask = block_masks(A, B, C, lo, dx, dy);
    gather_bits<kBlocks>(mask, reinterpret_cast<uint8_t*>(words[i / 64]) + i / 8 % 8, sizeof(uint64_t));
  }
}

// The pixel coordinates of a block's lanes: rows of four.
inline void block_pixels(int block, px& X, px& Y) {
  alignas(64) float x[kPixels], y[kPixels];
  for (int k = 0; k < kPixels; ++k) {
    x[k] = static_cast<float>(4 * (block % 4) + k % 4) - 7.5f;
    y[k] = static_cast<float>(kBlockRows * (block / 4) + k / 4) - 7.5f;
  }
  X = load_px(x), Y = load_px(y);
}

// Calls visit(pixel of the image, lane) for the lanes of a block that lie inside the image.
template <class Visit> inline void for_each_pixel(const Frame& frame, int tile, int block, Visit&& visit) {
  const int x0 = tile % frame.tiles_x * kTile + 4 * (block % 4), y0 = tile / frame.tiles_x * kTile + kBlockRows * (block / 4);
  const int w = frame.camera.width, h = frame.camera.height;
  for (int y = 0; y < kBlockRows && y0 + y < h; ++y)
    for (int x = 0; x < 4 && x0 + x < w; ++x) visit(static_cast<int64_t>(y0 + y) * w + x0 + x, 4 * y + x);
}

}  // namespace gsopt::GSOPT_ISA

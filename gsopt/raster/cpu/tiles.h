// Which tiles a splat is listed in: those where its ellipse alpha >= 1/255 reaches a pixel centre (up to a small
// margin).
//
// (A x + B y)² + (C y)² = t bounds the ellipse. Over a strip of rows its right end lies at the strip's y nearest to
// that of its rightmost point, y_r = -B/C sqrt(t / (B² + C²)); its left end mirrors that. Tile x holds the pixel
// centres 16 x + 0.5 ... 16 x + 15.5.
#pragma once
#include "frame.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kMaskSide = 8;  // boxes of at most 8x8 tiles carry a mask: bit 8 row + column, relative to (x0, y0)

struct TileBox {
  int x0, x1, y0, y1;  // half open
  bool masked() const { return x1 - x0 <= kMaskSide && y1 - y0 <= kMaskSide; }
};

// The boxes of a vector of splats; empty where they are not seen.
struct TileBoxes {
  widei x0, x1, y0, y1;
};
inline TileBoxes tile_boxes(const Frame& frame, wide mx, wide my, wide rx, wide ry, widei seen) {
  constexpr float inv = 1.f / kTile;
  const auto within = [&](wide tile, int tiles) {
    return to_int(clamp(tile, splat<wide>(0.f), splat<wide>(static_cast<float>(tiles)))) & seen;
  };
  return {within((mx - rx) * inv, frame.tiles_x), within((mx + rx) * inv + 1.f, frame.tiles_x),
          within((my - ry) * inv, frame.tiles_y), within((my + ry) * inv + 1.f, frame.tiles_y)};
}

// Which tiles of their boxes a vector of splats touches, rows 0 to 3 and 4 to 7; of a box that is larger the result is
// arbitrary.
struct TileMasks {
  widei low, high;
};
inline TileMasks tile_masks(wide mx, wide my, wide A, wide B, wide C, wide lo, const TileBoxes& boxes) {
  const widei columns = boxes.x1 - boxes.x0, rows = boxes.y1 - boxes.y0, one = splat_widei(1),
              inside = shift_left(one, columns) - one;
  const int highest = most(rows & (columns <= kMaskSide) & (rows <= kMaskSide));
  const wide zero = splat<wide>(0.f), t = (lo - kLog2AlphaMin) * 1.0001f + 1e-3f, iA = splat<wide>(1.f) / A,
             slope = B * iA;
  const wide extreme = zero - B / C * sqrt(max(t, zero) / (B * B + C * C));
  const wide x = mx - to_float(boxes.x0) * static_cast<float>(kTile),
             first_row = to_float(boxes.y0) * static_cast<float>(kTile) + 0.5f - my;
  TileMasks out = {splat_widei(0), splat_widei(0)};
  for (int row = 0; row < highest; ++row) {
    const wide top = first_row + static_cast<float>(row * kTile), bottom = top + (kTile - 1.f);
    const wide yr = clamp(extreme, top, bottom), yl = clamp(zero - extreme, top, bottom);
    const wide cr = C * yr, cl = C * yl, sr = t - cr * cr, sl = t - cl * cl;
    const wide margin = (abs(slope * yr) + abs(mx)) * 2e-6f + 0.02f;
    const wide right = x - slope * yr + sqrt(max(sr, zero)) * iA + margin;
    const wide left = x - slope * yl - sqrt(max(sl, zero)) * iA - margin;
    const widei behind = to_int(clamp((right + (kTile - 0.5f)) * (1.f / kTile), zero, splat<wide>(kMaskSide + 0.5f)));
    const widei first =
        splat_widei(kMaskSide) - to_int(clamp(splat<wide>(kMaskSide) - (left - (kTile - 0.5f)) * (1.f / kTile), zero,
                                              splat<wide>(kMaskSide + 0.5f)));
    const widei touched = (shift_left(one, behind) - one) & ~(shift_left(one, first) - one) & inside &
                          ((sr >= 0.f) | (sl >= 0.f)) & (rows > row);
    (row < 4 ? out.low : out.high) |= touched << (kMaskSide * (row % 4));
  }
  return out;
}

struct Span {
  int x0, x1;  // half open
};
// The tiles of row y that a splat touches. Not inlined: those who count tiles and those who list them must agree to the
// bit.
[[gnu::noinline]] inline Span tiles_of_row(const Record& r, int y) {
  const float t = (r.log2_opacity - kLog2AlphaMin) * 1.0001f + 1e-3f;
  const float iA = 1.f / r.A, slope = r.B * iA;
  const float extreme = -(r.B / r.C) * __builtin_sqrtf(t / (r.B * r.B + r.C * r.C));
  const auto limit = [](float v, float lo, float hi) { return v < lo ? lo : (v > hi ? hi : v); };
  const float top = static_cast<float>(y * kTile) + 0.5f - r.my, bottom = top + (kTile - 1);
  const float yr = limit(extreme, top, bottom), yl = limit(-extreme, top, bottom);
  const float sr = t - r.C * yr * (r.C * yr), sl = t - r.C * yl * (r.C * yl);
  if (sr < 0.f && sl < 0.f) return {0, 0};
  const float margin = 0.02f + 2e-6f * (__builtin_fabsf(slope * yr) + __builtin_fabsf(r.mx));
  const float right = r.mx - slope * yr + __builtin_sqrtf(sr > 0.f ? sr : 0.f) * iA + margin;
  const float left = r.mx - slope * yl - __builtin_sqrtf(sl > 0.f ? sl : 0.f) * iA - margin;
  const int x0 = static_cast<int>(__builtin_ceilf(limit((left - (kTile - 0.5f)) * (1.f / kTile), -1.f, 65536.f)));
  const int x1 = static_cast<int>(__builtin_floorf(limit((right - 0.5f) * (1.f / kTile), -1.f, 65536.f))) + 1;
  return {x0 > r.x0 ? x0 : r.x0, x1 < r.x1 ? x1 : r.x1};
}

// Calls visit(tile) for every tile of splat `id`, row by row.
template <class Visit> inline void for_each_tile(const Frame& frame, const Cover& cover, uint32_t id, Visit&& visit) {
  if (cover.x0 == kAskRecord) {
    const Record& r = frame.records.as<Record>()[id];
    for (int y = r.y0; y < r.y1; ++y) {
      const Span span = frame.skips.tiles ? tiles_of_row(r, y) : Span{r.x0, r.x1};
      for (int x = span.x0; x < span.x1; ++x) visit(y * frame.tiles_x + x);
    }
    return;
  }
  const int corner = cover.y0 * frame.tiles_x + cover.x0;
  for (uint64_t rest = cover.tiles; rest; rest &= rest - 1) {
    const int bit = __builtin_ctzll(rest);
    visit(corner + bit / kMaskSide * frame.tiles_x + bit % kMaskSide);
  }
}

// The cover of splat `id`, whose record is there; its slot is yet the number of its tiles.
inline Cover cover_of(const Frame& frame, uint32_t id, const TileBox& box, uint64_t tiles) {
  if (frame.skips.tiles && box.masked())
    return {tiles, static_cast<uint16_t>(box.x0), static_cast<uint16_t>(box.y0),
            static_cast<uint32_t>(__builtin_popcountll(tiles))};
  Cover cover = {0, kAskRecord, kAskRecord, 0};
  uint32_t n = 0;
  for_each_tile(frame, cover, id, [&](int) { ++n; });
  cover.slot = n;
  return cover;
}

}  // namespace gsopt::GSOPT_ISA

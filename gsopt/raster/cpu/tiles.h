// The tiles that list a splat: those where its ellipse (docs/math.md, 8b, 8c) reaches a pixel center, or nearly.
//
// Over a strip of rows its right end lies in the row nearest to that of its rightmost point; its left end mirrors that.
// Tile x holds the pixel centers 16 x + 0.5 ... 16 x + 15.5.
#pragma once
#include "../common/reach.h"
#include "frame.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr float kMaskExtent = 9 * kTile;  // px: such a box and a tile
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

// Which tiles of their boxes a vector of splats touches, rows 0 to 3 and 4 to 7; arbitrary for a larger box.
struct TileMasks {
  widei low, high;
};
inline TileMasks tile_masks(wide mx, wide my, wide A, wide B, wide C, wide lo, const TileBoxes& boxes) {
  const widei columns = boxes.x1 - boxes.x0, rows = boxes.y1 - boxes.y0, one = splat_widei(1),
              inside = shift_left(one, columns) - one;
  const int highest = most(rows & (columns <= kMaskSide) & (rows <= kMaskSide));
  const Reach<wide> reach(A, B, C, lo);
  const wide rightmost = reach.rightmost(), x = mx - to_float(boxes.x0) * static_cast<float>(kTile),
             first_row = to_float(boxes.y0) * static_cast<float>(kTile) + 0.5f - my, zero = splat<wide>(0.f);
  const auto whole = [&](wide tiles) { return to_int(clamp(tiles, zero, splat<wide>(kMaskSide + 0.5f))); };
  TileMasks out = {splat_widei(0), splat_widei(0)};
  for (int row = 0; row < highest; ++row) {
    const StripEnds<wide> ends(reach, rightmost, first_row + static_cast<float>(row * kTile), x, mx, kMaskExtent);
    const widei behind = whole((ends.right + (kTile - 0.5f)) * (1.f / kTile));
    const widei first =
        splat_widei(kMaskSide) - whole(splat<wide>(kMaskSide) - (ends.left - (kTile - 0.5f)) * (1.f / kTile));
    const widei touched = (shift_left(one, behind) - one) & ~(shift_left(one, first) - one) & inside &
                          (ends.square >= 0.f) & (rows > row);
    (row < 4 ? out.low : out.high) |= touched << (kMaskSide * (row % 4));
  }
  return out;
}

// The tiles of row y that a splat touches. Not inlined: counting tiles and listing them must agree to the bit.
[[gnu::noinline]] inline Span tiles_of_row(const Record& r, int y) {
  const float top = static_cast<float>(y * kTile) + 0.5f - r.my;
  const Span span = span_of(r.mx, top, r.A, r.B, r.C, r.log2_opacity, static_cast<float>((r.x1 + 1) * kTile));
  return {span.x0 > r.x0 ? span.x0 : r.x0, span.x1 < r.x1 ? span.x1 : r.x1};
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

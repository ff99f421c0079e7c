// Which blocks of a tile each splat touches, and which splats touch a block.
#pragma once
#include "../common/reach.h"
#include "tile.h"

namespace gsopt::GSOPT_ISA {

// Per lane the bits of the blocks with a pixel that the ellipse alpha >= 1/255 reaches (docs/math.md, 8c): bit 4 strip
// + column. A strip is as wide as its rows together.
inline widei block_masks(wide A, wide B, wide C, wide lo, wide dx, wide dy) {
  const Reach<wide> reach(A, B, C, lo);
  const wide zero = splat<wide>(0.f), huge = splat<wide>(1e30f), width = reach.width * kSqrtNear;
  const wide margin = reach.margin(dx, dy, kTile);
  const auto whole = [&](wide x) { return to_int(clamp(x * 0.25f + 2.875f, zero, splat<wide>(4.5f))); };
  widei mask = splat_widei(0);
  for (int strip = 0; strip < kStrips; ++strip) {
    wide left = huge, right = -huge;
    for (int row = 0; row < kBlockRows; ++row) {
      const wide y = splat<wide>(static_cast<float>(kBlockRows * strip + row) - 7.5f) - dy;
      const wide center = dx - reach.slope * y;
      const wide half = sqrt_near(reach.square(y)) * width;  // NaN, which changes neither end, where the row misses
      left = min(center - half, left);
      right = max(center + half, right);
    }
    // Column k holds the centers 4 k - 7.5 ... 4 k - 4.5: those from `first` on and before `behind` are touched.
    const widei behind = whole(right + margin), first = splat_widei(4) - whole(margin - left);
    mask |= (shift_left(splat_widei(15), first) & ~shift_left(splat_widei(255), behind)) << (4 * strip);
  }
  return mask;
}

// What the splats of a chunk are in the tile's blocks.
struct Touched {
  alignas(64) uint32_t blocks[kChunk];       // bit b: block b
  alignas(64) float u0[kChunk], v0[kChunk];  // (u, v) at the tile's center
};

// Fills `touched` for n splats; the splats behind them, up to a full vector, touch nothing.
inline void find_touched(const Local& local, int n, uint32_t alive, bool every, Touched& touched) {
  int32_t* blocks = reinterpret_cast<int32_t*>(touched.blocks);
  for (int i = 0; i < n; i += kWide) {
    wide v[8];
    load_eights([&](int l) { return load8(&local.row[i + l].x); }, v);
    store_widei(blocks + i, every ? splat_widei(-1) : block_masks(v[2], v[3], v[4], v[5], v[0], v[1]));
    const Whitened<wide> center = at_center(v[2], v[3], v[4], v[0], v[1]);
    store_wide(touched.u0 + i, center.u);
    store_wide(touched.v0 + i, center.v);
  }
  for (int i = 0; i < n; ++i) touched.blocks[i] &= alive;
  for (int i = n; i % kWide; ++i) touched.blocks[i] = 0;
}

// For every set of lanes: which these are.
struct LaneLists {
  uint64_t of[256];
  constexpr LaneLists() : of() {
    for (int set = 0; set < 256; ++set)
      for (int lane = 0, n = 0; lane < 8; ++lane)
        if (set >> lane & 1) of[set] |= static_cast<uint64_t>(lane) << 8 * n++;
  }
};
inline constexpr LaneLists kLaneLists;

// Numbers of splats in a chunk; there is room for the vector that ends behind the last.
struct SplatList {
  uint8_t at[kChunk + kLanes];
  int count = 0;
};
static_assert(kChunk <= 256);

// Those of the n splats of a chunk that touch a block, in their order.
inline void list_splats(const Touched& touched, int n, int block, SplatList& list) {
  list.count = 0;
  for (int i = 0; i < n; i += kLanes) {
    const int set = movemask(load8i(reinterpret_cast<const int32_t*>(touched.blocks) + i) << (31 - block));
    const uint64_t lanes = kLaneLists.of[set] + static_cast<uint64_t>(i) * 0x0101010101010101ull;
    std::memcpy(list.at + list.count, &lanes, 8);
    list.count += __builtin_popcount(set);
  }
}

}  // namespace gsopt::GSOPT_ISA

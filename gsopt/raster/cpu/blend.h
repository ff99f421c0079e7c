// Stage 3: front-to-back compositing. Splat by splat, block by block: the splats of a tile change few of its blocks, and
// blocks do not wait for each other, so the processor works on several at once.
#pragma once
#include "parallel.h"
#include "tile.h"

namespace gsopt::GSOPT_ISA {

// What a block's pixels have become so far.
struct alignas(64) BlockState {
  float T[kPixels], r[kPixels], g[kPixels], b[kPixels], depth[kPixels];
  int32_t last[kPixels];  // entry of the tile that contributed last, -1 if none
};

// Blends splat `i` of a chunk, entry `index` of its tile, into the blocks of `mask`. Returns the blocks that terminated.
template <bool Depth, bool Count>
inline uint32_t blend_splat(const Local& local, int i, int index, uint32_t mask, BlockState* states, Work& work) {
  const Spread splat_i(local, i);
  const px r = splat<px>(local.r[i]), g = splat<px>(local.g[i]), b = splat<px>(local.b[i]), depth = splat<px>(local.depth[i]);
  const px t_min = splat<px>(kTransmittanceMin), threshold = splat<px>(kLog2AlphaMin), alpha_max = splat<px>(kAlphaMax);
  const pxi here = splat_pxi(index);
  uint32_t finished = 0;
  for (uint32_t rest = mask; rest; rest &= rest - 1) {
    const int block = __builtin_ctz(rest);
    BlockState& s = states[block];
    const px e = exponent(splat_i, block).e, T = load_px(s.T);
    const pxi pass = (e >= threshold) & (T > t_min);
    const px weight = keep(pass, min(exp2(e), alpha_max)) * T, left = T - weight;
    store_px(s.T, left);
    store_px(s.r, load_px(s.r) + weight * r);
    store_px(s.g, load_px(s.g) + weight * g);
    store_px(s.b, load_px(s.b) + weight * b);
    if (Depth) store_px(s.depth, load_px(s.depth) + weight * depth);
    store_pxi(s.last, max(load_pxi(s.last), pass & here));
    finished |= any(left > t_min) ? 0 : rest & -rest;
    if (Count) ++work.entries, work.pairs += __builtin_popcount(movemask(pass));
  }
  return finished;
}

inline void write_block(const Frame& frame, const ForwardOutput& out, int tile, int block, const BlockState& s) {
  const float* bg = frame.background;
  for_each_pixel(frame, tile, block, [&](int64_t pixel, int lane) {
    const float T = s.T[lane];
    out.colors[3 * pixel] = s.r[lane] + T * bg[0];
    out.colors[3 * pixel + 1] = s.g[lane] + T * bg[1];
    out.colors[3 * pixel + 2] = s.b[lane] + T * bg[2];
    out.alphas[pixel] = 1.f - T;
    if (out.depths) out.depths[pixel] = s.depth[lane];
  });
}

template <bool Depth, bool Count> inline void blend_tile(const Frame& frame, int tile, const ForwardOutput& out, Work& work) {
  const uint32_t begin = frame.tile_begin.as<uint32_t>()[tile], end = frame.tile_begin.as<uint32_t>()[tile + 1];
  uint32_t* masks = frame.masks.as<uint32_t>();
  const TileGeometry geometry = tile_geometry(frame, tile);
  BlockState states[kBlocks] = {};
  uint32_t alive = 0;
  for (int block = 0; block < kBlocks; ++block)
    for_each_pixel(frame, tile, block, [&](int64_t, int lane) { states[block].T[lane] = 1.f, alive |= 1u << block; });
  Local local;
  alignas(64) uint32_t touched[kChunk];
  uint32_t k = begin;
  for (uint32_t first = begin; first < end && alive; first += kChunk) {
    const int n = end - first < kChunk ? static_cast<int>(end - first) : kChunk;
    load_chunk(frame, frame.entries.as<Entry>() + first, n, geometry, local, touched);
    for (int i = 0; i < n && alive; ++i, ++k) {
      masks[k] = (frame.skips.tiles ? touched[i] : ~0u) & alive;
      const uint32_t finished = blend_splat<Depth, Count>(local, i, static_cast<int>(k - begin) + 1, masks[k], states, work);
      if (frame.skips.termination) alive &= ~finished;
    }
  }
  std::memset(masks + k, 0, sizeof(uint32_t) * (end - k));
  float* T = frame.transmittance.as<float>() + static_cast<int64_t>(tile) * kBlocks * kPixels;
  int32_t* last = frame.last.as<int32_t>() + static_cast<int64_t>(tile) * kBlocks * kPixels;
  for (int block = 0; block < kBlocks; ++block) {
    write_block(frame, out, tile, block, states[block]);
    std::memcpy(T + block * kPixels, states[block].T, sizeof(states[block].T));
    std::memcpy(last + block * kPixels, states[block].last, sizeof(states[block].last));
  }
}

inline void blend_stage(Pool& pool, Frame& frame, const ForwardOutput& out) {
  const auto blend = out.work ? (out.depths ? blend_tile<true, true> : blend_tile<false, true>)
                              : (out.depths ? blend_tile<true, false> : blend_tile<false, false>);
  parallel(pool, frame.tiles(), [&](int tile, int worker) {
    Work none;
    blend(frame, tile, out, out.work ? out.work[worker] : none);
  });
}

}  // namespace gsopt::GSOPT_ISA

// Stage 3: front-to-back compositing. Splat by splat, and for each twice over the blocks that it touches: its alphas, then
// what they do to the pixels. Blocks do not wait for each other, so the processor works on several at once; but it looks
// only some hundred instructions ahead, and in one long loop it would find too few blocks there.
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
  const Local::Row& row = local.row[i];
  const px r = splat<px>(row.r), g = splat<px>(row.g), b = splat<px>(local.b[i]), depth = splat<px>(local.depth[i]);
  const px t_min = splat<px>(kTransmittanceMin);
  const pxi here = splat_pxi(index);
  Alphas alphas;
  alphas_of<false>(Spread(row), mask, alphas);
  uint32_t finished = 0;
  int n = 0;
  for (uint32_t rest = mask; rest; rest &= rest - 1, ++n) {
    BlockState& s = states[__builtin_ctz(rest)];
    const px T = load_px(s.T);
    const pxi alive = T > t_min;
    const px weight = alphas.alpha[n] * keep(alive, T);
    store_px(s.T, T - weight);
    store_px(s.r, load_px(s.r) + weight * r);
    store_px(s.g, load_px(s.g) + weight * g);
    store_px(s.b, load_px(s.b) + weight * b);
    if (Depth) store_px(s.depth, load_px(s.depth) + weight * depth);
    store_pxi(s.last, max(load_pxi(s.last), alive & here));
    finished |= any(alive) ? 0 : rest & -rest;
    if (Count) ++work.entries, work.pairs += __builtin_popcount(movemask(weight > splat<px>(0.f)));
  }
  return finished;
}

inline void write_block(const Frame& frame, const ForwardOutput& out, int tile, int block, const BlockState& s) {
  const float* bg = frame.background;
  for_each_row(frame, tile, block, [&](int64_t pixel, int lane, int n) {
    const f4 T = load4(s.T + lane);
    store_rgb(out.colors + 3 * pixel, {load4(s.r + lane) + T * bg[0], load4(s.g + lane) + T * bg[1], load4(s.b + lane) + T * bg[2]}, n);
    store4_first(out.alphas + pixel, 1.f - T, n);
    if (out.depths) store4_first(out.depths + pixel, load4(s.depth + lane), n);
  });
}

template <bool Depth, bool Count> inline void blend_tile(const Frame& frame, int tile, const ForwardOutput& out, Work& work) {
  const uint32_t begin = frame.tile_begin.as<uint32_t>()[tile], end = frame.tile_begin.as<uint32_t>()[tile + 1];
  uint32_t* masks = frame.masks.as<uint32_t>();
  const TileGeometry geometry = tile_geometry(frame, tile);
  BlockState states[kBlocks] = {};
  uint32_t alive = 0;
  for (int block = 0; block < kBlocks; ++block)
    for_each_row(frame, tile, block, [&](int64_t, int lane, int n) {
      store4_first(states[block].T + lane, splat<f4>(1.f), n);
      alive |= 1u << block;
    });
  Local local;
  alignas(64) uint32_t touched[kChunk];
  uint32_t k = begin;
  for (uint32_t first = begin; first < end && alive; first += kChunk) {
    const int n = end - first < kChunk ? static_cast<int>(end - first) : kChunk;
    load_chunk(frame, frame.entries.as<Entry>() + first, n, geometry, local);
    touched_blocks(local, n, touched);
    for (int i = 0; i < n && alive; ++i, ++k) {
      masks[k] = (frame.skips.tiles ? touched[i] : ~0u) & alive;
      const uint32_t finished = blend_splat<Depth, Count>(local, i, static_cast<int>(k - begin) + 1, masks[k], states, work);
      if (frame.skips.termination) alive &= ~finished;
    }
  }
  for (; k < end; ++k) masks[k] = 0;  // a loop: where there are no splats there is no memory, and memset must have some
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

// Stage 3: front-to-back compositing (docs/math.md, 7 and 8), block by block: what its pixels have become stays in
// registers while the splats that touch it pass by, a batch at a time: first their alphas, which do not wait for each
// other, then what they do to the pixels.
#pragma once
#include "blocks.h"

namespace gsopt::GSOPT_ISA {

constexpr int kBatch = 8;  // splats; a block whose pixels are all opaque is left at the end of one

// What a block's pixels have become so far.
struct alignas(64) BlockState {
  float T[kPixels], r[kPixels], g[kPixels], b[kPixels], depth[kPixels];
  int32_t last[kPixels];  // number in the tile, from 1, of the last splat that found it not opaque; 0 if none
};

// The alphas (7) of n splats at the pixels of a block; 0 where they are not drawn.
inline void alphas_of(
    const Local& local, const Touched& touched, const uint8_t* list, int n, int block, px alphas[kBatch]) {
  const px X = load_px(kBlockPixels.x[block]), Y = load_px(kBlockPixels.y[block]);
  for (int j = 0; j < n; ++j) {
    const int i = list[j];
    Whitened<px> at;
    alphas[j] = alpha_of(exponent(spread(local.row[i], touched.u0[i], touched.v0[i]), X, Y, at));
  }
}

// Blends the splats of a list into a block by (8), `first` being the number of the chunk's first splat. True when all
// its pixels have become opaque.
template <bool Depth, bool Count> inline bool blend_block(const Local& local, const Touched& touched,
    const SplatList& list, int first, int block, bool stop, BlockState& s, Work& work) {
  const px t_min = splat<px>(kTransmittanceMin);
  // T goes on behind the splat at which a pixel became opaque, so that no splat waits for that; T_end does not.
  px T = load_px(s.T), T_end = T, depth = load_px(s.depth);
  Vec3<px> color = {load_px(s.r), load_px(s.g), load_px(s.b)};
  pxi last = load_pxi(s.last);
  px alphas[kBatch];
  bool opaque = false;
  for (int begin = 0; begin < list.count && !opaque; begin += kBatch) {
    const int n = list.count - begin < kBatch ? list.count - begin : kBatch;
    alphas_of(local, touched, list.at + begin, n, block, alphas);
    for (int j = 0; j < n; ++j) {
      const int i = list.at[begin + j];
      const pxi alive = T > t_min;
      const px alpha = alphas[j], weight = keep(alive, alpha) * T;
      T = T - alpha * T;
      T_end = select(alive, T, T_end);
      last = select(alive, splat_pxi(first + i), last);
      color = color + splat_color(local, i) * weight;
      if (Depth) depth = depth + weight * splat<px>(local.depth[i]);
      if (Count) {
        ++work.entries;
        work.pairs += __builtin_popcount(movemask(weight > splat<px>(0.f)));
      }
    }
    T = keep(T > t_min, T);
    opaque = stop && !any(T > t_min);
  }
  store_px(s.T, T_end);
  store_px(s.r, color.x);
  store_px(s.g, color.y);
  store_px(s.b, color.z);
  store_px(s.depth, depth);
  store_pxi(s.last, last);
  return opaque;
}

// Blends a chunk of n splats, `first` being the number of the first in its tile. Returns the blocks that are not opaque
// yet; `touched` keeps the blocks that each splat changed.
template <bool Depth, bool Count> inline uint32_t blend_chunk(
    const Local& local, int n, int first, uint32_t alive, bool stop, Touched& touched, BlockState* states, Work& work) {
  SplatList list;
  for (uint32_t rest = alive; rest; rest &= rest - 1) {
    const int block = __builtin_ctz(rest);
    list_splats(touched, n, block, list);
    if (!blend_block<Depth, Count>(local, touched, list, first, block, stop, states[block], work)) continue;
    alive &= ~(1u << block);
    const int last = most(load_pxi(states[block].last)) - first;
    for (int k = list.count; k > 0 && list.at[k - 1] > last; --k) touched.blocks[list.at[k - 1]] &= ~(1u << block);
  }
  return alive;
}

inline void write_block(const Frame& frame, const ForwardOutput& out, int tile, int block, const BlockState& s) {
  const float* bg = frame.background;
  for_each_row(frame, tile, block, [&](int64_t pixel, int lane, int n) {
    const f4 T = load4(s.T + lane);
    store_rgb(out.colors + 3 * pixel,
        {load4(s.r + lane) + T * bg[0], load4(s.g + lane) + T * bg[1], load4(s.b + lane) + T * bg[2]}, n);
    store4_first(out.alphas + pixel, 1.f - T, n);
    if (out.depths) store4_first(out.depths + pixel, load4(s.depth + lane), n);
  });
}

template <bool Depth, bool Count>
inline void blend_tile(const Frame& frame, int tile, const ForwardOutput& out, Work& work) {
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
  Touched touched;
  uint32_t k = begin;
  while (k < end && alive) {
    const int n = end - k < kChunk ? static_cast<int>(end - k) : kChunk;
    load_chunk(frame, frame.entries.as<Entry>() + k, n, geometry, local);
    prefetch_records(frame, k + n, k + n + kChunk);
    find_touched(local, n, alive, !frame.skips.tiles, touched);
    alive = blend_chunk<Depth, Count>(
        local, n, static_cast<int>(k - begin) + 1, alive, frame.skips.termination, touched, states, work);
    std::memcpy(masks + k, touched.blocks, sizeof(uint32_t) * n);
    k += n;
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
  for_each_tile_of(pool, frame, [&](int tile, int worker) {
    Work none;
    blend(frame, tile, out, out.work ? out.work[worker] : none);
  });
}

}  // namespace gsopt::GSOPT_ISA

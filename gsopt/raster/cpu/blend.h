// Stage 3: front-to-back compositing. A block's pixels keep their state in registers while its splats stream by.
#pragma once
#include "parallel.h"
#include "tile.h"

namespace gsopt::GSOPT_ISA {

struct BlockState {
  px T, r, g, b, depth;
  pxi last;
};

struct alignas(64) StoredState {
  float T[kPixels], r[kPixels], g[kPixels], b[kPixels], depth[kPixels];
  int32_t last[kPixels];
};

inline BlockState load_state(const StoredState& s) {
  return {load_px(s.T), load_px(s.r), load_px(s.g), load_px(s.b), load_px(s.depth), load_pxi(s.last)};
}
inline void store_state(StoredState& s, const BlockState& v) {
  store_px(s.T, v.T), store_px(s.r, v.r), store_px(s.g, v.g), store_px(s.b, v.b), store_px(s.depth, v.depth);
  store_pxi(s.last, v.last);
}

template <bool Depth> inline void blend_one(BlockState& s, pxi pass, px alpha, const Local& local, int j) {
  const px weight = keep(pass, alpha) * s.T;
  s.r = s.r + weight * splat<px>(local.r[j]);
  s.g = s.g + weight * splat<px>(local.g[j]);
  s.b = s.b + weight * splat<px>(local.b[j]);
  if (Depth) s.depth = s.depth + weight * splat<px>(local.depth[j]);
  s.T = s.T - weight;
  s.last = max(s.last, pass & splat_pxi(kOneBased.at[j]));
}

// Blends the splats named by `words` into one block, two at a time; false once every pixel has terminated.
template <bool Depth, bool Count>
inline bool blend_block(const Local& local, const uint64_t (*words)[kBlocks], int n_words, int block, int first, int count,
                        StoredState& stored, Work& work) {
  uint16_t buffer[kListSize];
  const int n = list_block(words, n_words, block, kChunk, count, buffer);
  const uint16_t* list = buffer + 1;
  px X, Y;
  block_pixels(block, X, Y);
  BlockState s = load_state(stored);
  const pxi before = s.last;
  s.last = splat_pxi(0);  // one-based within the chunk, 0 = none
  const px t_min = splat<px>(kTransmittanceMin), threshold = splat<px>(kLog2AlphaMin), alpha_max = splat<px>(kAlphaMax);
  pxi alive = s.T > t_min;
  for (int k = 0; k < n && any(alive); k += 2) {
    const int i = list[k], j = list[k + 1];
    const Exponents x = exponents(local, i, j, X, Y);
    const px2 alpha = exp2(x.e);
    const pxi pass_i = (x.e.a >= threshold) & alive;
    blend_one<Depth>(s, pass_i, min(alpha.a, alpha_max), local, i);
    const pxi pass_j = (x.e.b >= threshold) & (s.T > t_min);
    blend_one<Depth>(s, pass_j, min(alpha.b, alpha_max), local, j);
    alive = s.T > t_min;
    if (Count) work.entries += 1 + (j != count), work.pairs += __builtin_popcount(movemask(pass_i)) + __builtin_popcount(movemask(pass_j));
  }
  s.last = max(before, (s.last > splat_pxi(0)) & (s.last + splat_pxi(first - 1)));
  store_state(stored, s);
  return any(alive);
}

inline void write_block(const Frame& frame, const ForwardOutput& out, int tile, int block, const StoredState& s) {
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
  auto* words = reinterpret_cast<uint64_t(*)[kBlocks]>(frame.words.as<uint64_t>()) + frame.word_begin.as<uint32_t>()[tile];
  const TileGeometry geometry = tile_geometry(frame, tile);
  StoredState state[kBlocks] = {};
  for (int block = 0; block < kBlocks; ++block) {
    for (int k = 0; k < kPixels; ++k) state[block].last[k] = -1;
    for_each_pixel(frame, tile, block, [&](int64_t, int lane) { state[block].T[lane] = 1.f; });
  }
  Local local;
  uint32_t alive = static_cast<uint32_t>((uint64_t{1} << kBlocks) - 1);
  for (uint32_t first = begin; first < end && alive; first += kChunk) {
    const int n = end - first < kChunk ? static_cast<int>(end - first) : kChunk, n_words = (n + 63) / 64;
    load_chunk(frame, frame.entries.as<Entry>() + first, n, geometry, local, words);
    for (uint32_t rest = alive; rest; rest &= rest - 1) {
      const int block = __builtin_ctz(rest);
      if (!blend_block<Depth, Count>(local, words, n_words, block, static_cast<int>(first - begin), n, state[block], work)) alive &= ~(1u << block);
    }
    words += n_words;
  }
  float* T = frame.transmittance.as<float>() + static_cast<int64_t>(tile) * kBlocks * kPixels;
  int32_t* last = frame.last.as<int32_t>() + static_cast<int64_t>(tile) * kBlocks * kPixels;
  for (int block = 0; block < kBlocks; ++block) {
    write_block(frame, out, tile, block, state[block]);
    std::memcpy(T + block * kPixels, state[block].T, sizeof(state[block].T));
    std::memcpy(last + block * kPixels, state[block].last, sizeof(state[block].last));
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

// Stage 3: front-to-back compositing. A block's 16 pixels keep their state in registers while its splats stream by.
#pragma once
#include "parallel.h"
#include "tile.h"

namespace gsopt::GSOPT_ISA {

struct BlockState {
  f16 T, r, g, b, depth;
  i16 last;
};

struct alignas(64) StoredState {
  float T[kPixels], r[kPixels], g[kPixels], b[kPixels], depth[kPixels];
  int32_t last[kPixels];
};

inline BlockState load_state(const StoredState& s) {
  return {load16(s.T), load16(s.r), load16(s.g), load16(s.b), load16(s.depth), load16i(s.last)};
}
inline void store_state(StoredState& s, const BlockState& v) {
  store16(s.T, v.T), store16(s.r, v.r), store16(s.g, v.g), store16(s.b, v.b), store16(s.depth, v.depth);
  store16i(s.last, v.last);
}

// Blends the splats named by `words` into one block; false once every pixel has terminated.
template <bool Depth>
inline bool blend_block(const Local& local, const uint64_t (*words)[kBlocks], int n_words, int block, int first, StoredState& stored) {
  f16 X, Y;
  block_pixels(block, X, Y);
  BlockState s = load_state(stored);
  const f16 t_min = splat<f16>(kTransmittanceMin), threshold = splat<f16>(kLog2AlphaMin), alpha_max = splat<f16>(kAlphaMax);
  i16 alive = s.T > t_min;
  for (int w = 0; w < n_words; ++w) {
    for (uint64_t rest = words[w][block]; rest; rest &= rest - 1) {
      const int j = 64 * w + __builtin_ctzll(rest);
      const f16 u = splat<f16>(local.A[j]) * X + (splat<f16>(local.B[j]) * Y + splat<f16>(local.u0[j]));
      const f16 v = splat<f16>(local.C[j]) * Y + splat<f16>(local.v0[j]);
      const f16 e = splat<f16>(local.log2_opacity[j]) - u * u - v * v;
      const i16 pass = (e >= threshold) & alive;
      const f16 weight = keep(pass, min(exp2(e), alpha_max)) * s.T;
      s.r = s.r + weight * splat<f16>(local.r[j]);
      s.g = s.g + weight * splat<f16>(local.g[j]);
      s.b = s.b + weight * splat<f16>(local.b[j]);
      if (Depth) s.depth = s.depth + weight * splat<f16>(local.depth[j]);
      s.T = s.T - weight;
      s.last = select(pass, splat16i(first + j), s.last);
      alive = s.T > t_min;
      if (!any(alive)) {
        store_state(stored, s);
        return false;
      }
    }
  }
  store_state(stored, s);
  return true;
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

template <bool Depth> inline void blend_tile(const Frame& frame, int tile, const ForwardOutput& out) {
  const uint32_t begin = frame.tile_begin.as<uint32_t>()[tile], end = frame.tile_begin.as<uint32_t>()[tile + 1];
  auto* words = reinterpret_cast<uint64_t(*)[kBlocks]>(frame.words.as<uint64_t>()) + frame.word_begin.as<uint32_t>()[tile];
  const TileGeometry geometry = tile_geometry(frame, tile);
  StoredState state[kBlocks] = {};
  for (int block = 0; block < kBlocks; ++block) {
    for (int k = 0; k < kPixels; ++k) state[block].last[k] = -1;
    for_each_pixel(frame, tile, block, [&](int64_t, int lane) { state[block].T[lane] = 1.f; });
  }
  Local local;
  unsigned alive = (1u << kBlocks) - 1;
  for (uint32_t first = begin; first < end && alive; first += kChunk) {
    const int n = end - first < kChunk ? static_cast<int>(end - first) : kChunk, n_words = (n + 63) / 64;
    load_chunk(frame, frame.entries.as<Entry>() + first, n, geometry, local, words);
    for (unsigned rest = alive; rest; rest &= rest - 1) {
      const int block = __builtin_ctz(rest);
      if (!blend_block<Depth>(local, words, n_words, block, static_cast<int>(first - begin), state[block])) alive &= ~(1u << block);
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
  parallel(pool, frame.tiles(), [&](int tile, int) {
    out.depths ? blend_tile<true>(frame, tile, out) : blend_tile<false>(frame, tile, out);
  });
}

}  // namespace gsopt::GSOPT_ISA

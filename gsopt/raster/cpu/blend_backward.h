// Stage 4: the gradient of compositing, back to front (docs/math.md, 9 to 11).
//
// q is the splat's color (and depth) projected on the pixel's gradient, `behind` the same for what was composited
// behind it: s = dLoss/d ln(alpha) = weight (q - behind). T is recovered by dividing by 1 - alpha; it never falls below
// what the forward pass stopped at.
//
// Each splat passes twice over the blocks that it touches: first its alphas, then s and all sums, which stay in
// registers while a processor that looks some hundred instructions ahead finds several blocks to work on. Each (splat,
// tile) pair owns one row of sums: no two threads add to the same number, and their order does not matter.
#pragma once
#include "tile.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRowsAhead = 8;  // rows lie anywhere in memory: ask for them early

struct alignas(64) BlockGradient {
  float T[kPixels], behind[kPixels], r[kPixels], g[kPixels], b[kPixels], depth[kPixels];
  int32_t last[kPixels];  // one-based
};

inline void load_gradient(const Frame& frame, const BackwardInput& in, int tile, int block, BlockGradient& out) {
  const int64_t at = (static_cast<int64_t>(tile) * kBlocks + block) * kPixels;
  std::memcpy(out.T, frame.transmittance.as<float>() + at, sizeof(out.T));
  std::memcpy(out.last, frame.last.as<int32_t>() + at, sizeof(out.last));
  const float* bg = frame.background;
  for_each_row(frame, tile, block, [&](int64_t pixel, int lane, int n) {
    const Rgb v = load_rgb(in.v_colors + 3 * pixel, n);
    const f4 none = splat<f4>(0.f), v_alpha = in.v_alphas ? load4_first(in.v_alphas + pixel, n) : none;
    store4(out.r + lane, v.r);
    store4(out.g + lane, v.g);
    store4(out.b + lane, v.b);
    store4(out.depth + lane, in.v_depths ? load4_first(in.v_depths + pixel, n) : none);
    store4(out.behind + lane, v.r * bg[0] + v.g * bg[1] + v.b * bg[2] - v_alpha);
  });
}

// The alphas of one splat at the pixels of the blocks of a mask, one block after the other; 0 where they are not drawn.
struct Alphas {
  px alpha[kBlocks];
  Whitened<px> at[kBlocks];
};
inline void alphas_of(const Local::Row& s, uint32_t mask, Alphas& out) {
  const Whitened<float> center = at_center(s.A, s.B, s.C, s.x, s.y);
  const Spread<px> all = spread(s, center.u, center.v);
  int n = 0;
  for (uint32_t rest = mask; rest; rest &= rest - 1, ++n) {
    const int block = __builtin_ctz(rest);
    out.alpha[n] = alpha_of(exponent(all, load_px(kBlockPixels.x[block]), load_px(kBlockPixels.y[block]), out.at[n]));
  }
}

// The row of splat `i` of a chunk, entry `index` (one-based) of its tile: the sums of (10) and (11) over blocks.
template <bool Depth, bool Abs> inline void blend_splat_backward(
    const Local& local, int i, int index, uint32_t mask, BlockGradient* grads, float* row) {
  const Local::Row& splat_i = local.row[i];
  const px B = splat<px>(splat_i.B), C = splat<px>(splat_i.C);
  const Vec3<px> color = splat_color(local, i);
  const px depth = splat<px>(local.depth[i]);
  const px zero = splat<px>(0.f);
  const pxi here = splat_pxi(index - 1);
  Alphas alphas;
  alphas_of(splat_i, mask, alphas);
  Vec3<px> v_color = {zero, zero, zero};
  px v_depth = zero, s0 = zero, su = zero, sv = zero, suu = zero, suv = zero, svv = zero, abs_x = zero, abs_y = zero;
  int n = 0;
  for (uint32_t rest = mask; rest; rest &= rest - 1, ++n) {
    BlockGradient& p = grads[__builtin_ctz(rest)];
    const px alpha = keep(load_pxi(p.last) > here, alphas.alpha[n]);
    const Vec3<px> g = {load_px(p.r), load_px(p.g), load_px(p.b)};
    px q = dot(color, g);
    if (Depth) q = q + depth * load_px(p.depth);
    const Passed<px> now = passed(alpha, q, load_px(p.T), load_px(p.behind));
    store_px(p.T, now.T);
    store_px(p.behind, now.behind);
    const px weight = now.weight, s = now.s;
    v_color = v_color + g * weight;
    if (Depth) v_depth = v_depth + weight * load_px(p.depth);
    const px u = alphas.at[n].u, v = alphas.at[n].v, s_u = s * u, s_v = s * v;
    s0 = s0 + s;
    su = su + s_u;
    sv = sv + s_v;
    suu = suu + s_u * u;
    suv = suv + s_u * v;
    svv = svv + s_v * v;
    if (Abs) {
      abs_x = abs_x + abs(s_u);
      abs_y = abs_y + abs(B * s_u + C * s_v);
    }
  }
  const px scale = splat<px>(1.f / kHalfLog2E);
  store_sums(row, {s0, su, sv, suu, suv, svv, v_color.x, v_color.y, v_color.z, v_depth,
                      abs_x * splat<px>(splat_i.A) * scale, abs_y * scale});
}

template <bool Depth, bool Abs> inline void blend_tile_backward(const Frame& frame, int tile, const BackwardInput& in) {
  const uint32_t begin = frame.tile_begin.as<uint32_t>()[tile], end = frame.tile_begin.as<uint32_t>()[tile + 1];
  if (begin == end) return;
  const Entry* entries = frame.entries.as<Entry>() + begin;
  const uint32_t* masks = frame.masks.as<uint32_t>() + begin;
  const TileGeometry geometry = tile_geometry(frame, tile);
  BlockGradient grads[kBlocks] = {};  // pixels outside the image stay zero
  for (int block = 0; block < kBlocks; ++block) load_gradient(frame, in, tile, block, grads[block]);
  const auto row_of = [&](int k) { return frame.rows.as<float>() + static_cast<int64_t>(entries[k].slot) * kRow; };
  Local local;
  for (int chunk = divide_up(end - begin, kChunk) - 1; chunk >= 0; --chunk) {
    const int first = chunk * kChunk, rest = static_cast<int>(end - begin) - first, n = rest < kChunk ? rest : kChunk;
    load_chunk(frame, entries + first, n, geometry, local);
    prefetch_records(frame, static_cast<int64_t>(begin) + first - kChunk, static_cast<int64_t>(begin) + first);
    for (int i = n - 1; i >= 0; --i) {
      __builtin_prefetch(row_of(first + (i >= kRowsAhead ? i - kRowsAhead : 0)), 1);
      float* row = row_of(first + i);
      if (masks[first + i]) {
        blend_splat_backward<Depth, Abs>(local, i, first + i + 1, masks[first + i], grads, row);
      } else {
        std::memset(row, 0, sizeof(float) * kRow);
      }
    }
  }
}

inline void blend_backward_stage(Pool& pool, Frame& frame, const BackwardInput& in, bool absgrad) {
  const bool depth = in.v_depths != nullptr;
  const auto tile_backward = depth ? (absgrad ? blend_tile_backward<true, true> : blend_tile_backward<true, false>)
                                   : (absgrad ? blend_tile_backward<false, true> : blend_tile_backward<false, false>);
  // From the last tile to the first, as each goes through its splats: the records asked for are those before.
  for_each_tile_of(pool, frame, [&](int k, int) { tile_backward(frame, frame.tiles() - 1 - k, in); });
}

}  // namespace gsopt::GSOPT_ISA

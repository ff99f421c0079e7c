// Stage 4: the gradient of compositing, back to front (docs/math.md, section "Compositing gradient").
//
// With q = c·g the splat's color projected on the pixel's gradient g, and A the same for everything behind it,
// already composited, s = alpha dLoss/dalpha = w (q - A). Behind the last splat A = background·g - dLoss/dalpha_out.
// T is recovered by dividing by 1 - alpha; it never falls below what the forward pass stopped at.
//
// Per block the work has two phases: pixels as lanes compute s and w for eight splats, then splats as lanes sum them
// over the pixels into moments about the tile's centre. Each (splat, tile) pair owns one row of sums, so no two
// threads ever add to the same number and the result does not depend on their order.
#pragma once
#include "parallel.h"
#include "tile.h"

namespace gsopt::GSOPT_ISA {

struct alignas(64) BlockGradient {
  float T[kPixels], behind[kPixels], r[kPixels], g[kPixels], b[kPixels], depth[kPixels];
  int32_t last[kPixels];
  int32_t highest;  // largest `last`
};

inline void load_gradient(const Frame& frame, const BackwardInput& in, int tile, int block, BlockGradient& out) {
  std::memset(&out, 0, sizeof(out));
  const int64_t at = (static_cast<int64_t>(tile) * kBlocks + block) * kPixels;
  std::memcpy(out.T, frame.transmittance.as<float>() + at, sizeof(out.T));
  std::memcpy(out.last, frame.last.as<int32_t>() + at, sizeof(out.last));
  out.highest = -1;
  for (int k = 0; k < kPixels; ++k) out.highest = out.last[k] > out.highest ? out.last[k] : out.highest;
  const float* bg = frame.background;
  for_each_pixel(frame, tile, block, [&](int64_t pixel, int lane) {
    const float *v = in.v_colors + 3 * pixel, v_alpha = in.v_alphas ? in.v_alphas[pixel] : 0.f;
    out.r[lane] = v[0], out.g[lane] = v[1], out.b[lane] = v[2];
    out.depth[lane] = in.v_depths ? in.v_depths[pixel] : 0.f;
    out.behind[lane] = v[0] * bg[0] + v[1] * bg[1] + v[2] * bg[2] - v_alpha;
  });
}

// Eight splats between the two phases.
struct alignas(64) Batch {
  float s[kLanes][kPixels], w[kLanes][kPixels];
  float abs_x[kLanes], abs_y[kLanes];
  int index[kLanes];
  int size = 0;
};

// Rows of pixels, one per splat, become one vector over the splats per pixel.
inline void pixels_by_splat(const float rows[kLanes][kPixels], f8 out[kPixels]) {
  for (int p = 0; p < kPixels; p += kLanes) {
    for (int l = 0; l < kLanes; ++l) out[p + l] = load8(rows[l] + p);
    transpose8(out + p);
  }
}

// Σ s, Σ s x, Σ s y, Σ s x², Σ s x y, Σ s y² over a block; x, y relative to the block's center (±0.5, ±1.5).
inline void block_moments(const f8 s[kPixels], f8 m[6]) {
  f8 column[4], tilted[4], curved = splat<f8>(0.f);
  for (int x = 0; x < 4; ++x) {
    column[x] = tilted[x] = splat<f8>(0.f);
    for (int row = 0; row < kBlockRows; ++row) {
      const float y = static_cast<float>(row) - 0.5f * (kBlockRows - 1);
      column[x] += s[4 * row + x], tilted[x] += s[4 * row + x] * y, curved += s[4 * row + x] * (y * y);
    }
  }
  m[0] = (column[0] + column[1]) + (column[2] + column[3]);
  m[1] = (column[3] - column[0]) * 1.5f + (column[2] - column[1]) * 0.5f;
  m[2] = (tilted[0] + tilted[1]) + (tilted[2] + tilted[3]);
  m[3] = (column[0] + column[3]) * 2.25f + (column[1] + column[2]) * 0.25f;
  m[4] = (tilted[3] - tilted[0]) * 1.5f + (tilted[2] - tilted[1]) * 0.5f;
  m[5] = kBlockRows == 2 ? m[0] * 0.25f : curved;
}

// Phase two: sums of a batch over the block, moved to the tile's centre and added to the splats' rows.
template <bool Depth, bool Abs>
inline void flush(Batch& batch, const BlockGradient& grad, int block, float (*rows)[kRow]) {
  if (batch.size == 0) return;
  for (int k = batch.size; k < kLanes; ++k) {
    std::memset(batch.s[k], 0, sizeof(batch.s[k]));
    std::memset(batch.w[k], 0, sizeof(batch.w[k]));
  }
  f8 pixel[kPixels], out[8], blue = splat<f8>(0.f), depth = blue;
  pixels_by_splat(batch.s, pixel);
  block_moments(pixel, out);
  const float bx = static_cast<float>(4 * (block % 4)) - 6.f;
  const float by = static_cast<float>(kBlockRows * (block / 4)) + 0.5f * kBlockRows - 8.f;
  out[3] += (out[1] * 2.f + out[0] * bx) * bx;
  out[4] += out[2] * bx + (out[1] + out[0] * bx) * by;
  out[5] += (out[2] * 2.f + out[0] * by) * by;
  out[1] += out[0] * bx, out[2] += out[0] * by;

  pixels_by_splat(batch.w, pixel);
  out[6] = out[7] = splat<f8>(0.f);
  for (int k = 0; k < kPixels; ++k) {
    out[6] += pixel[k] * grad.r[k], out[7] += pixel[k] * grad.g[k], blue += pixel[k] * grad.b[k];
    if (Depth) depth += pixel[k] * grad.depth[k];
  }
  transpose8(out);
  for (int k = 0; k < batch.size; ++k) {
    float* row = rows[batch.index[k]];
    store8(row, load8(row) + out[k]);
    row[kWb] += blue[k];
    if (Depth) row[kWz] += depth[k];
    if (Abs) row[kAbsX] += batch.abs_x[k], row[kAbsY] += batch.abs_y[k];
  }
  batch.size = 0;
}

// What phase one carries from splat to splat, back to front.
struct BackwardState {
  px T, behind;
};

// One splat of phase one; its s and w go into the batch.
template <bool Depth, bool Abs>
inline void one_backward(BackwardState& state, const Local& local, int j, pxi pass, px raw, px u, px v, const BlockGradient& grad, Batch& batch) {
  const px alpha_max = splat<px>(kAlphaMax), one = splat<px>(1.f);
  const px alpha = keep(pass, min(raw, alpha_max));
  state.T = state.T * (one / (one - alpha));
  const px weight = alpha * state.T;
  px q = splat<px>(local.r[j]) * load_px(grad.r) + splat<px>(local.g[j]) * load_px(grad.g) + splat<px>(local.b[j]) * load_px(grad.b);
  if (Depth) q = q + splat<px>(local.depth[j]) * load_px(grad.depth);
  const px difference = q - state.behind;
  state.behind = state.behind + alpha * difference;
  const px s = keep(raw < alpha_max, weight * difference);  // a clamped alpha does not move
  const int k = batch.size++;
  batch.index[k] = j;
  store_px(batch.s[k], s), store_px(batch.w[k], weight);
  if (Abs) {
    batch.abs_x[k] = sum(abs(s * u)) * local.A[j] * (1.f / kHalfLog2E);
    batch.abs_y[k] = sum(abs(s * (splat<px>(local.B[j]) * u + splat<px>(local.C[j]) * v))) * (1.f / kHalfLog2E);
  }
}

// Phase one over one chunk of one block, last splat first, two at a time.
template <bool Depth, bool Abs>
inline void blend_block_backward(const Local& local, const uint64_t (*words)[kBlocks], int n_words, int block, int first, int count,
                                 BlockGradient& grad, float (*rows)[kRow]) {
  uint16_t list[kListSize];
  // Splats after the block's last one contributed nothing.
  const int n = list_block(words, n_words, block, grad.highest - first, count, list);
  px X, Y;
  block_pixels(block, X, Y);
  BackwardState state = {load_px(grad.T), load_px(grad.behind)};
  const pxi last = load_pxi(grad.last);
  const px threshold = splat<px>(kLog2AlphaMin);
  Batch batch;
  for (int k = n; k > 0; k -= 2) {  // list[0] is nowhere and pairs with the first splat of an odd list
    const int i = list[k], j = list[k - 1];
    const Exponents x = exponents(local, i, j, X, Y);
    const px2 raw = exp2(x.e);
    const pxi pass_i = (x.e.a >= threshold) & (last >= splat_pxi(first + i)), pass_j = (x.e.b >= threshold) & (last >= splat_pxi(first + j));
    one_backward<Depth, Abs>(state, local, i, pass_i, raw.a, x.u.a, x.v.a, grad, batch);
    one_backward<Depth, Abs>(state, local, j, pass_j, raw.b, x.u.b, x.v.b, grad, batch);
    if (batch.size == kLanes) flush<Depth, Abs>(batch, grad, block, rows);
  }
  flush<Depth, Abs>(batch, grad, block, rows);
  store_px(grad.T, state.T), store_px(grad.behind, state.behind);
}

// Moments about the tile's centre become moments about each splat's own centre; the rows go to their slots.
inline void store_rows(const Local& local, const Entry* entries, int n, float (*rows)[kRow], float* out) {
  for (int i = 0; i < n; i += kLanes) {
    f8 m[8];
    for (int l = 0; l < kLanes; ++l) m[l] = load8(rows[i + l]);
    transpose8(m);
    const f8 dx = load8(local.dx + i), dy = load8(local.dy + i);
    m[kSxx] += (m[kS] * dx - m[kSx] * 2.f) * dx;
    m[kSxy] += m[kS] * dx * dy - m[kSy] * dx - m[kSx] * dy;
    m[kSyy] += (m[kS] * dy - m[kSy] * 2.f) * dy;
    m[kSx] -= m[kS] * dx, m[kSy] -= m[kS] * dy;
    transpose8(m);
    for (int l = 0; l < kLanes && i + l < n; ++l) {
      float* row = out + static_cast<int64_t>(entries[i + l].slot) * kRow;
      store8(row, m[l]), store8(row + 8, load8(rows[i + l] + 8));
    }
  }
}

inline void clear_rows(const Entry* entries, uint32_t from, uint32_t to, float* out) {
  for (uint32_t k = from; k < to; ++k) std::memset(out + static_cast<int64_t>(entries[k].slot) * kRow, 0, sizeof(float) * kRow);
}

template <bool Depth, bool Abs> inline void blend_tile_backward(const Frame& frame, int tile, const BackwardInput& in) {
  const uint32_t begin = frame.tile_begin.as<uint32_t>()[tile];
  const uint32_t count = frame.tile_begin.as<uint32_t>()[tile + 1] - begin;
  if (count == 0) return;
  const Entry* entries = frame.entries.as<Entry>() + begin;
  const auto* words = reinterpret_cast<const uint64_t(*)[kBlocks]>(frame.words.as<uint64_t>()) + frame.word_begin.as<uint32_t>()[tile];
  const TileGeometry geometry = tile_geometry(frame, tile);
  BlockGradient grad[kBlocks];
  int highest = -1;
  for (int block = 0; block < kBlocks; ++block) {
    load_gradient(frame, in, tile, block, grad[block]);
    highest = grad[block].highest > highest ? grad[block].highest : highest;
  }
  const uint32_t used = static_cast<uint32_t>(highest + 1);
  clear_rows(entries, used, count, frame.rows.as<float>());
  Local local;
  alignas(64) float rows[kChunk + kLanes][kRow];  // the row of nowhere is never stored
  for (int chunk = divide_up(used, kChunk) - 1; chunk >= 0; --chunk) {
    const uint32_t first = static_cast<uint32_t>(chunk) * kChunk;
    const int n = used - first < kChunk ? static_cast<int>(used - first) : kChunk, padded = (n + kLanes) / kLanes * kLanes;
    load_chunk(frame, entries + first, n, geometry, local, nullptr);
    std::memset(rows, 0, sizeof(rows[0]) * padded);
    for (int block = 0; block < kBlocks; ++block) {
      if (grad[block].highest < static_cast<int>(first)) continue;
      blend_block_backward<Depth, Abs>(local, words + first / 64, (n + 63) / 64, block, static_cast<int>(first), n, grad[block], rows);
    }
    store_rows(local, entries + first, n, rows, frame.rows.as<float>());
  }
}

inline void blend_backward_stage(Pool& pool, Frame& frame, const BackwardInput& in, bool absgrad) {
  const bool depth = in.v_depths != nullptr;
  const auto tile_backward = depth ? (absgrad ? blend_tile_backward<true, true> : blend_tile_backward<true, false>)
                                   : (absgrad ? blend_tile_backward<false, true> : blend_tile_backward<false, false>);
  parallel(pool, frame.tiles(), [&](int tile, int) { tile_backward(frame, tile, in); });
}

}  // namespace gsopt::GSOPT_ISA

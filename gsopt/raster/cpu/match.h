// Window costs of stereo matching (docs/math.md, 25 and 26; gsopt/init/stereo/matching.py), eight neighboring pixels at
// a time: one minus the weighted normalized cross-correlation of an image with another across a plane per pixel.
//
// With w the inverse depth of (25), A = K R' and T = K τ', the point on a ray projects to A (x, y, 1) + T w: every tap
// of the window is the center's projection plus two steps.
#pragma once
#include "frame.h"
#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr float kNearest = 1e-6f;  // what projects to less than this depth, in units of its own, is behind the source

// Bilinear values at eight places, from the corners of each place's cell: [h, w, 4].
inline f8 bilinear8(const float* corners, int width, int height, f8 column, f8 row) {
  const f8 zero = splat<f8>(0.f);
  const f8 x = clamp(column, zero, splat<f8>(static_cast<float>(width - 1))),
           y = clamp(row, zero, splat<f8>(static_cast<float>(height - 1)));
  const i8 left = to_int(x), top = to_int(y), cell = top * width + left;
  const f8 across = x - to_float(left), down = y - to_float(top);
  f8 pair[4];
  for (int k = 0; k < 4; ++k)
    pair[k] = __builtin_shufflevector(load4(corners + 4 * static_cast<int64_t>(cell[k])),
        load4(corners + 4 * static_cast<int64_t>(cell[k + 4])), 0, 1, 2, 3, 4, 5, 6, 7);
  const auto low = [](f8 a, f8 b) { return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13); };
  const auto high = [](f8 a, f8 b) { return __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15); };
  const auto first = [](f8 a, f8 b) { return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13); };
  const auto second = [](f8 a, f8 b) { return __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15); };
  const f8 above = low(pair[0], pair[1]), above2 = low(pair[2], pair[3]), below = high(pair[0], pair[1]),
           below2 = high(pair[2], pair[3]);
  const f8 upper = first(above, above2), lower = first(below, below2);
  const f8 on_top = upper + (second(above, above2) - upper) * across,
           on_bottom = lower + (second(below, below2) - lower) * across;
  return on_top + (on_bottom - on_top) * down;
}

inline void match_block(const MatchArguments& m, int64_t block) {
  const int64_t at = 8 * block;
  const f8 x = load8(m.rays + at), y = load8(m.rays + m.padded + at);
  const f8 a = load8(m.planes + at), b = load8(m.planes + m.padded + at),
           w = a * x + b * y + load8(m.planes + 2 * m.padded + at);
  f8 center[3], right[3], down[3];
  for (int k = 0; k < 3; ++k) {
    center[k] = x * m.A[3 * k] + y * m.A[3 * k + 1] + m.A[3 * k + 2] + w * m.T[k];
    right[k] = (a * m.T[k] + m.A[3 * k]) * m.step_x;
    down[k] = (b * m.T[k] + m.A[3 * k + 1]) * m.step_y;
  }
  const f8 zero = splat<f8>(0.f), one = splat<f8>(1.f);
  const f8 last_column = splat<f8>(static_cast<float>(m.width - 1)),
           last_row = splat<f8>(static_cast<float>(m.height - 1));
  f8 mean = zero, square = zero, product = zero;
  i8 inside = splat8i(-1);
  const float* window = m.windows + block * m.taps * 16;
  for (int tap = 0; tap < m.taps; ++tap, window += 16) {
    const float dx = m.offsets[2 * tap], dy = m.offsets[2 * tap + 1];
    const f8 depth = center[2] + right[2] * dx + down[2] * dy, inverse = one / depth;
    const f8 column = (center[0] + right[0] * dx + down[0] * dy) * inverse - 0.5f,
             row = (center[1] + right[1] * dx + down[1] * dy) * inverse - 0.5f;
    inside &= (depth > kNearest) & (column >= 0.f) & (column <= last_column) & (row >= 0.f) & (row <= last_row);
    const f8 value = bilinear8(m.corners, m.width, m.height, column, row), weighted = value * load8(window);
    mean += weighted;
    square += weighted * value;
    product += load8(window + 8) * value;
  }
  const f8 variance = max(square - mean * mean, zero) + m.least_variance;
  const f8 cost = one - product * load8(m.inverse_deviation + at) / sqrt(variance);
  store8(m.costs + at, select(inside, cost, splat<f8>(m.unseen)));
}

inline void match_stage(Pool& pool, const MatchArguments& m) {
  constexpr int64_t kBlocksAtOnce = 64;
  const int64_t blocks = m.padded / 8;
  parallel(pool, divide_up(blocks, kBlocksAtOnce), [&](int item, int) {
    const int64_t end = (item + 1) * kBlocksAtOnce < blocks ? (item + 1) * kBlocksAtOnce : blocks;
    for (int64_t block = item * kBlocksAtOnce; block < end; ++block) match_block(m, block);
  });
}

}  // namespace gsopt::GSOPT_ISA

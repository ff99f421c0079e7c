// The lowest of the values that several pictures have at points of the scene (gsopt/data/lookup.py): projection and
// bilinear interpolation in one pass, eight points at a time.
#pragma once
#include <algorithm>
#include <cstring>

#include "frame.h"
#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

inline f8 gather8(const float* values, i8 at) {
  f8 found;
  for (int k = 0; k < 8; ++k) found[k] = values[at[k]];
  return found;
}

// Between pixel centers, at +0.5; beyond the border the border's.
inline f8 bilinear8(const Picture& p, f8 column, f8 row) {
  const f8 zero = splat<f8>(0.f);
  const f8 x = clamp(column - 0.5f, zero, splat<f8>(static_cast<float>(p.width - 1))),
           y = clamp(row - 0.5f, zero, splat<f8>(static_cast<float>(p.height - 1)));
  const i8 left = to_int(x), top = to_int(y);
  const i8 right = (left < p.width - 1) & 1, down = p.width * ((top < p.height - 1) & 1);
  const i8 at = top * p.width + left;
  const f8 across = x - to_float(left);
  const f8 upper_left = gather8(p.image, at), lower_left = gather8(p.image, at + down);
  const f8 upper = upper_left + (gather8(p.image, at + right) - upper_left) * across,
           lower = lower_left + (gather8(p.image, at + down + right) - lower_left) * across;
  return upper + (lower - upper) * (y - to_float(top));
}

struct Place {
  f8 value;
  i8 shown;
};

inline Place value_in(const Picture& p, const LookupArguments& m, f8 X, f8 Y, f8 Z) {
  f8 to[3];
  for (int i = 0; i < 3; ++i) to[i] = X * p.R[3 * i] + Y * p.R[3 * i + 1] + Z * p.R[3 * i + 2] + p.t[i];
  const f8 depth = to[2], column = p.fx * to[0] / depth + p.cx, row = p.fy * to[1] / depth + p.cy;
  const auto within = [&](f8 reach) {
    return (column >= -reach) & (column <= reach + p.columns) & (row >= -reach) & (row <= reach + p.rows);
  };
  const i8 before = depth > 0.f, shown = before & within(splat<f8>(0.f)), valued = m.beside_is_border ? before : shown;
  const f8 reach = (m.radius * (p.fx > p.fy ? p.fx : p.fy)) / max(depth - m.radius, splat<f8>(1e-12f));
  const i8 near = (splat<f8>(m.radius) > 0.f) & ((depth <= m.radius) | within(reach));
  const f8 value = bilinear8(p, keep(valued, column) * (p.width / p.columns), keep(valued, row) * (p.height / p.rows));
  return {select(valued, value, select(near, splat<f8>(m.beside), splat<f8>(p.unseen))), shown};
}

inline Place lowest(const LookupArguments& m, const float* points) {
  f8 X, Y, Z;
  for (int k = 0; k < 8; ++k) {
    X[k] = points[3 * k];
    Y[k] = points[3 * k + 1];
    Z[k] = points[3 * k + 2];
  }
  Place found = value_in(m.pictures[0], m, X, Y, Z);
  for (int k = 1; k < m.picture_count && any(found.value > m.enough); ++k) {
    const Place next = value_in(m.pictures[k], m, X, Y, Z);
    found = {min(found.value, next.value), found.shown + next.shown};
  }
  return {found.value, -found.shown};
}

constexpr int64_t kPointsAtOnce = 2048;

inline void lookup_stage(Pool& pool, const LookupArguments& m) {
  parallel(pool, divide_up(m.count, kPointsAtOnce), [&](int item, int) {
    const int64_t first = item * kPointsAtOnce, end = std::min(m.count, first + kPointsAtOnce);
    for (int64_t at = first; at < end; at += 8) {
      const int64_t lanes = std::min<int64_t>(8, end - at);
      float last[24] = {};
      if (lanes < 8) std::memcpy(last, m.points + 3 * at, sizeof(float) * 3 * lanes);
      const Place found = lowest(m, lanes < 8 ? last : m.points + 3 * at);
      std::memcpy(m.values + at, &found.value, sizeof(float) * lanes);
      std::memcpy(m.shown + at, &found.shown, sizeof(int32_t) * lanes);
    }
  });
}

}  // namespace gsopt::GSOPT_ISA

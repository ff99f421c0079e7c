// Squared distances to the nearest true cell of a grid (gsopt/data/distances.py), one axis after the other
// (Felzenszwalb & Huttenlocher 2012), exact within `reach` cells along each.
#pragma once
#include <algorithm>
#include <cstring>

#include "frame.h"

namespace gsopt::GSOPT_ISA {

constexpr int kLanesAtOnce = 256;  // columns that are measured together: a slab of 128 cells fills 64 kB

// Along one row, by a scan in each direction.
inline void distance_in_row(const uint8_t* cells, int16_t* out, int size, int reach) {
  for (int at = 0, away = reach + 1; at < size; ++at) {
    away = cells[at] ? 0 : std::min(away + 1, reach + 1);
    out[at] = static_cast<int16_t>(away);
  }
  for (int at = size - 1, away = reach + 1; at >= 0; --at) {
    away = cells[at] ? 0 : std::min(away + 1, reach + 1);
    const int least = std::min<int>(away, out[at]);
    out[at] = static_cast<int16_t>(least > reach ? kFarSquared : least * least);
  }
}

// Along an axis of `size` cells, `stride` apart, for `lanes` neighbors: the least of what lies at an offset, plus its
// square. What is nearer than an offset already needs no larger one.
inline void distance_across(int16_t* cells, int16_t* slab, int size, int64_t stride, int lanes, int reach) {
  for (int at = 0; at < size; ++at) std::memcpy(slab + at * kLanesAtOnce, cells + at * stride, sizeof(int16_t) * lanes);
  for (int at = 0; at < size; ++at) {
    int16_t* nearest = cells + at * stride;
    const int last = std::min(reach, std::max(at, size - 1 - at));
    for (int offset = 1; offset <= last; ++offset) {
      const auto square = static_cast<int16_t>(offset * offset);
      int16_t most = 0;
      for (int lane = 0; lane < lanes; ++lane) most = std::max(most, nearest[lane]);
      if (most <= square) break;
      for (const int other : {at - offset, at + offset}) {
        if (other < 0 || other >= size) continue;
        const int16_t* there = slab + other * kLanesAtOnce;
        for (int lane = 0; lane < lanes; ++lane)
          nearest[lane] = std::min(nearest[lane], static_cast<int16_t>(there[lane] + square));
      }
    }
    for (int lane = 0; lane < lanes; ++lane) nearest[lane] = std::min(nearest[lane], kFarSquared);
  }
}

inline void distance_stage(const DistanceArguments& d) {
  const int64_t plane = static_cast<int64_t>(d.shape[1]) * d.shape[2];
  for (int64_t row = 0; row < static_cast<int64_t>(d.shape[0]) * d.shape[1]; ++row)
    distance_in_row(d.cells + row * d.shape[2], d.squared + row * d.shape[2], d.shape[2], d.reach);
  d.slab->reserve(sizeof(int16_t) * kLanesAtOnce * std::max(d.shape[0], d.shape[1]));
  auto* slab = d.slab->as<int16_t>();
  for (int x = 0; x < d.shape[0]; ++x)
    for (int z = 0; z < d.shape[2]; z += kLanesAtOnce)
      distance_across(
          d.squared + x * plane + z, slab, d.shape[1], d.shape[2], std::min(kLanesAtOnce, d.shape[2] - z), d.reach);
  for (int64_t yz = 0; yz < plane; yz += kLanesAtOnce)
    distance_across(d.squared + yz, slab, d.shape[0], plane,
        static_cast<int>(std::min<int64_t>(kLanesAtOnce, plane - yz)), d.reach);
}

}  // namespace gsopt::GSOPT_ISA

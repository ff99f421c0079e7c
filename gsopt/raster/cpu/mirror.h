// What mirror planes leave unexplained of silhouettes (gsopt/symmetry/search.py), 64 planes at a time: one bit each in
// a word per voxel, and in a word per pixel of a silhouette.
#pragma once
#include "frame.h"
#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kPlanesAtOnce = 64;

struct PlaneWord {
  float normal[3][kPlanesAtOnce], offset[kPlanesAtOnce];
};

inline f8 floor(f8 x) {
  const f8 whole = to_float(to_int(x));
  return whole - select(whole > x, splat<f8>(1.f), splat<f8>(0.f));
}

// A bit for each plane: is the voxel there where a voxel's mirror image lies?
inline uint64_t behind(const MirrorArguments& m, const PlaneWord& planes, const float* center) {
  uint64_t found = 0;
  for (int first = 0; first < kPlanesAtOnce; first += 8) {
    f8 normal[3], beyond = -load8(planes.offset + first);
    for (int axis = 0; axis < 3; ++axis) {
      normal[axis] = load8(planes.normal[axis] + first);
      beyond += normal[axis] * center[axis];
    }
    i8 index = splat8i(0), within = splat8i(-1);
    for (int axis = 0; axis < 3; ++axis) {
      const f8 there = floor(center[axis] - 2.f * beyond * normal[axis]);
      within &= (there >= 0.f) & (there < static_cast<float>(m.shape[axis]));
      index = index * m.shape[axis] + to_int(there);
    }
    for (int k = 0; k < 8; ++k)
      if (within[k] && m.cells[index[k]]) found |= uint64_t{1} << (first + k);
  }
  return found;
}

// Adds to `lost` the share of a silhouette's pixels that no voxel covers of which the plane's bit is set.
inline void add_uncovered(const MirrorPhoto& photo, const uint64_t* stays, uint64_t* covered, int planes, float* lost) {
  std::memset(covered, 0, sizeof(uint64_t) * photo.pixels);
  for (int64_t k = 0; k < photo.count; ++k) covered[photo.pixel[k]] |= stays[photo.rows[k]];
  for (int plane = 0; plane < planes; ++plane) {
    int64_t count = 0;
    for (int64_t k = 0; k < photo.pixels; ++k) count += covered[k] >> plane & 1;
    if (photo.pixels) lost[plane] += 1.f - static_cast<float>(count) / static_cast<float>(photo.pixels);
  }
}

inline void mirror_stage(Pool& pool, const MirrorArguments& m) {
  int64_t most = 0;
  for (int k = 0; k < m.photo_count; ++k) most = most < m.photos[k].pixels ? m.photos[k].pixels : most;
  const int64_t each = m.count + most;
  m.words->reserve(sizeof(uint64_t) * each * pool.threads());
  parallel(pool, divide_up(m.planes, kPlanesAtOnce), [&](int item, int worker) {
    const int64_t first = static_cast<int64_t>(item) * kPlanesAtOnce;
    const int planes = static_cast<int>(m.planes - first < kPlanesAtOnce ? m.planes - first : kPlanesAtOnce);
    PlaneWord word = {};
    for (int plane = 0; plane < planes; ++plane) {
      for (int axis = 0; axis < 3; ++axis) word.normal[axis][plane] = m.normals[3 * (first + plane) + axis];
      word.offset[plane] = m.offsets[first + plane];
    }
    uint64_t* stays = m.words->as<uint64_t>() + worker * each;
    for (int64_t k = 0; k < m.count; ++k) stays[k] = behind(m, word, m.centers + 3 * k);
    float* lost = m.lost + first;
    std::memset(lost, 0, sizeof(float) * planes);
    for (int k = 0; k < m.photo_count; ++k) add_uncovered(m.photos[k], stays, stays + m.count, planes, lost);
    for (int plane = 0; plane < planes; ++plane) lost[plane] /= static_cast<float>(m.photo_count);
  });
}

}  // namespace gsopt::GSOPT_ISA

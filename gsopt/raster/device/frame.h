// What kernels share: numbers of one thread for the formulas in common/, splats, tiles and parameters.
#pragma once
#include "simt.h"

namespace gsopt::GSOPT_ISA {

template <class F> F splat(float x) { return x; }
inline float max(float a, float b) { return a > b ? a : b; }
inline float min(float a, float b) { return a < b ? a : b; }
inline float clamp(float x, float lo, float hi) { return x < lo ? lo : (x > hi ? hi : x); }
inline float select(bool m, float a, float b) { return m ? a : b; }
inline float keep(bool m, float a) { return m ? a : 0.f; }
inline float exp(float x) { return exp_of(clamp(x, -86.6f, 86.6f)); }

}  // namespace gsopt::GSOPT_ISA

// The numbers first: the shared formulas find their functions there.
#include "../common/adam.h"
#include "../common/blend.h"
#include "../common/projection.h"
#include "../common/reach.h"
#include "../common/sh.h"
#include "../common/ssim.h"

namespace gsopt::GSOPT_ISA {

static_assert(kThreads == kTile * kTile, "a thread for every pixel of a tile");
constexpr int kMaxBands = 15;  // rows of shN

// N Gaussians as the optimizer stores them.
struct Parameters {
  int count, sh_degree, sh_rest;  // highest band to evaluate; number of rows of shN
  GLOBAL const float *means, *quats, *log_scales, *logit_opacities, *sh0, *shN;
};

inline Vec3<float> load3(GLOBAL const float* rows, Index n) { return {rows[3 * n], rows[3 * n + 1], rows[3 * n + 2]}; }
inline void store3(GLOBAL float* rows, Index n, Vec3<float> v) {
  rows[3 * n] = v.x;
  rows[3 * n + 1] = v.y;
  rows[3 * n + 2] = v.z;
}

inline Splat3D<float> load_splat(const Parameters& P, Index n) {
  GLOBAL const float* q = P.quats + 4 * n;
  return {load3(P.means, n), q[0], q[1], q[2], q[3], load3(P.log_scales, n), P.logit_opacities[n]};
}

// A splat on the image plane, and the tiles of its box, half open.
struct alignas(16) Record {
  float mx, my, A, B, C, log2_opacity, r, g, b, depth;
  unsigned short x0, x1, y0, y1;
};

// A splat as the pixels of one tile see it: (u0, v0) are its whitened coordinates at the tile's center.
struct alignas(16) Row {
  float A, B, C, u0, v0, log2_opacity, r, g, b, depth;
};

// One splat in one tile: the sums of RowField over the tile's pixels.
struct alignas(16) Sums {
  float at[kRowFields];
};

// A tile's list is cut into segments: on the way back each is a block's. They are numbered tile by tile, with gaps.
constexpr int kSegment = kThreads;  // splats
inline int first_segment(int tile, int begin) { return begin / kSegment + tile; }

// What a pixel has taken when a segment ends.
struct End {
  float T, r, g, b, depth;
};
constexpr int kEndFields = 5;

// An image and one tile of it.
struct Tile {
  int x, y, width, height;  // its first pixel; the image
  Tile(int number, int tiles_x, int width_, int height_)
      : x(number % tiles_x * kTile), y(number / tiles_x * kTile), width(width_), height(height_) {}
  bool has(int t) const { return x + t % kTile < width && y + t / kTile < height; }
  Index pixel(int t) const { return static_cast<Index>(y + t / kTile) * width + x + t % kTile; }
};
// A thread's pixel from the tile's center.
inline float pixel_x(int t) { return static_cast<float>(t % kTile) - 7.5f; }
inline float pixel_y(int t) { return static_cast<float>(t / kTile) - 7.5f; }

inline Row row_of(GLOBAL const Record& r, const Tile& tile) {
  const float x = r.mx - static_cast<float>(tile.x + kTile / 2), y = r.my - static_cast<float>(tile.y + kTile / 2);
  const Whitened<float> center = at_center(r.A, r.B, r.C, x, y);
  return {r.A, r.B, r.C, center.u, center.v, r.log2_opacity, r.r, r.g, r.b, r.depth};
}
inline Spread<float> spread(IN_BLOCK const Row& r) { return {r.A, r.B, r.C, r.u0, r.v0, r.log2_opacity}; }

}  // namespace gsopt::GSOPT_ISA

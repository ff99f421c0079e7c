// The reach of a splat: the ellipse u² + v² <= level, where its exponent is at least log2(1/255) (docs/math.md, 8b,
// 8c).
//
// A pixel visited in vain costs time, a pixel missed changes the image. So the level and the ends of rows are enlarged
// by bounds on the rounding of both sides, of the code that visits (blocks.h, tiles.h) and of `exponent` (tile.h).
#pragma once
#include "frame.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr float kRounding = 0x1p-24f;  // relative error of one operation on floats

// Added to the level. A drawn splat has u² + v² <= level <= 8. Summing the exponent errs by 4 roundings of 8. v errs by
// 4 roundings of C (|y| + 8) in `exponent`, here by 4 of C |y| and 1 of 128 C, a box of tiles; C |y| <= sqrt(8) + 8 C
// where the ellipse meets the tile. An error of v counts 2 sqrt(8) times in v²: 1e-5 + 9e-5 C in all.
constexpr float kLevelMargin = 0x1p-15f, kLevelMarginOfC = 0x1p-13f;

// The end of a row is a sum of lengths. It errs by 10 roundings of the sum of their sizes, u in `exponent` by 5: twice
// that.
constexpr float kEndMargin = 2 * 15 * kRounding;

inline float sqrt(float x) { return __builtin_sqrtf(x); }
inline float abs(float x) { return __builtin_fabsf(x); }
inline float max(float a, float b) { return a > b ? a : b; }
inline float clamp(float x, float lo, float hi) { return x < lo ? lo : (x > hi ? hi : x); }

// F = float or a vector of splats; y is a row's distance from the splat's center.
template <class F> struct Reach {
  F B, C, level;
  F width, slope;  // row y has its middle at x = -slope y and its ends width sqrt(level - (C y)²) beside that

  Reach(F A, F B_, F C_, F log2_opacity)
      : B(B_), C(C_), level(log2_opacity - kLog2AlphaMin + (C_ * kLevelMarginOfC + kLevelMargin)),
        width(splat<F>(1.f) / A), slope(B_ / A) {}

  // level - (C y)²; negative where the row misses the ellipse.
  F square(F y) const {
    const F v = C * y;
    return level - v * v;
  }
  // The row in which the ellipse extends farthest to the right; to the left it is the opposite one.
  F rightmost() const { return -(B / C) * sqrt(max(level, splat<F>(0.f)) / (B * B + C * C)); }
  // Bounds the error of an end of row y less than `extent` - kTile from the origin of x, the center.
  F margin(F x, F y, float extent) const { return (abs(x) + abs(slope) * (abs(y) + kTile) + extent) * kEndMargin; }
};

}  // namespace gsopt::GSOPT_ISA

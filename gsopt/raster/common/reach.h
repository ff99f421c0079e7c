// The reach of a splat: the ellipse u² + v² <= level, where its exponent is at least log2(1/255) (docs/math.md, 8b,
// 8c).
//
// A pixel visited in vain costs time, a pixel missed changes the image. So the level and the ends of rows are enlarged
// by bounds on the rounding of both sides, of the code that visits and of `exponent` (blend.h).
#pragma once
#include "constants.h"

namespace gsopt::GSOPT_ISA {

constexpr float kRounding = 1.f / (1 << 24);  // relative error of one operation on floats

// Added to the level. A drawn splat has u² + v² <= level <= 8. Summing the exponent errs by 4 roundings of 8. v errs by
// 4 roundings of C (|y| + 8) in `exponent`, here by 4 of C |y| and 1 of 128 C, a box of tiles; C |y| <= sqrt(8) + 8 C
// where the ellipse meets the tile. An error of v counts 2 sqrt(8) times in v²: 1e-5 + 9e-5 C in all.
constexpr float kLevelMargin = 1.f / (1 << 15), kLevelMarginOfC = 1.f / (1 << 13);

// The end of a row is a sum of lengths. It errs by 10 roundings of the sum of their sizes, u in `exponent` by 5: twice
// that.
constexpr float kEndMargin = 2 * 15 * kRounding;

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

// Where the ellipse ends in the kTile rows from `top` on, in x as the center has it; `mx` is the center in the image.
template <class F> struct StripEnds {
  F left, right, square;  // square: negative where the ellipse does not reach the rows

  StripEnds(const Reach<F>& reach, F rightmost, F top, F x, F mx, float extent) {
    const F bottom = top + (kTile - 1.f), zero = splat<F>(0.f);
    const F y_right = clamp(rightmost, top, bottom), y_left = clamp(-rightmost, top, bottom);
    const F square_right = reach.square(y_right), square_left = reach.square(y_left);
    const F margin = reach.margin(mx, max(abs(y_right), abs(y_left)), extent);
    right = x - reach.slope * y_right + sqrt(max(square_right, zero)) * reach.width + margin;
    left = x - reach.slope * y_left - sqrt(max(square_left, zero)) * reach.width - margin;
    square = max(square_right, square_left);
  }
};

// The tiles [x0, x1) of a row of tiles, `top` its first row of pixels in y as the splat's center has it, that a splat
// touches; none where x0 >= x1.
struct Span {
  int x0, x1;
};
inline float in_tiles(float x) { return clamp(x * (1.f / kTile), -1.f, 65536.f); }
inline Span span_of(float mx, float top, float A, float B, float C, float log2_opacity, float extent) {
  const Reach<float> reach(A, B, C, log2_opacity);
  const StripEnds<float> ends(reach, reach.rightmost(), top, mx, mx, extent);
  if (!(ends.square >= 0.f)) return {0, 0};
  return {static_cast<int>(ceil(in_tiles(ends.left - (kTile - 0.5f)))),
      static_cast<int>(floor(in_tiles(ends.right - 0.5f))) + 1};
}

}  // namespace gsopt::GSOPT_ISA

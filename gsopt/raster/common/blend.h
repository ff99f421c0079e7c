// What one splat does to one pixel (docs/math.md, 7 to 10), forward and on the way back: both must decide alike.
// F = float (one pixel) or a vector of pixels.
#pragma once
#include "constants.h"

namespace gsopt::GSOPT_ISA {

// A splat's whitened coordinates, in units in which its exponent is log2_opacity - u² - v² (8a).
template <class F> struct Whitened {
  F u, v;
};
// Those of the tile's center, the splat's center being at (x, y) from it.
template <class F> inline Whitened<F> at_center(F A, F B, F C, F x, F y) { return {-(A * x + B * y), -(C * y)}; }

// A splat from the tile's center: (u0, v0) are its coordinates there.
template <class F> struct Spread {
  F A, B, C, u0, v0, log2_opacity;
};

// The exponent of (7) at a pixel that is (X, Y) from the tile's center, and the pixel's whitened coordinates.
template <class F> inline F exponent(const Spread<F>& s, F X, F Y, Whitened<F>& at) {
  at.u = s.A * X + (s.B * Y + s.u0);
  at.v = s.C * Y + s.v0;
  return s.log2_opacity - at.v * at.v - at.u * at.u;  // v is ready first
}

// alpha of (7).
template <class F> inline F alpha_of(F exponent) {
  return keep(exponent >= splat<F>(kLog2AlphaMin), min(exp2(exponent), splat<F>(kAlphaMax)));
}

// One splat back to front: from what a pixel was behind it to what it was in front of it, (9), and s and the weight of
// (10). q is the splat's color (and depth) on the pixel's gradient.
template <class F> struct Passed {
  F T, behind, weight, s;
};
template <class F> inline Passed<F> passed(F alpha, F q, F T_behind, F behind) {
  const F past = splat<F>(1.f) - alpha, T = T_behind * (splat<F>(1.f) / past), weight = alpha * T;
  // A clamped alpha does not move.
  return {T, behind * past + alpha * q, weight, keep(alpha < splat<F>(kAlphaMax), weight * (q - behind))};
}

}  // namespace gsopt::GSOPT_ISA

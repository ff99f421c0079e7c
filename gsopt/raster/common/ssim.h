// SSIM at one pixel-channel from filtered images, and its derivatives (docs/math.md, 19 and 20).
#pragma once
#include "constants.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-k² / (2 1.5²)), normalized over k = -5..5; index = |k|.
constexpr float kWindow[kRadius + 1] = {0.26601172f, 0.21300553f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};

// (19) and (20) at one pixel-channel: SSIM and its partial derivatives with respect to E[x], E[x² + y²], E[x y].
template <class F> inline F ssim_partials(F mx, F my, F square, F product, F& d_mean, F& d_square, F& d_product) {
  const F mxx = mx * mx + my * my, mxy = mx * my;
  const F a1 = mxy * 2.f + kC1, a2 = (product - mxy) * 2.f + kC2, b1 = mxx + kC1, b2 = (square - mxx) + kC2;
  const F inverse = splat<F>(1.f) / (b1 * b2), ssim = a1 * a2 * inverse;
  d_product = a1 * inverse * 2.f;
  d_square = splat<F>(0.f) - ssim * b1 * inverse;
  d_mean = (my * (a2 - a1) - mx * ssim * (b2 - b1)) * inverse * 2.f;
  return ssim;
}

}  // namespace gsopt::GSOPT_ISA

// One Adam step in place (docs/math.md, 22): some thousand Gaussians at a time, all their numbers.
#pragma once
#include "frame.h"
#include "parallel.h"
#include "project.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

// n numbers of a parameter from `begin` on, and their gradient `g`.
inline void adam_span(const AdamArguments& a, const AdamParameter& of, int64_t begin, int64_t n, const float* g) {
  float *p = of.param + begin, *m = of.exp_avg + begin, *v = of.exp_avg_sq + begin;
  int64_t i = 0;
  for (; i + kWide <= n; i += kWide) {
    wide param = load_wide(p + i), mean = load_wide(m + i), square = load_wide(v + i);
    adam_number(a.rates, of.step_size, of.inv_sqrt_correction2, load_wide(g + i), param, mean, square);
    store_wide(m + i, mean);
    store_wide(v + i, square);
    store_wide(p + i, param);
  }
  for (; i < n; ++i) adam_number(a.rates, of.step_size, of.inv_sqrt_correction2, g[i], p[i], m[i], v[i]);
}

// shN of n <= kWide Gaussians from `first` on, whose gradient is not stored. `rows` has room for it, zeros where no
// band is drawn.
inline void adam_bands(const AdamArguments& a, const AdamParameter& of, int64_t first, int n, float* rows) {
  const int bands = (a.sh_degree + 1) * (a.sh_degree + 1) - 1;
  alignas(64) float mean[3][kWide] = {}, Y[15][kWide];
  for (int l = 0; l < n; ++l)
    for (int k = 0; k < 3; ++k) mean[k][l] = a.means[3 * (first + l) + k];
  view_basis(a.camera, {load_wide(mean[0]), load_wide(mean[1]), load_wide(mean[2])}, a.sh_degree, Y);
  for (int l = 0; l < n; ++l) bands_gradient(a.v_sh0, first + l, bands, Y, l, rows + l * of.stride);
  adam_span(a, of, first * of.stride, n * of.stride, rows);
}

inline void adam_stage(Pool& pool, const AdamArguments& a) {
  // A multiple of every vector's width: for any number of threads only the last numbers are stepped one by one.
  const int64_t fair = a.count / (4 * pool.threads()) / 256 * 256,
                rows = fair < 256 ? 256 : (fair > 16384 ? 16384 : fair);
  parallel(pool, divide_up(a.count, rows), [&](int chunk, int) {
    const int64_t begin = chunk * rows, end = begin + rows < a.count ? begin + rows : a.count;
    if (a.bands.param) {  // first, while the means are those that were drawn
      alignas(64) float gradient[kWide * kMaxBands * 3 + 1] = {};
      for (int64_t i = begin; i < end; i += kWide)
        adam_bands(a, a.bands, i, end - i < kWide ? static_cast<int>(end - i) : kWide, gradient);
    }
    for (const AdamParameter& of : a.others)
      if (of.param) adam_span(a, of, begin * of.stride, (end - begin) * of.stride, of.grad + begin * of.stride);
  });
}

}  // namespace gsopt::GSOPT_ISA

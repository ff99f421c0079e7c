// One Adam step in place (Kingma & Ba 2015). Rows whose tail is not in use yet (spherical harmonics above the degree
// that is rendered) are left alone: their gradients and moments are zero, so the step would change nothing.
#pragma once
#include "frame.h"
#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

inline void adam_span(const AdamArguments& a, int64_t begin, int64_t n) {
  float *p = a.param + begin, *m = a.exp_avg + begin, *v = a.exp_avg_sq + begin;
  const float* g = a.grad + begin;
  const float d1 = 1.f - a.beta1, d2 = 1.f - a.beta2;
  int64_t i = 0;
  for (; i + kWide <= n; i += kWide) {
    const wide grad = load_wide(g + i), mean = load_wide(m + i) * a.beta1 + grad * d1, square = load_wide(v + i) * a.beta2 + grad * grad * d2;
    store_wide(m + i, mean), store_wide(v + i, square);
    store_wide(p + i, load_wide(p + i) - mean * a.step_size / (sqrt(square) * a.inv_sqrt_correction2 + a.eps));
  }
  for (; i < n; ++i) {
    m[i] = m[i] * a.beta1 + g[i] * d1;
    v[i] = v[i] * a.beta2 + g[i] * g[i] * d2;
    p[i] -= m[i] * a.step_size / (__builtin_sqrtf(v[i]) * a.inv_sqrt_correction2 + a.eps);
  }
}

inline void adam_stage(Pool& pool, const AdamArguments& a) {
  constexpr int64_t kRows = 2048;
  parallel(pool, divide_up(a.rows, kRows), [&](int chunk, int) {
    const int64_t begin = chunk * kRows, end = begin + kRows < a.rows ? begin + kRows : a.rows;
    if (a.active == a.stride) return adam_span(a, begin * a.stride, (end - begin) * a.stride);
    for (int64_t row = begin; row < end; ++row) adam_span(a, row * a.stride, a.active);
  });
}

}  // namespace gsopt::GSOPT_ISA

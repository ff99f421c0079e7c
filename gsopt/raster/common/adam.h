// One Adam step of one number (docs/math.md, 22), F = float or a vector of floats.
#pragma once

namespace gsopt {

struct AdamRates {
  float beta1, beta2, eps;
};

}  // namespace gsopt

namespace gsopt::GSOPT_ISA {

// `step_size`: the rate over the first bias correction; `inverse_root`: 1 over the root of the second.
template <class F> inline void adam_number(
    const AdamRates& a, float step_size, float inverse_root, F gradient, F& param, F& mean, F& square) {
  const float d1 = 1.f - a.beta1, d2 = 1.f - a.beta2;
  mean = mean * a.beta1 + gradient * d1;
  square = square * a.beta2 + gradient * gradient * d2;
  param = param - mean * step_size / (sqrt(square) * inverse_root + a.eps);
}

}  // namespace gsopt::GSOPT_ISA

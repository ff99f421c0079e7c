// Adam steps in place (docs/math.md, 22). One thread, one number.
#pragma once
#include "project_backward.h"

namespace gsopt::GSOPT_ISA {

struct AdamArguments {
  Index count;  // of numbers
  AdamRates rates;
  float step_size, inverse_root;
  const float* gradient;
  float *param, *exp_avg, *exp_avg_sq;
};

KERNEL(adam, AdamArguments) {
  PHASE(t) {
    const Index i = static_cast<Index>(block()) * kThreads + t;
    if (i < a.count)
      adam_number(a.rates, a.step_size, a.inverse_root, a.gradient[i], a.param[i], a.exp_avg[i], a.exp_avg_sq[i]);
  }
}

// shN whose gradient is not stored: some Gaussians to a block.
struct AdamBandsArguments {
  Camera camera;
  int count, sh_degree, sh_rest;  // of Gaussians
  AdamRates rates;
  float step_size, inverse_root;
  const float *means, *v_sh0;
  float *param, *exp_avg, *exp_avg_sq;
};

constexpr int kBandGroup = 64;  // Gaussians

KERNEL(adam_bands, AdamBandsArguments) {
  SHARED BandPull pull[kBandGroup];
  const Index first = static_cast<Index>(block()) * kBandGroup;
  const int n = a.count - first < kBandGroup ? static_cast<int>(a.count - first) : kBandGroup, stride = 3 * a.sh_rest;
  PHASE(t) {
    if (t < n) pull[t] = band_pull(&a.camera, a.sh_degree, a.means, a.v_sh0, first + t);
  }
  PHASE(t) {
    for (int i = t; i < n * stride; i += kThreads) {
      const BandPull& of = pull[i / stride];
      const int channel = i % 3;
      const float v = channel == 0 ? of.v_color.x : (channel == 1 ? of.v_color.y : of.v_color.z);
      const Index at = first * stride + i;
      adam_number(
          a.rates, a.step_size, a.inverse_root, v * of.Y[i % stride / 3], a.param[at], a.exp_avg[at], a.exp_avg_sq[at]);
    }
  }
}

}  // namespace gsopt::GSOPT_ISA

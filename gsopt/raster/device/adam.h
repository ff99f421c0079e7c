// Adam steps in place (docs/math.md, 22). One thread, one number.
#pragma once
#include "project_backward.h"

namespace gsopt::GSOPT_ISA {

// One tensor of the Gaussians: the blocks from `first_block` on step its numbers.
struct AdamTensor {
  Index count;
  int first_block;
  float step_size, inverse_root;
  GLOBAL const float* gradient;
  GLOBAL float *param, *exp_avg, *exp_avg_sq;
};

struct AdamArguments {
  AdamRates rates;
  int tensors;  // the others are not read
  AdamTensor of[6];
};

// Steps number i of a tensor, or of one band.
template <class Tensor> inline void step_number(const AdamRates& rates, const Tensor& of, float gradient, Index i) {
  float param = of.param[i], mean = of.exp_avg[i], square = of.exp_avg_sq[i];
  adam_number(rates, of.step_size, of.inverse_root, gradient, param, mean, square);
  of.param[i] = param;
  of.exp_avg[i] = mean;
  of.exp_avg_sq[i] = square;
}

KERNEL(adam, AdamArguments) {
  int k = 0;
  while (k + 1 < a.tensors && a.of[k + 1].first_block <= block()) ++k;
  PHASE(t) {
    const AdamTensor& of = a.of[k];
    const Index i = static_cast<Index>(block() - of.first_block) * kThreads + t;
    if (i < of.count) step_number(a.rates, of, of.gradient[i], i);
  }
}

// shN whose gradient is not stored: some Gaussians to a block.
struct AdamBandsArguments {
  Camera camera;
  int count, sh_degree, sh_rest;  // of Gaussians
  AdamRates rates;
  float step_size, inverse_root;
  GLOBAL const float *means, *v_sh0;
  GLOBAL float *param, *exp_avg, *exp_avg_sq;
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
      IN_BLOCK const BandPull& of = pull[i / stride];
      const int channel = i % 3;
      const float v = channel == 0 ? of.v_color.x : (channel == 1 ? of.v_color.y : of.v_color.z);
      step_number(a.rates, a, v * of.Y[i % stride / 3], first * stride + i);
    }
  }
}

}  // namespace gsopt::GSOPT_ISA

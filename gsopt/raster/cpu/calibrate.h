// What one core can do at best with one instruction set: the yardstick that `gsopt bench` holds the kernels against.
#pragma once
#include <chrono>
#include <ctime>

#include "frame.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

// CPU time of this thread, so that other work on the machine does not count; wall time where there is no such clock.
inline double thread_seconds() {
#if defined(CLOCK_THREAD_CPUTIME_ID)
  timespec t;
  if (clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t) == 0)
    return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
#endif
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// Lanes per second of `step`, applied again and again to independent chains: the best of several bursts of some 5 ms.
template <int Chains, class Step> inline double lanes_per_second(Step&& step) {
  constexpr int kBursts = 9, kRounds = 1 << 19;
  px chain[Chains];
  double best = 0;
  for (int burst = 0; burst < kBursts; ++burst) {
    for (int k = 0; k < Chains; ++k) chain[k] = splat<px>(0.001f * static_cast<float>(k + 1));
    const double start = thread_seconds();
    for (int round = 0; round < kRounds; ++round)
      for (int k = 0; k < Chains; ++k) chain[k] = step(chain[k]);
    const double rate = static_cast<double>(kRounds) * Chains * kPixels / (thread_seconds() - start);
    for (int k = 0; k < Chains; ++k) asm volatile("" ::"m"(chain[k]));  // the results are wanted
    best = rate > best ? rate : best;
  }
  return best;
}

inline Calibration calibrate() {
  // Values the compiler cannot know; both steps stay within [0, 1].
  volatile float half = 0.5f, tenth = 0.1f;
  const px a = splat<px>(half), b = splat<px>(tenth);
  return {lanes_per_second<10>([a, b](px x) { return x * a + b; }),
      lanes_per_second<6>([](px x) { return exp2(splat<px>(0.f) - x); })};
}

}  // namespace gsopt::GSOPT_ISA

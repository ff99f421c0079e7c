// What this processor can run and its operating system saves (x86-64). Asked of the processor itself: not every
// compiler's runtime knows it.
#pragma once
#include <cpuid.h>

#include <cstdint>

namespace gsopt {

inline bool bit(uint32_t word, int at) { return (word >> at) & 1; }

// The parts of the registers that the operating system saves; 0 where it saves none of AVX's.
inline uint32_t saved_registers() {
  uint32_t a = 0, b = 0, c = 0, d = 0;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !bit(c, 27)) return 0;
  asm volatile("xgetbv" : "=a"(a), "=d"(d) : "c"(0));
  return a;
}

inline bool has_avx2() {
  uint32_t a = 0, b = 0, c = 0, d = 0, b7 = 0, c_extended = 0;
  constexpr uint32_t kSseAndAvx = 0x06;
  if ((saved_registers() & kSseAndAvx) != kSseAndAvx || !__get_cpuid(1, &a, &b, &c, &d)) return false;
  const bool avx = bit(c, 28), fma = bit(c, 12);
  if (!__get_cpuid_count(7, 0, &a, &b7, &c, &d) || !__get_cpuid(0x80000001, &a, &b, &c_extended, &d)) return false;
  const bool avx2 = bit(b7, 5), bmi = bit(b7, 3), bmi2 = bit(b7, 8), lzcnt = bit(c_extended, 5);
  return avx && fma && avx2 && bmi && bmi2 && lzcnt;
}

inline bool has_avx512() {
  uint32_t a = 0, b = 0, c = 0, d = 0;
  constexpr uint32_t kSseAvxAndAvx512 = 0xe6;
  if (!has_avx2() || (saved_registers() & kSseAvxAndAvx512) != kSseAvxAndAvx512) return false;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return false;
  const bool f = bit(b, 16), dq = bit(b, 17), bw = bit(b, 30), vl = bit(b, 31);
  return f && dq && bw && vl;
}

}  // namespace gsopt

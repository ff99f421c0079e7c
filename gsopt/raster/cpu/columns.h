// Rows in memory, as many as a vector has lanes, and one vector per column.
#pragma once
#include "simd.h"

namespace gsopt::GSOPT_ISA {

#if defined(__AVX2__)
inline f8 joined(f4 a, f4 b) { return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7); }
#else  // registers of four lanes: of eight a compiler would move one by one
inline f8 joined(f4 a, f4 b) {
  f8 v;
  store4(reinterpret_cast<float*>(&v), a);
  store4(reinterpret_cast<float*>(&v) + 4, b);
  return v;
}
inline f4 four(f8 v, int i) { return load4(reinterpret_cast<const float*>(&v) + 4 * i); }
#endif

// Of every four lanes of a and b: (a0 b0 a1 b1), (a2 b2 a3 b3), (a0 a1 b0 b1), (a2 a3 b2 b3); of every eight, as fours
// A B: (A0 B0), (A1 B1).
#if defined(GSOPT_SIXTEEN)
#define GSOPT_SHUFFLE(name, a0, a1, a2, a3, a4, a5, a6, a7, b0, b1, b2, b3, b4, b5, b6, b7)               \
  inline wide name(wide a, wide b) {                                                                      \
    return __builtin_shufflevector(a, b, a0, a1, a2, a3, a4, a5, a6, a7, b0, b1, b2, b3, b4, b5, b6, b7); \
  }
GSOPT_SHUFFLE(mixed_low, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29)
GSOPT_SHUFFLE(mixed_high, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31)
GSOPT_SHUFFLE(twos_low, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
GSOPT_SHUFFLE(twos_high, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31)
GSOPT_SHUFFLE(fours_low, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27)
GSOPT_SHUFFLE(fours_high, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31)
#elif defined(__AVX2__)
#define GSOPT_SHUFFLE(name, a0, a1, a2, a3, a4, a5, a6, a7) \
  inline wide name(wide a, wide b) { return __builtin_shufflevector(a, b, a0, a1, a2, a3, a4, a5, a6, a7); }
GSOPT_SHUFFLE(mixed_low, 0, 8, 1, 9, 4, 12, 5, 13)
GSOPT_SHUFFLE(mixed_high, 2, 10, 3, 11, 6, 14, 7, 15)
GSOPT_SHUFFLE(twos_low, 0, 1, 8, 9, 4, 5, 12, 13)
GSOPT_SHUFFLE(twos_high, 2, 3, 10, 11, 6, 7, 14, 15)
GSOPT_SHUFFLE(fours_low, 0, 1, 2, 3, 8, 9, 10, 11)
GSOPT_SHUFFLE(fours_high, 4, 5, 6, 7, 12, 13, 14, 15)
#else
#define GSOPT_SHUFFLE(name, a0, a1, a2, a3)                                        \
  inline wide name(wide a, wide b) {                                               \
    return joined(__builtin_shufflevector(four(a, 0), four(b, 0), a0, a1, a2, a3), \
        __builtin_shufflevector(four(a, 1), four(b, 1), a0, a1, a2, a3));          \
  }
GSOPT_SHUFFLE(mixed_low, 0, 4, 1, 5)
GSOPT_SHUFFLE(mixed_high, 2, 6, 3, 7)
GSOPT_SHUFFLE(twos_low, 0, 1, 4, 5)
GSOPT_SHUFFLE(twos_high, 2, 3, 6, 7)
inline wide fours_low(wide a, wide b) { return joined(four(a, 0), four(b, 0)); }
inline wide fours_high(wide a, wide b) { return joined(four(a, 1), four(b, 1)); }
#endif
#undef GSOPT_SHUFFLE

// In every four lanes, rows become columns.
inline void transpose_fours(wide v[4]) {
  const wide a = mixed_low(v[0], v[1]), b = mixed_high(v[0], v[1]), c = mixed_low(v[2], v[3]),
             d = mixed_high(v[2], v[3]);
  v[0] = twos_low(a, c);
  v[1] = twos_high(a, c);
  v[2] = twos_low(b, d);
  v[3] = twos_high(b, d);
}

// Four floats of each of kWide rows, row(lane), become four columns.
template <class Row> inline void load_fours(Row&& row, wide v[4]) {
  for (int i = 0; i < 4; ++i) {
#if defined(GSOPT_SIXTEEN)
    v[i] = joined(joined(row(i), row(4 + i)), joined(row(8 + i), row(12 + i)));
#else
    v[i] = joined(row(i), row(4 + i));
#endif
  }
  transpose_fours(v);
}

// Eight floats of each of kWide rows, row(lane), become eight columns.
template <class Row> inline void load_eights(Row&& row, wide v[8]) {
  for (int i = 0; i < 8; ++i) {
#if defined(GSOPT_SIXTEEN)
    v[i] = joined(row(i), row(8 + i));
#else
    v[i] = row(i);
#endif
  }
  transpose_fours(v);
  transpose_fours(v + 4);
  for (int i = 0; i < 4; ++i) {
    const wide a = v[i], b = v[i + 4];
    v[i] = fours_low(a, b);
    v[i + 4] = fours_high(a, b);
  }
}

// Four columns become four floats of each of kWide rows, for which store(lane, them) is called.
template <class Store> inline void store_fours(const wide (&columns)[4], Store&& store) {
  wide v[4] = {columns[0], columns[1], columns[2], columns[3]};
  transpose_fours(v);
  for (int i = 0; i < 4; ++i) {
    store(i, __builtin_shufflevector(v[i], v[i], 0, 1, 2, 3));
    store(4 + i, __builtin_shufflevector(v[i], v[i], 4, 5, 6, 7));
#if defined(GSOPT_SIXTEEN)
    store(8 + i, __builtin_shufflevector(v[i], v[i], 8, 9, 10, 11));
    store(12 + i, __builtin_shufflevector(v[i], v[i], 12, 13, 14, 15));
#endif
  }
}

// The sums of the lanes of twelve vectors, into p[0] ... p[11]; p[12] ... p[15] become zero.
inline void store_sums(float* p, const wide (&v)[12]) {
  const auto fours = [](const wide* v) {  // in every four lanes, what is left to add of v[0], v[1], v[2], v[3]
    const wide a = mixed_low(v[0], v[1]) + mixed_high(v[0], v[1]), b = mixed_low(v[2], v[3]) + mixed_high(v[2], v[3]);
    return twos_low(a, b) + twos_high(a, b);
  };
  const wide a = fours(v), b = fours(v + 4), c = fours(v + 8), zero = splat<wide>(0.f);
#if defined(GSOPT_SIXTEEN)
  const wide low = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
                   __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
  const wide high = __builtin_shufflevector(c, zero, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
                    __builtin_shufflevector(c, zero, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
  store_wide(p, __builtin_shufflevector(low, high, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) +
                    __builtin_shufflevector(low, high, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31));
#else
  store_wide(p, fours_low(a, b) + fours_high(a, b));
  store_wide(p + 8, fours_low(c, zero) + fours_high(c, zero));
#endif
}

}  // namespace gsopt::GSOPT_ISA

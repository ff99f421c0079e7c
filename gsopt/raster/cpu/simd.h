// Vectors of 4, 8 and 16 lanes from one source: GCC/Clang vector extensions, with an intrinsic only where the language
// has no operator. 8 lanes, or with GSOPT_SIXTEEN 16, hold the pixels of a block (`px`) and Gaussians and whatever else
// is as wide as it can be (`wide`). Included once per instruction set; everything lives in that set's own namespace.
#pragma once
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace gsopt::GSOPT_ISA {

using f4 = float __attribute__((vector_size(16)));
using f8 = float __attribute__((vector_size(32)));
using i8 = int32_t __attribute__((vector_size(32)));
// Unaligned views of the same, for loads and stores. clang lowers the alignment of a typedef only, not of an alias.
typedef float f4u __attribute__((vector_size(16), aligned(4), may_alias));
typedef float f8u __attribute__((vector_size(32), aligned(4), may_alias));
typedef int32_t i8u __attribute__((vector_size(32), aligned(4), may_alias));

constexpr int kLanes = 8;
// Times `sqrt_near` it is no less than `sqrt`: processors promise 1.5 / 2^12 for rsqrt, the products round.
constexpr float kSqrtNear = 1.f + 1.625f / 4096;

inline f4 load4(const float* p) { return *reinterpret_cast<const f4u*>(p); }
inline void store4(float* p, f4 v) { *reinterpret_cast<f4u*>(p) = v; }
inline f8 load8(const float* p) { return *reinterpret_cast<const f8u*>(p); }
inline void store8(float* p, f8 v) { *reinterpret_cast<f8u*>(p) = v; }
inline i8 load8i(const int32_t* p) { return *reinterpret_cast<const i8u*>(p); }
inline void store8i(int32_t* p, i8 v) { *reinterpret_cast<i8u*>(p) = v; }

template <class V> V splat(float x);
template <> inline float splat<float>(float x) { return x; }
template <> inline f4 splat<f4>(float x) { return f4{x, x, x, x}; }
template <> inline f8 splat<f8>(float x) { return f8{x, x, x, x, x, x, x, x}; }
inline i8 splat8i(int32_t x) { return i8{x, x, x, x, x, x, x, x}; }

inline float sqrt(float x) { return __builtin_sqrtf(x); }
inline float abs(float x) { return __builtin_fabsf(x); }
inline float max(float a, float b) { return a > b ? a : b; }
inline float clamp(float x, float lo, float hi) { return x < lo ? lo : (x > hi ? hi : x); }
inline float ceil(float x) { return __builtin_ceilf(x); }
inline float floor(float x) { return __builtin_floorf(x); }

inline i8 bits(f8 v) { return (i8)v; }
inline f8 from_bits(i8 v) { return (f8)v; }
inline i8 to_int(f8 v) { return __builtin_convertvector(v, i8); }  // truncates
inline f8 to_float(i8 v) { return __builtin_convertvector(v, f8); }
inline f8 abs(f8 a) { return (f8)((i8)a & splat8i(0x7fffffff)); }

#if defined(__AVX2__)
inline int movemask(i8 m) { return _mm256_movemask_ps((__m256)m); }
inline i8 max(i8 a, i8 b) { return (i8)_mm256_max_epi32((__m256i)a, (__m256i)b); }
// a where m, else +0. By name, because the operator & is an integer instruction, for whose result
// an instruction on floats waits two cycles more.
inline f8 keep(i8 m, f8 a) { return (f8)_mm256_and_ps((__m256)m, (__m256)a); }
inline f8 select(i8 m, f8 a, f8 b) { return (f8)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)m); }
inline f8 sqrt(f8 a) { return (f8)_mm256_sqrt_ps((__m256)a); }
inline f8 sqrt_near(f8 a) { return (f8)_mm256_rsqrt_ps((__m256)a) * a; }  // NaN at 0
inline f8 min(f8 a, f8 b) { return (f8)_mm256_min_ps((__m256)a, (__m256)b); }
inline f8 max(f8 a, f8 b) { return (f8)_mm256_max_ps((__m256)a, (__m256)b); }
inline i8 shift_left(i8 a, i8 n) { return (i8)_mm256_sllv_epi32((__m256i)a, (__m256i)n); }
#else
inline int movemask(i8 m) {
  int r = 0;
  for (int k = 0; k < 8; ++k) r |= (m[k] < 0) << k;
  return r;
}
inline i8 max(i8 a, i8 b) { return a > b ? a : b; }
inline f8 keep(i8 m, f8 a) { return (f8)(m & (i8)a); }
inline f8 select(i8 m, f8 a, f8 b) { return m ? a : b; }
inline f8 sqrt(f8 a) {
  f8 r;
  for (int k = 0; k < 8; ++k) r[k] = __builtin_sqrtf(a[k]);
  return r;
}
inline f8 sqrt_near(f8 a) { return sqrt(a); }
inline f8 min(f8 a, f8 b) { return a < b ? a : b; }
inline f8 max(f8 a, f8 b) { return a > b ? a : b; }
inline i8 shift_left(i8 a, i8 n) { return a << n; }
#endif

inline bool any(i8 m) { return movemask(m) != 0; }
inline f8 clamp(f8 x, f8 lo, f8 hi) { return min(max(x, lo), hi); }

// The largest lane.
inline int most(i8 a) {
  a = max(a, __builtin_shufflevector(a, a, 4, 5, 6, 7, 0, 1, 2, 3));
  a = max(a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
  return a[0] > a[1] ? a[0] : a[1];
}

inline i8 select(i8 m, i8 a, i8 b) { return (i8)select(m, (f8)a, (f8)b); }

inline i8 shift_exponent(i8 n) { return n << 23; }

#if defined(GSOPT_SIXTEEN)
using f16 = float __attribute__((vector_size(64)));
using i16 = int32_t __attribute__((vector_size(64)));
typedef float f16u __attribute__((vector_size(64), aligned(4), may_alias));
typedef int32_t i16u __attribute__((vector_size(64), aligned(4), may_alias));
template <> inline f16 splat<f16>(float x) { return f16{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }
inline i16 splat16i(int32_t x) { return i16{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }
inline i16 bits(f16 v) { return (i16)v; }
inline f16 from_bits(i16 v) { return (f16)v; }
inline f16 keep(i16 m, f16 a) { return (f16)(m & (i16)a); }
inline f16 select(i16 m, f16 a, f16 b) { return m ? a : b; }
inline i16 select(i16 m, i16 a, i16 b) { return m ? a : b; }
inline f16 to_float(i16 v) { return __builtin_convertvector(v, f16); }
inline i16 to_int(f16 v) { return __builtin_convertvector(v, i16); }  // truncates
inline f16 joined(f8 a, f8 b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
inline f16 abs(f16 a) { return (f16)((i16)a & splat16i(0x7fffffff)); }
inline i16 shift_exponent(i16 n) { return n << 23; }
inline f8 low_half(f16 a) { return __builtin_shufflevector(a, a, 0, 1, 2, 3, 4, 5, 6, 7); }
inline f8 high_half(f16 a) { return __builtin_shufflevector(a, a, 8, 9, 10, 11, 12, 13, 14, 15); }
#if defined(__AVX512F__)
inline f16 sqrt(f16 a) { return (f16)_mm512_sqrt_ps((__m512)a); }
inline f16 sqrt_near(f16 a) { return (f16)_mm512_rsqrt14_ps((__m512)a) * a; }
inline f16 max(f16 a, f16 b) { return (f16)_mm512_max_ps((__m512)a, (__m512)b); }
inline i16 shift_left(i16 a, i16 n) { return (i16)_mm512_sllv_epi32((__m512i)a, (__m512i)n); }
inline f16 min(f16 a, f16 b) { return (f16)_mm512_min_ps((__m512)a, (__m512)b); }
inline i16 max(i16 a, i16 b) { return (i16)_mm512_max_epi32((__m512i)a, (__m512i)b); }
inline int movemask(i16 m) { return _mm512_movepi32_mask((__m512i)m); }
#else
inline f16 sqrt(f16 a) { return joined(sqrt(low_half(a)), sqrt(high_half(a))); }
inline f16 sqrt_near(f16 a) { return joined(sqrt_near(low_half(a)), sqrt_near(high_half(a))); }
inline f16 max(f16 a, f16 b) { return joined(max(low_half(a), low_half(b)), max(high_half(a), high_half(b))); }
inline i16 shift_left(i16 a, i16 n) {
  return (i16)joined((f8)shift_left((i8)low_half((f16)a), (i8)low_half((f16)n)),
      (f8)shift_left((i8)high_half((f16)a), (i8)high_half((f16)n)));
}
inline f16 min(f16 a, f16 b) { return joined(min(low_half(a), low_half(b)), min(high_half(a), high_half(b))); }
inline i16 max(i16 a, i16 b) { return a > b ? a : b; }
inline int movemask(i16 m) { return movemask((i8)low_half((f16)m)) | movemask((i8)high_half((f16)m)) << 8; }
#endif
inline f16 clamp(f16 x, f16 lo, f16 hi) { return min(max(x, lo), hi); }
inline bool any(i16 m) { return movemask(m) != 0; }
inline int most(i16 a) { return most(max((i8)low_half((f16)a), (i8)high_half((f16)a))); }
#endif

// The pixels of a block, one per lane: 4x4 in 16 lanes, 4x2 in 8. Masks are integers, all ones where true.
#if defined(GSOPT_SIXTEEN)
using px = f16;
using pxi = i16;
inline px load_px(const float* p) { return *reinterpret_cast<const f16u*>(p); }
inline void store_px(float* p, px v) { *reinterpret_cast<f16u*>(p) = v; }
inline pxi load_pxi(const int32_t* p) { return *reinterpret_cast<const i16u*>(p); }
inline void store_pxi(int32_t* p, pxi v) { *reinterpret_cast<i16u*>(p) = v; }
inline pxi splat_pxi(int32_t x) { return splat16i(x); }
#else
using px = f8;
using pxi = i8;
inline px load_px(const float* p) { return load8(p); }
inline void store_px(float* p, px v) { store8(p, v); }
inline pxi load_pxi(const int32_t* p) { return load8i(p); }
inline void store_pxi(int32_t* p, pxi v) { store8i(p, v); }
inline pxi splat_pxi(int32_t x) { return splat8i(x); }
#endif
using wide = px;
using widei = pxi;
inline widei splat_widei(int32_t x) { return splat_pxi(x); }
inline void store_widei(int32_t* p, widei v) { store_pxi(p, v); }
inline widei load_widei(const int32_t* p) { return load_pxi(p); }
inline wide load_wide(const float* p) { return load_px(p); }
inline void store_wide(float* p, wide v) { store_px(p, v); }
constexpr int kWide = sizeof(wide) / sizeof(float);
constexpr int kPixels = sizeof(px) / sizeof(float);  // pixels of a block, always 4 wide
constexpr int kBlocks = 256 / kPixels;               // blocks of a 16x16 tile

// 2^x for |x| < 126, relative error 2.4e-7: minimax polynomial of degree 5 on [-1/2, 1/2] (Remez, relative weight)
// times a power of two put together from its bits. Outside that range the result is arbitrary but harmless: mask it.
template <class V> inline V exp2(V x) {
  const V magic = splat<V>(12582912.f);  // 1.5 * 2^23: adding it leaves round(x) in the low bits of the mantissa
  const V shifted = x + magic;
  const V f = x - (shifted - magic);
  const V f2 = f * f;  // Estrin's scheme: three short chains instead of one long one
  const V low = f * splat<V>(6.93146967060e-01f) + splat<V>(1.0000000717e+00f);
  const V mid = f * splat<V>(5.55071327350e-02f) + splat<V>(2.40221221290e-01f);
  const V high = f * splat<V>(1.32764719920e-03f) + splat<V>(9.67554133450e-03f);
  const V p = (high * f2 + mid) * f2 + low;
  return from_bits(bits(p) + shift_exponent(bits(shifted)));
}

#if defined(GSOPT_SIXTEEN) && defined(__AVX512F__)
// The same from a table of 2^(i/32), i the low bits of round(32 x), and a polynomial of degree 2 on [-1/64, 1/64]:
// fewer steps, where one instruction looks up 16 of 32 numbers. The other bits of round(32 x), shifted into the
// exponent, bring i along into the mantissa; the table has it subtracted.
struct ExpTable {
  int32_t of[32];
  constexpr ExpTable() : of() {
    double power = 1;
    for (int i = 0; i < 32; ++i, power *= 1.0218971486541166)
      of[i] = std::bit_cast<int32_t>(static_cast<float>(power)) - (i << 18);
  }
};
inline constexpr ExpTable kExpTable;
template <> inline f16 exp2<f16>(f16 x) {
  const i16 low = *reinterpret_cast<const i16u*>(kExpTable.of),
            high = *reinterpret_cast<const i16u*>(kExpTable.of + 16);
  const f16 magic = splat<f16>(393216.f);  // 1.5 * 2^18
  const f16 shifted = x + magic, f = x - (shifted - magic);
  const f16 power = from_bits(
      (i16)_mm512_permutex2var_epi32((__m512i)low, (__m512i)bits(shifted), (__m512i)high) + (bits(shifted) << 18));
  return power + power * (f * (f * splat<f16>(2.402265e-01f) + splat<f16>(6.9315733e-01f)));
}
#endif

template <class V> inline V exp(V x) {
  return exp2(clamp(x * splat<V>(1.44269504089f), splat<V>(-125.f), splat<V>(125.f)));
}

// log2(x) for normal x > 0: x = 2^k m with m in [sqrt(1/2), sqrt(2)), then the series of atanh((m-1)/(m+1)).
template <class V> inline V log2(V x) {
  const auto k = (bits(x) - 0x3f3504f3) >> 23;
  const V m = from_bits(bits(x) - (k << 23));
  const V one = splat<V>(1.f), s = (m - one) / (m + one), s2 = s * s;
  V p = splat<V>(1.f / 9);
  p = p * s2 + splat<V>(1.f / 7);
  p = p * s2 + splat<V>(1.f / 5);
  p = p * s2 + splat<V>(1.f / 3);
  p = p * s2 + one;
  return to_float(k) + p * s * splat<V>(2.88539008178f);
}

}  // namespace gsopt::GSOPT_ISA

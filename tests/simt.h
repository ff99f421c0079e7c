// The kernels of gsopt/raster/device on a CPU: the threads of a block are a loop, and a phase ends where it does.
// Within a phase any order must do; `order` says which is taken. Memory that nobody wrote holds a pattern, not zeros.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#define GSOPT_ISA device

#define KERNEL(name, Arguments)                                                    \
  static void name##_block(const Arguments& a);                                    \
  extern "C" unsigned long size_of_##name() { return sizeof(Arguments); }          \
  extern "C" void run_##name(const Arguments* a, int blocks, const Order* order) { \
    simt.order = order->threads;                                                   \
    for (int b = 0; b < blocks; ++b) {                                             \
      simt.block = order->backwards ? blocks - 1 - b : b;                          \
      name##_block(*a);                                                            \
    }                                                                              \
  }                                                                                \
  static void name##_block(const Arguments& a)
#define PHASE(t) for (int t##_at = 0, t = simt.order[0]; t##_at < kThreads; t = simt.order[++t##_at])
#define SHARED
#define GLOBAL
#define IN_BLOCK
#define NOT_INLINED __attribute__((noinline))

namespace gsopt::GSOPT_ISA {

using Index = long long;
constexpr int kThreads = 256;
constexpr int kBatch = 16;

// In which order a processor takes the threads of a block, and the blocks.
struct Order {
  int threads[kThreads + 1];  // the last is not used
  int backwards;
};
struct Simt {
  const int* order;
  int block;
};
inline Simt simt;
inline int block() { return simt.block; }

template <class T> struct Own {
  T value[kThreads];
  T& operator[](int t) { return value[t]; }
};
inline bool all_threads(const Own<bool>& own, int*) {
  for (bool mine : own.value)
    if (!mine) return false;
  return true;
}
inline void shared_max(int* to, int value) { *to = *to > value ? *to : value; }

inline float sqrt(float x) { return __builtin_sqrtf(x); }
inline float log2(float x) { return __builtin_log2f(x); }
inline float exp2(float x) { return __builtin_exp2f(x); }
inline float ceil(float x) { return __builtin_ceilf(x); }
inline float floor(float x) { return __builtin_floorf(x); }
inline float abs(float x) { return __builtin_fabsf(x); }
inline float exp_of(float x) { return __builtin_expf(x); }
inline int float_bits(float x) {
  int bits;
  std::memcpy(&bits, &x, sizeof(bits));
  return bits;
}

}  // namespace gsopt::GSOPT_ISA

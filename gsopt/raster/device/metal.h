// The kernels in this folder for Apple's GPUs: what simt.h says for NVRTC, in Metal's language. metal.py writes the
// entry of every kernel, with the number of its block and of its thread, and `thread` where no pointer's place is
// named.
#pragma once
#include <metal_stdlib>

#define PHASE(t) for (int t = begin_phase(own_thread), t##_once = 1; t##_once; t##_once = 0)
#define SHARED threadgroup
#define GLOBAL device
#define IN_BLOCK threadgroup
#define NOT_INLINED __attribute__((noinline))
#define block() static_cast<int>(own_block)

using Index = long;
constexpr int kThreads = 256;
constexpr int kBatch = 8;  // a block has 32 KB

// Threads hand each other nothing through the memory of the GPU, so only that of the block is waited for.
inline void barrier() { metal::threadgroup_barrier(metal::mem_flags::mem_threadgroup); }
inline int begin_phase(uint own_thread) {
  barrier();
  return static_cast<int>(own_thread);
}

template <class T> struct Own {
  T value;
  T& operator[](int) thread { return value; }
};
inline IN_BLOCK metal::atomic_int* atomic(IN_BLOCK int* number) {
  return reinterpret_cast<IN_BLOCK metal::atomic_int*>(number);
}
inline void shared_max(IN_BLOCK int* to, int value) {
  metal::atomic_fetch_max_explicit(atomic(to), value, metal::memory_order_relaxed);
}
inline bool all_threads(Own<bool>& own, IN_BLOCK int* scratch) {
  metal::atomic_store_explicit(atomic(scratch), 0, metal::memory_order_relaxed);
  barrier();
  if (!own.value) metal::atomic_store_explicit(atomic(scratch), 1, metal::memory_order_relaxed);
  barrier();
  return metal::atomic_load_explicit(atomic(scratch), metal::memory_order_relaxed) == 0;
}

inline float sqrt(float x) { return metal::precise::sqrt(x); }
inline float log2(float x) { return metal::precise::log2(x); }
inline float exp2(float x) { return metal::precise::exp2(x); }
inline float ceil(float x) { return metal::precise::ceil(x); }
inline float floor(float x) { return metal::precise::floor(x); }
inline float abs(float x) { return metal::precise::fabs(x); }
inline float exp_of(float x) { return metal::precise::exp(x); }
inline int float_bits(float x) { return as_type<int>(x); }

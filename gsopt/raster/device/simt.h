// How the kernels in this folder are written, for NVRTC and HIPRTC. A kernel is a sequence of phases; in a phase every
// thread of a block does its own work, and none begins the next before all are done: a barrier cannot be forgotten.
// No kernel knows how many threads of a processor march together. tests/simt.h runs the same text on a CPU.
#pragma once

#define GSOPT_ISA device

// A kernel takes one record, `a`.
#define KERNEL(name, Arguments) extern "C" __global__ void __launch_bounds__(kThreads) name(const Arguments a)
// What follows is done by every thread of the block; `t` is its number.
#define PHASE(t) if (const int t = begin_phase(); true)
// Memory of a block.
#define SHARED __shared__
// Where that lies which a pointer or a reference leads to: in the GPU's memory, in a block's, else with the thread.
#define GLOBAL
#define IN_BLOCK
#define NOT_INLINED __attribute__((noinline))

#if defined(__HIP__)
#pragma clang force_cuda_host_device begin
#endif

namespace gsopt::GSOPT_ISA {

using Index = long long;
constexpr int kThreads = 256;  // of a block
constexpr int kBatch = 16;     // splats that blend_backward takes at a time: what a block's memory holds

inline int block() { return static_cast<int>(blockIdx.x); }
inline int begin_phase() {
  __syncthreads();
  return static_cast<int>(threadIdx.x);
}

// What a thread keeps from one phase to the next.
template <class T> struct Own {
  T value;
  T& operator[](int) { return value; }
};
// `scratch`: a number of the block that nothing else uses.
inline bool all_threads(Own<bool>& own, IN_BLOCK int*) { return __syncthreads_and(own.value); }
inline void shared_max(IN_BLOCK int* to, int value) { atomicMax(to, value); }

inline float sqrt(float x) { return sqrtf(x); }
inline float log2(float x) { return log2f(x); }
inline float exp2(float x) { return exp2f(x); }
inline float ceil(float x) { return ceilf(x); }
inline float floor(float x) { return floorf(x); }
inline float abs(float x) { return fabsf(x); }
inline float exp_of(float x) { return expf(x); }
inline int float_bits(float x) { return __float_as_int(x); }

}  // namespace gsopt::GSOPT_ISA

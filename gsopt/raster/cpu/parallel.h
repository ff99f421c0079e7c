// A loop over items on the pool; the body's trampoline belongs to the including file's instruction set.
#pragma once
#include "pool.h"

namespace gsopt::GSOPT_ISA {

template <class Body> inline void parallel(Pool& pool, int items, Body&& body) {
  using Plain = std::remove_reference_t<Body>;
  pool.run(items, [](void* context, int item, int worker) { (*static_cast<Plain*>(context))(item, worker); }, &body);
}

constexpr int divide_up(int64_t a, int64_t b) { return static_cast<int>((a + b - 1) / b); }

}  // namespace gsopt::GSOPT_ISA

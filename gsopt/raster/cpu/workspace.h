// A workspace, the arrays that Python hands over, and what every binding does with them.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <chrono>
#include <cstdint>
#include <ctime>
#include <map>
#include <stdexcept>
#include <string>

#include "frame.h"

namespace nb = nanobind;

namespace gsopt {

using In = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using InByte = nb::ndarray<const uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using OutShort = nb::ndarray<int16_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using InInt = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using InImage = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutInt = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;

const Kernels* choose_kernels(const std::string& name);

struct Workspace {
  Pool pool;
  const Kernels* kernels;
  Buffer scratch;
  int64_t max_entries = UINT32_MAX;  // (splat, tile) pairs of one frame
  bool count_work = false;
  Skips skips;
  Work work;                                  // summed over frames while count_work is set
  std::map<std::string, double> seconds;      // wall time per stage since construction
  std::map<std::string, double> cpu_seconds;  // the same in CPU time of the whole process
  Workspace(int threads, const std::string& isa) : pool(threads), kernels(choose_kernels(isa)) { keep_freed_memory(); }
};

template <class Stage> void timed(Workspace& ws, const char* name, Stage&& stage) {
  const auto start = std::chrono::steady_clock::now();
  const std::clock_t cpu_start = std::clock();
  stage();
  ws.seconds[name] += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  ws.cpu_seconds[name] += static_cast<double>(std::clock() - cpu_start) / CLOCKS_PER_SEC;
}

template <class Array> auto* data_of(const Array& a, size_t size, const char* name) {
  if (a.size() != size) throw std::invalid_argument(std::string(name) + ": wrong number of elements");
  return a.data();
}

// The kernels that serve the start of a run: they prepare what is optimized.
void define_preparation(nb::module_& m);

}  // namespace gsopt

#include <cstdlib>
#include <new>
#if defined(__linux__)
#include <sys/mman.h>
#endif
#if defined(__GLIBC__)
#include <malloc.h>
#endif

#include "frame.h"

namespace gsopt {

Buffer::~Buffer() { std::free(data_); }

// Large buffers lie on large pages where the system has them: splats lie all over, and looking up a page costs time
// too.
void Buffer::reserve(size_t bytes) {
  if (bytes <= capacity_) return;
  constexpr size_t kPage = 4096, kLargePage = size_t{1} << 21;
  const size_t wanted = bytes + bytes / 4;  // a quarter to spare: scenes grow a little at a time
  const size_t page = wanted < 8 * kLargePage ? kPage : kLargePage, grown = (wanted + page - 1) / page * page;
  std::free(data_);
  capacity_ = 0;
  data_ = std::aligned_alloc(page, grown);
  if (!data_) throw std::bad_alloc();
  capacity_ = grown;
#if defined(MADV_HUGEPAGE)
  if (page == kLargePage) madvise(data_, grown, MADV_HUGEPAGE);
#endif
}

// Arrays of a few MB are made and dropped all the time, and the system clears every page that it hands out anew: what
// was freed stays at hand, up to 128 MB.
void keep_freed_memory() {
#if defined(__GLIBC__)
  mallopt(M_MMAP_THRESHOLD, 32 << 20);  // the most that mallopt takes
  mallopt(M_TRIM_THRESHOLD, 128 << 20);
#endif
}

}  // namespace gsopt

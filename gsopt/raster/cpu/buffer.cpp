#include <cstdlib>
#include <new>

#include "frame.h"

namespace gsopt {

Buffer::~Buffer() { std::free(data_); }

void Buffer::reserve(size_t bytes) {
  if (bytes <= capacity_) return;
  const size_t grown = (bytes + bytes / 4 + 4095) / 4096 * 4096;  // a quarter to spare: scenes grow a little at a time
  std::free(data_);
  capacity_ = 0;
  data_ = std::aligned_alloc(4096, grown);
  if (!data_) throw std::bad_alloc();
  capacity_ = grown;
}

}  // namespace gsopt

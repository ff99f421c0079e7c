#include "pool.h"

#include <chrono>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace gsopt {
namespace {

constexpr auto kSpin = std::chrono::microseconds(50);

inline void relax() {
#if defined(__x86_64__)
  _mm_pause();
#else
  std::this_thread::yield();
#endif
}

// Spins until `ready` or the time is up; true when ready.
template <class Ready> bool spin(Ready ready) {
  const auto end = std::chrono::steady_clock::now() + kSpin;
  for (int k = 0; !ready(); ++k) {
    relax();
    if ((k & 63) == 63 && std::chrono::steady_clock::now() > end) return ready();
  }
  return true;
}

}  // namespace

Pool::Pool(int threads) {
  for (int k = 1; k < threads; ++k) workers_.emplace_back([this, k] { work(k); });
}

Pool::~Pool() {
  {
    std::lock_guard lock(mutex_);
    stop_ = true;
    generation_.fetch_add(1, std::memory_order_release);
  }
  wake_.notify_all();
  for (auto& worker : workers_) worker.join();
}

void Pool::run(int items, Task task, void* context) {
  if (items <= 0) return;
  std::lock_guard turn(turn_);
  if (workers_.empty() || items == 1) {
    for (int k = 0; k < items; ++k) task(context, k, 0);
    return;
  }
  {
    std::lock_guard lock(mutex_);
    items_ = items;
    task_ = task;
    context_ = context;
    next_.store(0, std::memory_order_relaxed);
    busy_.store(static_cast<int>(workers_.size()), std::memory_order_relaxed);
    generation_.fetch_add(1, std::memory_order_release);
  }
  wake_.notify_all();
  take(0);
  while (!spin([this] { return busy_.load(std::memory_order_acquire) == 0; })) std::this_thread::yield();
}

void Pool::take(int worker) {
  for (int k; (k = next_.fetch_add(1, std::memory_order_relaxed)) < items_;) task_(context_, k, worker);
}

// The generation starts at 0 whatever the time at which this thread first runs, so no wake-up is lost.
void Pool::work(int worker) {
  uint64_t seen = 0;
  for (;;) {
    if (!spin([&] { return generation_.load(std::memory_order_acquire) != seen; })) {
      std::unique_lock lock(mutex_);
      wake_.wait(lock, [&] { return generation_.load(std::memory_order_acquire) != seen; });
    }
    {
      std::lock_guard lock(mutex_);
      seen = generation_.load(std::memory_order_acquire);
      if (stop_) return;
    }
    take(worker);
    busy_.fetch_sub(1, std::memory_order_release);
  }
}

}  // namespace gsopt

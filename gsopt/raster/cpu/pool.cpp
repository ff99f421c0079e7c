#include "pool.h"

#include <chrono>
#include <system_error>

#if defined(__x86_64__)
#include <immintrin.h>
#endif
#if defined(__linux__)
#include <pthread.h>
#include <sched.h>
#endif
#if defined(__unix__) || defined(__APPLE__)
#include <unistd.h>
#endif

namespace gsopt {
namespace {

constexpr auto kSpin = std::chrono::microseconds(50);

long this_process() {
#if defined(__unix__) || defined(__APPLE__)
  return getpid();
#else
  return 0;
#endif
}

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

Pool::Pool(int threads) : process_(this_process()) {
#if defined(__linux__)
  cpu_set_t allowed;
  if (sched_getaffinity(0, sizeof(allowed), &allowed) == 0 && CPU_COUNT(&allowed) >= threads)
    for (int core = 0; core < CPU_SETSIZE; ++core)
      if (CPU_ISSET(core, &allowed)) cores_.push_back(core);
#endif
  workers_.reserve(threads);
  try {
    for (int k = 1; k < threads; ++k) workers_.emplace_back([this, k] { work(k); });
  } catch (const std::system_error&) {}
}

bool Pool::in_forked_child() const { return process_ != this_process(); }

Pool::~Pool() {
  if (in_forked_child()) {  // the threads are the parent's, and its workers wait on `wake_` for ever
    static_cast<void>(new std::vector<std::thread>(std::move(workers_)));  // neither joined nor detached: not here
    static_cast<void>(wake_.release());
    return;
  }
  {
    std::lock_guard lock(mutex_);
    stop_ = true;
    generation_.fetch_add(1, std::memory_order_release);
  }
  wake_->notify_all();
  for (auto& worker : workers_) worker.join();
}

void Pool::run(int items, Task task, void* context) {
  if (items <= 0) return;
  const bool alone = in_forked_child();  // where a thread of the parent may have held `turn_`
  std::lock_guard turn(alone ? child_turn_ : turn_);
  if (alone || workers_.empty() || items == 1) {
    for (int k = 0; k < items; ++k) task(context, k, 0);
    return;
  }
  {
    std::lock_guard lock(mutex_);
    items_ = items;
    task_ = task;
    context_ = context;
#if defined(__linux__)
    caller_core_ = sched_getcpu();
#endif
    next_.store(0, std::memory_order_relaxed);
    busy_.store(static_cast<int>(workers_.size()), std::memory_order_relaxed);
    generation_.fetch_add(1, std::memory_order_release);
  }
  wake_->notify_all();
  take(0);
  while (!spin([this] { return busy_.load(std::memory_order_acquire) == 0; })) std::this_thread::yield();
}

void Pool::take(int worker) {
  for (int k; (k = next_.fetch_add(1, std::memory_order_relaxed)) < items_;) task_(context_, k, worker);
}

// Schedulers have been seen to leave a worker on its caller's core while others idle, which costs half the speed:
// the k-th worker moves to the k-th core after the caller's whenever the caller has moved.
void Pool::leave_core_of_caller(int worker, int& pinned) const {
#if defined(__linux__)
  for (size_t k = 0; k < cores_.size(); ++k) {
    if (cores_[k] != caller_core_) continue;
    const int core = cores_[(k + worker) % cores_.size()];
    if (core == pinned) return;
    cpu_set_t one;
    CPU_ZERO(&one);
    CPU_SET(core, &one);
    if (pthread_setaffinity_np(pthread_self(), sizeof(one), &one) == 0) pinned = core;
    return;
  }
#else
  (void)worker;
  (void)pinned;
#endif
}

// The generation starts at 0 whatever the time at which this thread first runs, so no wake-up is lost.
void Pool::work(int worker) {
  uint64_t seen = 0;
  int pinned = -1;
  for (;;) {
    if (!spin([&] { return generation_.load(std::memory_order_acquire) != seen; })) {
      std::unique_lock lock(mutex_);
      wake_->wait(lock, [&] { return generation_.load(std::memory_order_acquire) != seen; });
    }
    {
      std::lock_guard lock(mutex_);
      seen = generation_.load(std::memory_order_acquire);
      if (stop_) return;
    }
    leave_core_of_caller(worker, pinned);
    take(worker);
    busy_.fetch_sub(1, std::memory_order_release);
  }
}

}  // namespace gsopt

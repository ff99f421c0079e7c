// A small thread pool: workers spin for a moment, then sleep; work is handed out by an atomic counter.
// Results never depend on which worker takes which item, so a pool that the system refuses threads goes on with fewer,
// and in a forked child, which has none of its parent's, the caller does all.
#pragma once
#include <atomic>
#include <condition_variable>
#include <mutex>
#include <memory>
#include <thread>
#include <vector>

namespace gsopt {

class Pool {
 public:
  explicit Pool(int threads);
  ~Pool();
  Pool(const Pool&) = delete;
  Pool& operator=(const Pool&) = delete;

  // As many as could be started.
  int threads() const { return static_cast<int>(workers_.size()) + 1; }

  // Plain function and context: nothing here is instantiated in a file compiled for one instruction set only.
  using Task = void (*)(void* context, int item, int worker);

  // Calls task(context, item, worker) once for every item in [0, items); returns when all are done.
  // Calls from several threads take turns.
  void run(int items, Task task, void* context);

 private:
  void work(int worker);
  void leave_core_of_caller(int worker, int& pinned) const;
  void take(int worker);
  bool in_forked_child() const;

  std::vector<std::thread> workers_;
  std::mutex turn_, mutex_, child_turn_;
  std::unique_ptr<std::condition_variable> wake_ = std::make_unique<std::condition_variable>();
  std::atomic<uint64_t> generation_{0};
  std::atomic<int> next_{0}, busy_{0};
  int items_ = 0;
  Task task_ = nullptr;
  void* context_ = nullptr;
  int caller_core_ = -1;
  std::vector<int> cores_;  // cores this process may use; empty where the system does not tell
  bool stop_ = false;
  long process_;
};

}  // namespace gsopt

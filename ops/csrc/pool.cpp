#include "pool.h"

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

namespace gsparc {
namespace {

constexpr int kGlances = 400;  // a few microseconds in which a helper looks for the next round before it sleeps

// The caller works too and waits only for helpers that have begun: one that a busy machine has not yet woken
// finds the round closed and holds nobody up.
class Pool {
public:
    bool try_run(int tasks, int threads, Body body, void* context) {
        std::unique_lock<std::mutex> turn(turn_, std::try_to_lock);
        if (!turn.owns_lock()) return false;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            while (static_cast<int>(workers_.size()) < threads - 1) {
                const int index = static_cast<int>(workers_.size());
                workers_.emplace_back([this, index, seen = round_.load()] { work(index, seen); });
                workers_.back().detach();  // they sleep until the process ends
            }
            body_ = body, context_ = context, tasks_ = tasks, helpers_ = threads - 1, open_ = true;
            next_.store(0);
            round_.fetch_add(1);
        }
        wake_.notify_all();
        drain(body, context, tasks, 0);
        std::unique_lock<std::mutex> lock(mutex_);
        open_ = false;
        done_.wait(lock, [this] { return busy_ == 0; });
        return true;
    }

private:
    void work(int index, long seen) {
        for (;;) {
            for (int glance = 0; glance < kGlances && round_.load(std::memory_order_relaxed) == seen; ++glance) rest();
            std::unique_lock<std::mutex> lock(mutex_);
            wake_.wait(lock, [&] { return round_.load() != seen; });
            seen = round_.load();
            if (index >= helpers_ || !open_) continue;
            const Body body = body_;
            void* context = context_;
            const int tasks = tasks_;
            ++busy_;
            lock.unlock();
            drain(body, context, tasks, index + 1);
            lock.lock();
            if (--busy_ == 0) done_.notify_one();
        }
    }

    void drain(Body body, void* context, int tasks, int worker) {
        for (int task = next_.fetch_add(1); task < tasks; task = next_.fetch_add(1)) body(context, task, worker);
    }

    static void rest() {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#endif
    }

    std::mutex turn_, mutex_;
    std::condition_variable wake_, done_;
    std::vector<std::thread> workers_;
    Body body_ = nullptr;
    void* context_ = nullptr;
    std::atomic<int> next_{0};
    std::atomic<long> round_{0};
    int tasks_ = 0, helpers_ = 0, busy_ = 0;
    bool open_ = false;
};

// A forked child inherits the pool's memory but none of its threads: it makes its own.
Pool& pool() {
    static std::mutex guard;
    static Pool* instance = nullptr;
    static pid_t owner = 0;
    std::lock_guard<std::mutex> lock(guard);
    if (instance == nullptr || owner != getpid()) instance = new Pool, owner = getpid();
    return *instance;
}

}  // namespace

void parallel(int tasks, int threads, Body body, void* context) {
    if (threads > tasks) threads = tasks;
    if (threads > 1 && pool().try_run(tasks, threads, body, context)) return;
    for (int task = 0; task < tasks; ++task) body(context, task, 0);
}

}  // namespace gsparc

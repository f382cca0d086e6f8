#include "pool.h"

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

namespace gsparc {
namespace {

// How long a thread looks for what it waits for before it sleeps: to be woken costs a virtual machine 50 us, as much as
// a small kernel. First without leaving the processor (a few us), then giving way to whoever else wants it (about 100).
constexpr int kPauses = 100, kYields = 300;

// The caller works too and waits only for helpers that have begun: one that a busy machine has not yet woken
// finds the round closed and holds nobody up.
class Pool {
public:
    bool try_run(int tasks, int threads, Body body, void* context) {
        std::unique_lock<std::mutex> turn(turn_, std::try_to_lock);
        if (!turn.owns_lock()) return false;
        bool asleep;
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
            asleep = sleepers_ > 0;
        }
        if (asleep) wake_.notify_all();
        drain(body, context, tasks, 0);
        {
            std::lock_guard<std::mutex> lock(mutex_);
            open_ = false;
        }
        const auto finished = [this] { return busy_.load() == 0; };
        if (!comes_soon(finished)) {
            std::unique_lock<std::mutex> lock(mutex_);
            done_.wait(lock, finished);
        }
        return true;
    }

private:
    void work(int index, long seen) {
        const auto called = [&] { return round_.load() != seen; };
        for (;;) {
            const bool soon = comes_soon(called);
            std::unique_lock<std::mutex> lock(mutex_);
            if (!soon) {
                ++sleepers_;
                wake_.wait(lock, called);
                --sleepers_;
            }
            seen = round_.load();
            if (index >= helpers_ || !open_) continue;
            const Body body = body_;
            void* context = context_;
            const int tasks = tasks_;
            busy_.fetch_add(1);
            lock.unlock();
            drain(body, context, tasks, index + 1);
            lock.lock();
            if (busy_.fetch_sub(1) == 1) done_.notify_one();
        }
    }

    template <class Ready> static bool comes_soon(const Ready& ready) {
        for (int k = 0; k < kPauses; ++k) {
            if (ready()) return true;
            rest();
        }
        for (int k = 0; k < kYields; ++k) {
            if (ready()) return true;
            std::this_thread::yield();
        }
        return false;
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
    std::atomic<int> busy_{0};  // helpers at work; changed under the lock
    int tasks_ = 0, helpers_ = 0, sleepers_ = 0;
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

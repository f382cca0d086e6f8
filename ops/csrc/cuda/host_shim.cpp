#undef _FORTIFY_SOURCE  // its longjmp check does not know of fibers
#include <setjmp.h>
#include <ucontext.h>

#include <memory>

#define GSPARC_ISA device
#include "host_shim.h"

#undef threadIdx
#undef blockIdx
#undef blockDim

namespace gsparc {
namespace shim {

Index thread_index, block_index, block_size;

namespace {

constexpr size_t kStack = 256 * 1024;

struct Fiber {
    ucontext_t start{};
    jmp_buf here;
    std::unique_ptr<char[]> stack;
    bool started = false, done = true;
    Meeting waits = Meeting::none;
};

std::vector<std::unique_ptr<Fiber>> fibers;
std::vector<const void*> desk;
const std::function<void()>* job;
jmp_buf scheduler;
Fiber* running;
bool flag, backwards;

void work() {
    for (;;) {
        (*job)();
        running->done = true;
        if (!_setjmp(running->here)) _longjmp(scheduler, 1);
    }
}

void resume(unsigned index) {
    running = fibers[index].get();
    thread_index = {index, 0};
    if (_setjmp(scheduler)) return;
    if (running->started) _longjmp(running->here, 1);
    running->started = true;
    setcontext(&running->start);
}

void grow(unsigned threads) {
    while (fibers.size() < threads) {
        auto fiber = std::make_unique<Fiber>();
        fiber->stack = std::make_unique<char[]>(kStack);
        getcontext(&fiber->start);
        fiber->start.uc_stack.ss_sp = fiber->stack.get(), fiber->start.uc_stack.ss_size = kStack;
        fiber->start.uc_link = nullptr;
        makecontext(&fiber->start, work, 0);
        fibers.push_back(std::move(fiber));
    }
    desk.resize(std::max<size_t>(desk.size(), threads));
}

// Lets go all of [first, last) if each of them waits for the same; false if only some of them came.
bool release(unsigned first, unsigned last, Meeting what) {
    unsigned here = 0;
    for (unsigned t = first; t < last; ++t) here += !fibers[t]->done && fibers[t]->waits == what;
    if (here != last - first) return false;
    for (unsigned t = first; t < last; ++t) fibers[t]->waits = Meeting::none;
    return true;
}

bool run_block(unsigned threads) {
    for (unsigned t = 0; t < threads; ++t) fibers[t]->done = false, fibers[t]->waits = Meeting::none;
    for (;;) {
        bool moved = false, left = false;
        for (unsigned k = 0; k < threads; ++k) {
            const unsigned t = backwards ? threads - 1 - k : k;
            if (fibers[t]->done || fibers[t]->waits != Meeting::none) continue;
            resume(t);
            moved = true;
        }
        for (unsigned t = 0; t < threads; t += 32) moved |= release(t, std::min(t + 32, threads), Meeting::warp);
        moved |= release(0, threads, Meeting::block);
        for (unsigned t = 0; t < threads; ++t) left |= !fibers[t]->done;
        if (!left) return true;
        if (moved) continue;
        fibers.clear();  // stuck: some never came to a barrier where others wait
        return false;
    }
}

}  // namespace

void meet(Meeting what) {
    running->waits = what;
    if (!_setjmp(running->here)) _longjmp(scheduler, 1);
}

const void*& left_by(unsigned lane) { return desk[thread_index.x / 32 * 32 + lane]; }
bool& raised() { return flag; }

int64_t run(int64_t blocks, int rows, int threads, const std::function<void()>& body) {
    grow(threads);
    job = &body;
    block_size = {unsigned(threads), 1};
    for (int y = 0; y < rows; ++y)
        for (int64_t x = 0; x < blocks; ++x) {
            block_index = {unsigned(x), unsigned(y)};
            if (!run_block(threads)) return 1;
        }
    return 0;
}

}  // namespace shim
}  // namespace gsparc

// Tests run the threads in both orders: a missing barrier then shows as a difference.
extern "C" void gsparc_shim_backwards(int on) { gsparc::shim::backwards = on != 0; }

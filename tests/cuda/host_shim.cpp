#undef _FORTIFY_SOURCE  // its longjmp check does not know of fibers
#include <setjmp.h>
#include <ucontext.h>

#include <memory>

#define GSPARC_ISA device
#include "host_shim.h"

#undef threadIdx
#undef blockIdx
#undef blockDim
#undef gridDim

// ThreadSanitizer learns which thread runs and what orders memory (GSPARC_WATCH_THREADS; this file itself is not
// watched). Under any sanitizer fibers change by swapcontext: they know of it, and not of a jump to another stack.
#ifdef GSPARC_WATCH_THREADS
extern "C" {
void* __tsan_get_current_fiber();
void* __tsan_create_fiber(unsigned flags);
void __tsan_switch_to_fiber(void* fiber, unsigned flags);
void __tsan_acquire(void* at);
void __tsan_release(void* at);
}
#else
static void* __tsan_get_current_fiber() { return nullptr; }
static void* __tsan_create_fiber(unsigned) { return nullptr; }
static void __tsan_switch_to_fiber(void*, unsigned) {}
static void __tsan_acquire(void*) {}
static void __tsan_release(void*) {}
#endif

namespace gsparc {
namespace shim {

Index thread_index, block_index, block_size, grid_size;

namespace {

constexpr size_t kStack = 256 * 1024;
constexpr unsigned kWithoutOrder = 1;  // a change of fibers orders nothing

struct Fiber {
    ucontext_t context{};
    jmp_buf here;
    std::unique_ptr<char[]> stack;
    void* watched = nullptr;
    bool started = false, done = true;
    Meeting waits = Meeting::none;
    unsigned met[2] = {0, 0};  // warp and block barriers passed
};

std::vector<std::unique_ptr<Fiber>> fibers;
std::vector<const void*> desk;
const std::function<void()>* job;
ucontext_t scheduler_context;
jmp_buf scheduler;
void* scheduler_watched;
Fiber* running;
bool flag, backwards;
// What orders memory: a block's start, its end, and barriers by turns, so that who has run ahead to the next, or has
// ended before another began, orders nothing here.
char start_order, end_order, block_order[2], warp_order[2][32];

void change(Fiber* to) {
    __tsan_switch_to_fiber(to ? to->watched : scheduler_watched, kWithoutOrder);
#ifdef GSPARC_WATCHED
    if (to) swapcontext(&scheduler_context, &to->context);
    else swapcontext(&running->context, &scheduler_context);
#else
    if (_setjmp(to ? scheduler : running->here)) return;
    if (!to) _longjmp(scheduler, 1);
    if (to->started) _longjmp(to->here, 1);
    to->started = true;
    setcontext(&to->context);
#endif
}

void work() {
    for (;;) {
        __tsan_acquire(&start_order);
        (*job)();
        __tsan_release(&end_order);
        running->done = true;
        change(nullptr);
    }
}

void resume(unsigned index) {
    running = fibers[index].get();
    thread_index = {index, 0};
    change(running);
}

void grow(unsigned threads) {
    while (fibers.size() < threads) {
        auto fiber = std::make_unique<Fiber>();
        fiber->stack = std::make_unique<char[]>(kStack);
        fiber->watched = __tsan_create_fiber(0);
        getcontext(&fiber->context);
        fiber->context.uc_stack.ss_sp = fiber->stack.get(), fiber->context.uc_stack.ss_size = kStack;
        fiber->context.uc_link = nullptr;
        makecontext(&fiber->context, work, 0);
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
    __tsan_release(&start_order);
    for (;;) {
        bool moved = false, left = false;
        for (unsigned k = 0; k < threads; ++k) {
            const unsigned t = backwards ? threads - 1 - k : k;
            if (fibers[t]->done || fibers[t]->waits != Meeting::none) continue;
            resume(t);
            moved = true;
        }
        for (unsigned t = 0; t < threads; t += 32)
            for (Meeting what : {Meeting::warp, Meeting::shuffle}) moved |= release(t, std::min(t + 32, threads), what);
        moved |= release(0, threads, Meeting::block);
        for (unsigned t = 0; t < threads; ++t) left |= !fibers[t]->done;
        if (!left) break;
        if (moved) continue;
        fibers.clear();  // stuck: some never came to a barrier where others wait
        return false;
    }
    __tsan_acquire(&end_order);
    return true;
}

}  // namespace

void meet(Meeting what) {
    const bool block = what == Meeting::block;
    char* order = nullptr;
    if (what != Meeting::shuffle) {
        const unsigned turn = running->met[block]++ % 2;
        order = block ? &block_order[turn] : &warp_order[turn][thread_index.x / 32];
        __tsan_release(order);
    }
    running->waits = what;
    change(nullptr);
    if (order) __tsan_acquire(order);
}

void show(const void* mine) { desk[thread_index.x] = mine; }
const void* shown_by(unsigned lane) { return desk[thread_index.x / 32 * 32 + lane]; }
void raise(bool up) { flag = up; }
bool raised() { return flag; }

const char* message(int64_t error) {
    return error == kUnmet ? "a barrier was not met by all threads" : error ? "a grid larger than GPUs take" : "";
}

int64_t run(int64_t blocks, int64_t rows, int threads, const std::function<void()>& body) {
    if (blocks > 2147483647 || rows > 65535 || threads > 1024) return kTooLarge;
    scheduler_watched = __tsan_get_current_fiber();
    grow(threads);
    job = &body;
    block_size = {unsigned(threads), 1}, grid_size = {unsigned(blocks), unsigned(rows)};
    for (int64_t y = 0; y < rows; ++y)
        for (int64_t x = 0; x < blocks; ++x) {
            block_index = {unsigned(x), unsigned(y)};
            if (!run_block(threads)) return kUnmet;
        }
    return 0;
}

}  // namespace shim
}  // namespace gsparc

// Tests run the threads in both orders: a missing barrier then shows as a difference.
extern "C" void gsparc_shim_backwards(int on) { gsparc::shim::backwards = on != 0; }

// The part of CUDA that the kernels use, on one CPU thread: the threads of a block are fibers, a barrier switches
// to the next one, blocks run one after the other. It executes the kernels' logic and checks that whole warps and
// blocks meet at the same kind of barrier and that grids are of a size GPUs take; built with ThreadSanitizer it finds
// memory that two threads of a block share without a barrier between. It says nothing about speed or rounding.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __shared__ static
#define __launch_bounds__(...)

namespace gsparc {
namespace shim {

struct Index {
    unsigned x, y;
};
extern Index thread_index, block_index, block_size, grid_size;

// What a thread waits for. A shuffle needs the whole warp, too, but orders no memory.
enum class Meeting { none, warp, shuffle, block };
// Gives up the CPU until all threads of the warp or block have come here. `what` must be the same for all.
void meet(Meeting what);
// A thread shows something to its warp, and looks at what lane `lane` shows, between two meetings.
void show(const void* mine);
const void* shown_by(unsigned lane);
// A flag of the block: any of its threads may raise it.
void raise(bool up);
bool raised();

// Reads what another thread holds in registers: no memory on a GPU, so nobody watches.
template <class S> __attribute__((noinline, no_sanitize("thread"))) S peek(const S* at) { return *at; }

constexpr int64_t kUnmet = 1, kTooLarge = 2;  // errors of a launch
const char* message(int64_t error);
// Runs `body` for every thread of blocks x rows blocks; returns 0 or an error.
int64_t run(int64_t blocks, int64_t rows, int threads, const std::function<void()>& body);

}  // namespace shim
}  // namespace gsparc

#define threadIdx gsparc::shim::thread_index
#define blockIdx gsparc::shim::block_index
#define blockDim gsparc::shim::block_size
#define gridDim gsparc::shim::grid_size

inline unsigned long long atomicMin(unsigned long long* at, unsigned long long value) {
    const unsigned long long before = __atomic_load_n(at, __ATOMIC_RELAXED);
    if (value < before) __atomic_store_n(at, value, __ATOMIC_RELAXED);
    return before;
}

namespace gsparc {
namespace GSPARC_ISA {

inline void warp_sync() { shim::meet(shim::Meeting::warp); }
inline void block_sync() { shim::meet(shim::Meeting::block); }

template <class S, int kCount> S warp_sums(S (&values)[kCount]) {
    const unsigned lane = shim::thread_index.x % 32;
    shim::show(values);
    shim::meet(shim::Meeting::shuffle);
    S total = 0;
    for (unsigned other = 0; other < 32; ++other) total += shim::peek(static_cast<const S*>(shim::shown_by(other)) + lane % kCount);
    shim::meet(shim::Meeting::shuffle);
    return total;
}

inline bool warp_any(bool x) {
    int one[1] = {x};
    return warp_sums(one) > 0;
}

inline bool block_any(bool x) {
    block_sync();
    shim::raise(false);
    block_sync();
    if (x) shim::raise(true);
    block_sync();
    return shim::raised();
}

inline int64_t use_device(int) { return 0; }

inline int64_t clear(void* at, int value, size_t bytes, void*) {
    if (bytes) std::memset(at, value, bytes);
    return 0;
}

template <class... P, class... A>
int64_t launch(void (*kernel)(P...), int64_t blocks, int64_t rows, int threads, void*, A... args) {
    return shim::run(blocks, rows, threads, [&] { kernel(P(args)...); });
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

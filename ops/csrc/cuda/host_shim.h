// The part of CUDA that the kernels use, on one CPU thread: the threads of a block are fibers, a barrier switches
// to the next one, blocks run one after the other. It executes the kernels' logic and checks that whole warps and
// blocks meet at their barriers; it says nothing about speed, memory consistency, or the GPU's own rounding.
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
extern Index thread_index, block_index, block_size;

enum class Meeting { none, warp, block };
// Gives up the CPU until all threads of the warp or block have come here. `what` must be the same for all.
void meet(Meeting what);
// The place where lane `lane` of this thread's warp leaves something for the others between two meetings.
const void*& left_by(unsigned lane);
bool& raised();  // a flag of the block, used by block_any

// Runs `body` for every thread of blocks x rows blocks; returns 0, or 1 if a barrier was not met by all.
int64_t run(int64_t blocks, int rows, int threads, const std::function<void()>& body);

}  // namespace shim
}  // namespace gsparc

#define threadIdx gsparc::shim::thread_index
#define blockIdx gsparc::shim::block_index
#define blockDim gsparc::shim::block_size

inline unsigned long long atomicMin(unsigned long long* at, unsigned long long value) {
    const unsigned long long before = *at;
    *at = std::min(before, value);
    return before;
}
inline int atomicAdd(int* at, int value) { return (*at += value) - value; }

namespace gsparc {
namespace GSPARC_ISA {

inline void warp_sync() { shim::meet(shim::Meeting::warp); }
inline void block_sync() { shim::meet(shim::Meeting::block); }

template <class S, int kCount> S warp_sums(S (&values)[kCount]) {
    const unsigned lane = shim::thread_index.x % 32;
    shim::left_by(lane) = values;
    warp_sync();
    S total = 0;
    for (unsigned other = 0; other < 32; ++other) total += static_cast<const S*>(shim::left_by(other))[lane % kCount];
    warp_sync();
    return total;
}

inline bool warp_any(bool x) {
    int one[1] = {x};
    return warp_sums(one) > 0;
}

inline bool block_any(bool x) {
    block_sync();
    shim::raised() = false;
    block_sync();
    if (x) shim::raised() = true;
    block_sync();
    return shim::raised();
}

inline int64_t clear(void* at, int value, size_t bytes, void*) {
    if (bytes) std::memset(at, value, bytes);
    return 0;
}

template <class... P, class... A>
int64_t launch(void (*kernel)(P...), int64_t blocks, int rows, int threads, void*, A... args) {
    return shim::run(blocks, rows, threads, [&] { kernel(P(args)...); });
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// Where the kernels run: on a GPU through nvcc, or on the host shim through g++, which executes the same sources.
// Nothing below this file knows which.
#pragma once
#include <stdint.h>

#define GSPARC_ISA device
#define GSPARC_LANES "cuda/scalar.h"

#ifdef __CUDACC__
#include <cuda_runtime.h>
#define GSPARC_HD __host__ __device__ __forceinline__
#define GSPARC_INLINE __host__ __device__ __forceinline__
#define GSPARC_UNROLL _Pragma("unroll")
#define GSPARC_UNROLL_BY(n) _Pragma(GSPARC_TEXT(unroll n))
#define GSPARC_TEXT(x) #x
#else
#define GSPARC_HD inline
#define GSPARC_INLINE inline
#define GSPARC_UNROLL
#define GSPARC_UNROLL_BY(n)
#include "host_shim.h"  // of tests/cuda
#endif

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kWarp = 32;

#ifdef __CUDACC__

constexpr unsigned kAll = 0xffffffffu;
__device__ __forceinline__ void warp_sync() { __syncwarp(); }
__device__ __forceinline__ void block_sync() { __syncthreads(); }
__device__ __forceinline__ bool warp_any(bool x) { return __any_sync(kAll, x); }
__device__ __forceinline__ bool block_any(bool x) { return __syncthreads_or(x); }

// The upper half of the lanes keeps the upper half of the values, the lower half the lower: one fold of a sum.
template <int kHalf, class S, int kCount> __device__ __forceinline__ void fold(S (&values)[kCount]) {
    if constexpr (kHalf >= 1) {
        const bool upper = threadIdx.x & kHalf;
#pragma unroll
        for (int k = 0; k < kHalf; ++k) {
            const S mine = upper ? values[k + kHalf] : values[k], other = upper ? values[k] : values[k + kHalf];
            values[k] = mine + __shfl_xor_sync(kAll, other, kHalf);
        }
        fold<kHalf / 2>(values);
    }
}

// Lane m receives the sum over the warp of values[m % kCount], kCount a power of two up to 32: kCount - 1 shuffles
// and a few instead of 5 kCount. The order of the additions is fixed. The values are used up.
template <class S, int kCount> __device__ __forceinline__ S warp_sums(S (&values)[kCount]) {
    fold<kCount / 2>(values);
    S total = values[0];
#pragma unroll
    for (int step = kCount; step < kWarp; step *= 2) total += __shfl_xor_sync(kAll, total, step);
    return total;
}

// This library's runtime is its own (linked statically), so what torch made current must be said to it as well.
inline int64_t use_device(int device) { return cudaSetDevice(device); }

inline int64_t clear(void* at, int value, size_t bytes, void* stream) {
    return bytes ? cudaMemsetAsync(at, value, bytes, static_cast<cudaStream_t>(stream)) : 0;
}

// Launches blocks x rows blocks; returns the error of the launch, 0 if there is none or nothing to do.
template <class... P, class... A>
int64_t launch(void (*kernel)(P...), int64_t blocks, int64_t rows, int threads, void* stream, A... args) {
    if (blocks <= 0 || rows <= 0) return 0;
    if (blocks > INT32_MAX || rows > 65535) return cudaErrorInvalidConfiguration;  // a cast would cut them off
    kernel<<<dim3(unsigned(blocks), unsigned(rows)), threads, 0, static_cast<cudaStream_t>(stream)>>>(P(args)...);
    return cudaGetLastError();
}

#endif

// Runs the steps of a call one after the other until one fails: what follows would work on what is not there.
class Steps {
  public:
    template <class F> Steps& then(F step) {
        if (first_ == 0) first_ = step();
        return *this;
    }
    int64_t result() const { return -first_; }  // 0, or minus the first error

  private:
    int64_t first_ = 0;
};

// Hands out pieces of one scratch buffer; without a buffer it only counts how large that must be.
class Arena {
  public:
    explicit Arena(void* base) : base_(static_cast<char*>(base)) {}
    template <class T> T* take(int64_t count) {
        char* at = base_ + used_;
        used_ += (count * int64_t(sizeof(T)) + 255) / 256 * 256;
        return base_ ? reinterpret_cast<T*>(at) : nullptr;
    }
    bool measuring() const { return base_ == nullptr; }
    int64_t bytes() const { return used_ + 256; }

  private:
    char* base_;
    int64_t used_ = 0;
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

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
#else
#define GSPARC_HD inline
#define GSPARC_INLINE inline
#include "host_shim.h"
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

// Lane m receives the sum over the warp of values[m]; kCount is a power of two up to 32, and lanes beyond it
// repeat. Halving the array while the lanes pair up takes kCount - 1 shuffles instead of 5 kCount; the order of
// the additions is fixed. The values are used up.
template <class S, int kCount> __device__ __forceinline__ S warp_sums(S (&values)[kCount]) {
    const unsigned lane = threadIdx.x % kWarp;
#pragma unroll
    for (int half = kCount / 2; half >= 1; half /= 2) {
        const bool upper = lane & half;
#pragma unroll
        for (int k = 0; k < half; ++k) {
            const S mine = upper ? values[k + half] : values[k], other = upper ? values[k] : values[k + half];
            values[k] = mine + __shfl_xor_sync(kAll, other, half);
        }
    }
    S total = values[0];
#pragma unroll
    for (int step = kCount; step < kWarp; step *= 2) total += __shfl_xor_sync(kAll, total, step);
    return total;
}

inline int64_t clear(void* at, int value, size_t bytes, void* stream) {
    return bytes ? cudaMemsetAsync(at, value, bytes, static_cast<cudaStream_t>(stream)) : 0;
}

// Launches blocks x rows blocks; returns the error of the launch, 0 if there is none or nothing to do.
template <class... P, class... A>
int64_t launch(void (*kernel)(P...), int64_t blocks, int rows, int threads, void* stream, A... args) {
    if (blocks <= 0 || rows <= 0) return 0;
    kernel<<<dim3(unsigned(blocks), unsigned(rows)), threads, 0, static_cast<cudaStream_t>(stream)>>>(P(args)...);
    return cudaGetLastError();
}

#endif

// Runs the steps of a call one after the other until one fails.
class Steps {
  public:
    Steps& then(int64_t error) {
        if (first_ == 0) first_ = error;
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

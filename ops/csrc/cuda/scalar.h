// Lanes of pixels on a GPU: a thread is a vector machine of one lane, so that the CPU's pixel arithmetic serves
// here unchanged. Contraction is off (-fmad=false): forward and backward must round alike.
#pragma once
#include <math.h>
#include <stdint.h>

namespace gsparc {
namespace GSPARC_ISA {

template <class S> using Vec = S;
template <class S> using Mask = bool;
template <class S> struct Lanes {
    static constexpr int n = 1;
};

template <class S> GSPARC_INLINE S splat(S x) { return x; }
template <class S> GSPARC_INLINE S load(const S* p) { return *p; }
template <class S> GSPARC_INLINE bool at_most(S a, S b) { return a <= b; }
template <class S> GSPARC_INLINE S select(bool mask, S a, S b) { return mask ? a : b; }
GSPARC_INLINE bool any(bool mask) { return mask; }
template <class S> GSPARC_INLINE S sum(S x) { return x; }
template <class S> GSPARC_INLINE S lesser(S a, S b) { return a <= b ? a : b; }
template <class S> GSPARC_INLINE S greater(S a, S b) { return a >= b ? a : b; }
GSPARC_INLINE float fma(float a, float b, float c) { return ::fmaf(a, b, c); }
GSPARC_INLINE double fma(double a, double b, double c) { return ::fma(a, b, c); }
template <class S> GSPARC_INLINE S reciprocal(S x) { return S(1) / x; }
#ifdef __CUDA_ARCH__
// To 1 ulp in one instruction instead of ten: what it is asked for lies between the square of the horizon and 1.
GSPARC_INLINE float reciprocal(float x) {
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
#endif
GSPARC_INLINE float nearest(float x) { return rintf(x); }
GSPARC_INLINE double nearest(double x) { return rint(x); }
#ifdef __CUDA_ARCH__
GSPARC_INLINE float exponential(float x) {  // relative error below 2e-6 within the cut-offs
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x * 1.44269504f));
    return y;
}
#else
GSPARC_INLINE float exponential(float x) { return expf(x); }
#endif
GSPARC_INLINE double exponential(double x) { return exp(x); }
template <class S> GSPARC_INLINE S bell(S form) { return exponential(form * S(-0.5)); }

}  // namespace GSPARC_ISA
}  // namespace gsparc

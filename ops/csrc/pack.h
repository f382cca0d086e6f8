// Lanes of Gaussians: a number type that is a vector, so that the formulas of footprint.h serve 16 at a time.
#pragma once
#include "simd.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct Which {
    Mask<S> lanes;
    friend GSPARC_INLINE Which operator&(Which a, Which b) { return {Mask<S>(a.lanes & b.lanes)}; }
    friend GSPARC_INLINE Which operator|(Which a, Which b) { return {Mask<S>(a.lanes | b.lanes)}; }
    friend GSPARC_INLINE Which operator!(Which a) { return {Mask<S>(~a.lanes)}; }
};

template <class S> struct Pack {
    static constexpr int n = Lanes<S>::n;
    Vec<S> v;

    Pack() = default;
    GSPARC_INLINE Pack(Vec<S> lanes) : v(lanes) {}
    GSPARC_INLINE Pack(float x) : v(splat(S(x))) {}
    GSPARC_INLINE Pack(double x) : v(splat(S(x))) {}
    GSPARC_INLINE Pack(int x) : v(splat(S(x))) {}

    friend GSPARC_INLINE Pack operator+(Pack a, Pack b) { return a.v + b.v; }
    friend GSPARC_INLINE Pack operator-(Pack a, Pack b) { return a.v - b.v; }
    friend GSPARC_INLINE Pack operator*(Pack a, Pack b) { return a.v * b.v; }
    friend GSPARC_INLINE Pack operator/(Pack a, Pack b) { return a.v / b.v; }
    friend GSPARC_INLINE Pack operator-(Pack a) { return -a.v; }
    GSPARC_INLINE Pack& operator+=(Pack a) { return v += a.v, *this; }
    GSPARC_INLINE Pack& operator-=(Pack a) { return v -= a.v, *this; }
    friend GSPARC_INLINE Which<S> operator<=(Pack a, Pack b) { return {at_most(a.v, b.v)}; }
    friend GSPARC_INLINE Which<S> operator>=(Pack a, Pack b) { return {at_most(b.v, a.v)}; }
    friend GSPARC_INLINE Which<S> operator<(Pack a, Pack b) { return {below(a.v, b.v)}; }
    friend GSPARC_INLINE Which<S> operator>(Pack a, Pack b) { return {below(b.v, a.v)}; }
};

template <class S> GSPARC_INLINE Pack<S> pick(Which<S> which, Pack<S> a, Pack<S> b) { return select(which.lanes, a.v, b.v); }
template <class S> GSPARC_INLINE bool none(Which<S> which) { return !any(which.lanes); }
template <class S> GSPARC_INLINE Pack<S> each_lane(Pack<S> a, Pack<S> b, S (*f)(S, S)) {
    Pack<S> out;
    for (int k = 0; k < Pack<S>::n; ++k) out.v[k] = f(a.v[k], b.v[k]);
    return out;
}

#if defined(__AVX512F__)
GSPARC_INLINE Pack<float> upward(Pack<float> x) { return (Vec<float>)_mm512_roundscale_ps((__m512)x.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC); }
GSPARC_INLINE Pack<double> upward(Pack<double> x) { return (Vec<double>)_mm512_roundscale_pd((__m512d)x.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC); }
#elif defined(__AVX2__)
GSPARC_INLINE Pack<float> upward(Pack<float> x) { return (Vec<float>)_mm256_ceil_ps((__m256)x.v); }
GSPARC_INLINE Pack<double> upward(Pack<double> x) { return (Vec<double>)_mm256_ceil_pd((__m256d)x.v); }
#else
template <class S> GSPARC_INLINE Pack<S> upward(Pack<S> x) {
    for (int k = 0; k < Pack<S>::n; ++k) x.v[k] = S(__builtin_ceil(x.v[k]));
    return x;
}
#endif
template <class S> GSPARC_INLINE Pack<S> downward(Pack<S> x) { return -upward(-x); }

#if defined(__AVX512F__)
GSPARC_INLINE Pack<float> root(Pack<float> x) { return (Vec<float>)_mm512_sqrt_ps((__m512)x.v); }
GSPARC_INLINE Pack<double> root(Pack<double> x) { return (Vec<double>)_mm512_sqrt_pd((__m512d)x.v); }
#elif defined(__AVX2__)
GSPARC_INLINE Pack<float> root(Pack<float> x) { return (Vec<float>)_mm256_sqrt_ps((__m256)x.v); }
GSPARC_INLINE Pack<double> root(Pack<double> x) { return (Vec<double>)_mm256_sqrt_pd((__m256d)x.v); }
#else
template <class S> GSPARC_INLINE Pack<S> root(Pack<S> x) {
    for (int k = 0; k < Pack<S>::n; ++k) x.v[k] = S(__builtin_sqrt(x.v[k]));
    return x;
}
#endif

// log(x) to 2e-7 for normal x > 0 (the polynomial of Cephes' logf).
GSPARC_INLINE Pack<float> logarithm(Pack<float> x) {
    const Int<float> bits = (Int<float>)x.v, exponent = ((bits - 0x3f3504f3) >> 23);
    const Vec<float> m = (Vec<float>)(bits - (exponent << 23)) - 1.0f, e = __builtin_convertvector(exponent, Vec<float>), square = m * m;
    Vec<float> p = splat(7.0376836292e-2f);
    const float factors[] = {-1.1514610310e-1f, 1.1676998740e-1f, -1.2420140846e-1f, 1.4249322787e-1f,
                             -1.6668057665e-1f, 2.0000714765e-1f, -2.4999993993e-1f, 3.3333331174e-1f};
    for (int k = 0; k < 8; ++k) p = fma(p, m, splat(factors[k]));
    return m * square * p + e * -2.12194440e-4f - 0.5f * square + m + e * 0.693359375f;
}
GSPARC_INLINE Pack<double> logarithm(Pack<double> x) {
    for (int k = 0; k < Pack<double>::n; ++k) x.v[k] = __builtin_log(x.v[k]);
    return x;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// Lanes of pixels. One width per instruction set; each translation unit sees exactly one of the three branches.
#pragma once
#include <stdint.h>
#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

#ifndef GSPARC_ISA
#define GSPARC_ISA baseline
#endif

namespace gsparc {
namespace GSPARC_ISA {

#if defined(__AVX512F__)
constexpr int kBytes = 64;
#elif defined(__AVX2__)
constexpr int kBytes = 32;
#else
constexpr int kBytes = 32;  // two registers of what every x86-64 and ARM has
#endif

template <class S> struct Lanes;
template <> struct Lanes<float> {
    typedef float V __attribute__((vector_size(kBytes)));
    typedef int32_t I __attribute__((vector_size(kBytes)));
    typedef uint32_t U __attribute__((vector_size(kBytes)));
    static constexpr int n = kBytes / 4;
};
template <> struct Lanes<double> {
    typedef double V __attribute__((vector_size(kBytes)));
    typedef int64_t I __attribute__((vector_size(kBytes)));
    typedef uint64_t U __attribute__((vector_size(kBytes)));
    static constexpr int n = kBytes / 8;
};
template <class S> using Vec = typename Lanes<S>::V;
template <class S> using Int = typename Lanes<S>::I;
template <class S> using Whole = typename Lanes<S>::U;  // wraps round where `Int` may not

#define GSPARC_INLINE inline __attribute__((always_inline))

// Not `Vec{} + x`: adding 0 changes -0, so the compiler would really add.
template <class S> GSPARC_INLINE Vec<S> splat(S x) {
    Vec<S> v;
    for (int i = 0; i < Lanes<S>::n; ++i) v[i] = x;
    return v;
}
#if defined(__AVX512F__)
template <> GSPARC_INLINE Vec<float> splat<float>(float x) { return (Vec<float>)_mm512_set1_ps(x); }
template <> GSPARC_INLINE Vec<double> splat<double>(double x) { return (Vec<double>)_mm512_set1_pd(x); }
#elif defined(__AVX2__)
template <> GSPARC_INLINE Vec<float> splat<float>(float x) { return (Vec<float>)_mm256_set1_ps(x); }
template <> GSPARC_INLINE Vec<double> splat<double>(double x) { return (Vec<double>)_mm256_set1_pd(x); }
#endif
template <class S> GSPARC_INLINE Vec<S> load(const S* p) {
    Vec<S> v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
template <class S> GSPARC_INLINE void store(S* p, Vec<S> v) { __builtin_memcpy(p, &v, sizeof v); }

// Masks, and fused multiply-add where the machine has it: always the same instruction in forward and backward,
// because the compiler may not contract on its own (-ffp-contract=off).
#if defined(__AVX512F__)
template <class S> struct MaskOf;
template <> struct MaskOf<float> { typedef __mmask16 M; };
template <> struct MaskOf<double> { typedef __mmask8 M; };
template <class S> using Mask = typename MaskOf<S>::M;
GSPARC_INLINE __mmask16 at_most(Vec<float> a, Vec<float> b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ); }
GSPARC_INLINE __mmask8 at_most(Vec<double> a, Vec<double> b) { return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LE_OQ); }
GSPARC_INLINE __mmask16 below(Vec<float> a, Vec<float> b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ); }
GSPARC_INLINE __mmask8 below(Vec<double> a, Vec<double> b) { return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LT_OQ); }
GSPARC_INLINE Vec<float> select(__mmask16 m, Vec<float> a, Vec<float> b) { return (Vec<float>)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a); }
GSPARC_INLINE Vec<double> select(__mmask8 m, Vec<double> a, Vec<double> b) { return (Vec<double>)_mm512_mask_blend_pd(m, (__m512d)b, (__m512d)a); }
template <class M> GSPARC_INLINE bool any(M m) { return m != 0; }
GSPARC_INLINE Vec<float> fma(Vec<float> a, Vec<float> b, Vec<float> c) { return (Vec<float>)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
GSPARC_INLINE Vec<double> fma(Vec<double> a, Vec<double> b, Vec<double> c) { return (Vec<double>)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
#else
template <class S> using Mask = Int<S>;
GSPARC_INLINE Int<float> at_most(Vec<float> a, Vec<float> b) { return a <= b; }
GSPARC_INLINE Int<double> at_most(Vec<double> a, Vec<double> b) { return a <= b; }
GSPARC_INLINE Int<float> below(Vec<float> a, Vec<float> b) { return a < b; }
GSPARC_INLINE Int<double> below(Vec<double> a, Vec<double> b) { return a < b; }
GSPARC_INLINE Vec<float> select(Int<float> m, Vec<float> a, Vec<float> b) { return m ? a : b; }
GSPARC_INLINE Vec<double> select(Int<double> m, Vec<double> a, Vec<double> b) { return m ? a : b; }
#if defined(__AVX2__)
GSPARC_INLINE bool any(Int<float> m) { return _mm256_movemask_ps((__m256)m) != 0; }
GSPARC_INLINE bool any(Int<double> m) { return _mm256_movemask_pd((__m256d)m) != 0; }
GSPARC_INLINE Vec<float> fma(Vec<float> a, Vec<float> b, Vec<float> c) { return (Vec<float>)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
GSPARC_INLINE Vec<double> fma(Vec<double> a, Vec<double> b, Vec<double> c) { return (Vec<double>)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
#else
template <class I> GSPARC_INLINE bool any(I m) {
    auto set = m[0];
    for (int i = 1; i < int(sizeof m / sizeof m[0]); ++i) set |= m[i];
    return set != 0;
}
template <class V> GSPARC_INLINE V fma(V a, V b, V c) { return a * b + c; }
#endif
#endif

// A mask as bits, lane 0 first.
#if defined(__AVX512F__)
template <class S> GSPARC_INLINE unsigned bits_of(Mask<S> m) { return m; }
#else
template <class S> GSPARC_INLINE unsigned bits_of(Mask<S> m) {
    unsigned bits = 0;
    for (int i = 0; i < Lanes<S>::n; ++i) bits |= unsigned(m[i] & 1) << i;
    return bits;
}
#if defined(__AVX2__)
template <> GSPARC_INLINE unsigned bits_of<float>(Mask<float> m) { return unsigned(_mm256_movemask_ps((__m256)m)); }
template <> GSPARC_INLINE unsigned bits_of<double>(Mask<double> m) { return unsigned(_mm256_movemask_pd((__m256d)m)); }
#endif
#endif

// The sum of all lanes, halves added to halves.
template <class S> GSPARC_INLINE S sum(Vec<S> v) {
    S lanes[Lanes<S>::n];
    store(lanes, v);
    for (int width = Lanes<S>::n / 2; width > 0; width /= 2)
        for (int i = 0; i < width; ++i) lanes[i] += lanes[i + width];
    return lanes[0];
}
#if defined(__AVX2__)
GSPARC_INLINE float sum_of(__m256 v) {
    __m128 a = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    a = _mm_add_ps(a, _mm_movehl_ps(a, a));
    return _mm_cvtss_f32(_mm_add_ss(a, _mm_shuffle_ps(a, a, 1)));
}
#if defined(__AVX512F__)
template <> GSPARC_INLINE float sum<float>(Vec<float> v) {
    return sum_of(_mm256_add_ps(_mm512_castps512_ps256((__m512)v), _mm512_extractf32x8_ps((__m512)v, 1)));
}
#else
template <> GSPARC_INLINE float sum<float>(Vec<float> v) { return sum_of((__m256)v); }
#endif
#endif

// 1 / x to the last bit or two; x of normal size.
template <class V> GSPARC_INLINE V reciprocal(V x) { return 1 / x; }
#if defined(__AVX512F__)
GSPARC_INLINE Vec<float> reciprocal(Vec<float> x) {
    const Vec<float> r = (Vec<float>)_mm512_rcp14_ps((__m512)x);
    return fma(r, fma(-x, r, splat(1.0f)), r);
}
#endif

template <class S> GSPARC_INLINE Vec<S> lesser(Vec<S> a, Vec<S> b) { return select(at_most(a, b), a, b); }
template <class S> GSPARC_INLINE Vec<S> greater(Vec<S> a, Vec<S> b) { return select(at_most(a, b), b, a); }
#if defined(__AVX512F__)
template <> GSPARC_INLINE Vec<float> lesser<float>(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm512_min_ps((__m512)a, (__m512)b); }
template <> GSPARC_INLINE Vec<float> greater<float>(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm512_max_ps((__m512)a, (__m512)b); }
#elif defined(__AVX2__)
template <> GSPARC_INLINE Vec<float> lesser<float>(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm256_min_ps((__m256)a, (__m256)b); }
template <> GSPARC_INLINE Vec<float> greater<float>(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm256_max_ps((__m256)a, (__m256)b); }
#endif

template <class S> GSPARC_INLINE Vec<S> square_root(Vec<S> x) {
    for (int i = 0; i < Lanes<S>::n; ++i) x[i] = __builtin_sqrt(x[i]);
    return x;
}
#if defined(__AVX512F__)
template <> GSPARC_INLINE Vec<float> square_root<float>(Vec<float> x) { return (Vec<float>)_mm512_sqrt_ps((__m512)x); }
template <> GSPARC_INLINE Vec<double> square_root<double>(Vec<double> x) { return (Vec<double>)_mm512_sqrt_pd((__m512d)x); }
#elif defined(__AVX2__)
template <> GSPARC_INLINE Vec<float> square_root<float>(Vec<float> x) { return (Vec<float>)_mm256_sqrt_ps((__m256)x); }
template <> GSPARC_INLINE Vec<double> square_root<double>(Vec<double> x) { return (Vec<double>)_mm256_sqrt_pd((__m256d)x); }
#endif

GSPARC_INLINE Vec<float> magnitude(Vec<float> x) { return (Vec<float>)((Int<float>)x & 0x7fffffff); }
GSPARC_INLINE Vec<double> magnitude(Vec<double> x) { return (Vec<double>)((Int<double>)x & 0x7fffffffffffffff); }

// Nearest integer, halves to even, for |x| < 2^22.
GSPARC_INLINE Vec<float> nearest(Vec<float> x) { return (x + 12582912.0f) - 12582912.0f; }
GSPARC_INLINE Vec<double> nearest(Vec<double> x) { return (x + 6755399441055744.0) - 6755399441055744.0; }

// exp(x) for x <= 0, relative error below 4e-7 in float32 and 1e-15 in float64; flat below the normal numbers, anything above 0.
GSPARC_INLINE Vec<float> exponential(Vec<float> x) {
    x = greater<float>(x, splat(-87.0f));
    const Vec<float> shifted = x * 1.44269504f + 12582912.0f, whole = shifted - 12582912.0f;
    const Vec<float> r = fma(whole, splat(-1.42860677e-6f), fma(whole, splat(-0.693145752f), x));
    Vec<float> p = splat(1.38888889e-3f);
    p = fma(p, r, splat(8.33333333e-3f));
    p = fma(p, r, splat(4.16666667e-2f));
    p = fma(p, r, splat(0.166666667f));
    p = fma(p, r, splat(0.5f));
    p = fma(p, r, splat(1.0f));
    p = fma(p, r, splat(1.0f));
    return (Vec<float>)((Whole<float>)p + ((Whole<float>)shifted << 23));
}
GSPARC_INLINE Vec<double> exponential(Vec<double> x) {
    x = greater<double>(x, splat(-700.0));
    const Vec<double> shifted = x * 1.4426950408889634 + 6755399441055744.0, whole = shifted - 6755399441055744.0;
    const Vec<double> r = fma(whole, splat(-1.9082149292705877e-10), fma(whole, splat(-0.69314718036912382), x));
    Vec<double> p = splat(1.0 / 6227020800.0);
    const double factors[] = {1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320,
                              1.0 / 5040, 1.0 / 720, 1.0 / 120, 1.0 / 24, 1.0 / 6, 0.5, 1.0, 1.0};
    for (int i = 0; i < 13; ++i) p = fma(p, r, splat(factors[i]));
    return (Vec<double>)((Whole<double>)p + ((Whole<double>)shifted << 52));
}

// 2^-halvings: what lies beyond the cut-off may come out as anything. In float32 to a relative error below 4e-6.
template <class S> GSPARC_INLINE Vec<S> bell(Vec<S> halvings) { return exponential(halvings * S(-0.6931471805599453)); }
#if defined(__AVX512F__)
template <> GSPARC_INLINE Vec<float> bell<float>(Vec<float> halvings) {
    const __m512 x = (__m512)-halvings;
    const Vec<float> r = (Vec<float>)_mm512_reduce_ps(x, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);  // x less its floor
    Vec<float> p = splat(0.013534123077988625f);
    p = fma(p, r, splat(0.052011482417583466f));
    p = fma(p, r, splat(0.24144279956817627f));
    p = fma(p, r, splat(0.6930038332939148f));
    p = fma(p, r, splat(1.0000026226043701f));
    return (Vec<float>)_mm512_scalef_ps((__m512)p, x);
}
#else
template <> GSPARC_INLINE Vec<float> bell<float>(Vec<float> halvings) {
    const Vec<float> shifted = 12582912.0f - halvings, r = (12582912.0f - shifted) - halvings;  // less the nearest integer
    Vec<float> p = splat(0.009570070542395115f);
    p = fma(p, r, splat(0.05591781064867973f));
    p = fma(p, r, splat(0.2402474582195282f));
    p = fma(p, r, splat(0.6931218504905701f));
    p = fma(p, r, splat(0.9999992847442627f));
    return (Vec<float>)((Whole<float>)p + ((Whole<float>)shifted << 23));
}
#endif

}  // namespace GSPARC_ISA
}  // namespace gsparc

// Rows of numbers as lanes, a row each, and back.
#pragma once
#include <string.h>

#include "kernels.h"
#include "pack.h"

namespace gsparc {
namespace GSPARC_ISA {

// Rows [0, count) of `width` numbers each, one row a lane; lanes past the end repeat the last row.
template <class S> inline void gather_rows(const S* rows, int width, int count, Pack<S>* out) {
    constexpr int n = Pack<S>::n;
    S lanes[16][n];
    for (int k = 0; k < n; ++k)
        for (int c = 0; c < width; ++c) lanes[c][k] = rows[(k < count ? k : count - 1) * width + c];
    for (int c = 0; c < width; ++c) out[c] = load(lanes[c]);
}
template <class S> inline void scatter_rows(const Pack<S>* in, int width, int count, S* rows) {
    constexpr int n = Pack<S>::n;
    S lanes[16][n];
    for (int c = 0; c < width; ++c) store(lanes[c], in[c].v);
    for (int k = 0; k < count; ++k)
        for (int c = 0; c < width; ++c) rows[k * width + c] = lanes[c][k];
}

// `width` numbers of each of the rows `which`, `stride` apart, a row a lane; a multiple of four.
template <class S> inline void gather_at(const S* rows, int stride, const int32_t* which, int width, Pack<S>* out) {
    constexpr int n = Pack<S>::n;
    S lanes[16][n];
    for (int k = 0; k < n; ++k)
        for (int c = 0; c < width; ++c) lanes[c][k] = rows[int64_t(which[k]) * stride + c];
    for (int c = 0; c < width; ++c) out[c] = load(lanes[c]);
}

// Four numbers of rows that lie `stride` apart, as `scatter_rows`.
template <class S> inline void scatter_fours(const Pack<S>* in, int stride, int count, S* rows) {
    constexpr int n = Pack<S>::n;
    S lanes[4][n];
    for (int c = 0; c < 4; ++c) store(lanes[c], in[c].v);
    for (int k = 0; k < count; ++k)
        for (int c = 0; c < 4; ++c) rows[k * stride + c] = lanes[c][k];
}
template <class S> inline void scatter_boxes(const Pack<S>* in, int count, Box* boxes) {
    for (int k = 0; k < count; ++k) boxes[k] = {int32_t(in[0].v[k]), int32_t(in[1].v[k]), int32_t(in[2].v[k]), int32_t(in[3].v[k])};
}
#if defined(__AVX512F__)
// Four vectors as rows: vector k holds rows k, 4 + k, 8 + k and 12 + k.
GSPARC_INLINE void turn_fours(__m512 a, __m512 b, __m512 c, __m512 d, __m512* out) {
    const __m512d ab = _mm512_castps_pd(_mm512_unpacklo_ps(a, b)), cd = _mm512_castps_pd(_mm512_unpacklo_ps(c, d));
    const __m512d ef = _mm512_castps_pd(_mm512_unpackhi_ps(a, b)), gh = _mm512_castps_pd(_mm512_unpackhi_ps(c, d));
    out[0] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd)), out[1] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd));
    out[2] = _mm512_castpd_ps(_mm512_unpacklo_pd(ef, gh)), out[3] = _mm512_castpd_ps(_mm512_unpackhi_pd(ef, gh));
}
GSPARC_INLINE void store_fours(const __m512* in, int stride, float* to) {
    __m512 out[4];
    turn_fours(in[0], in[1], in[2], in[3], out);
    for (int k = 0; k < 4; ++k) {
        _mm_storeu_ps(to + k * stride, _mm512_extractf32x4_ps(out[k], 0)), _mm_storeu_ps(to + (4 + k) * stride, _mm512_extractf32x4_ps(out[k], 1));
        _mm_storeu_ps(to + (8 + k) * stride, _mm512_extractf32x4_ps(out[k], 2)), _mm_storeu_ps(to + (12 + k) * stride, _mm512_extractf32x4_ps(out[k], 3));
    }
}
template <> inline void scatter_fours<float>(const Pack<float>* in, int stride, int count, float* rows) {
    const __m512 four[4] = {(__m512)in[0].v, (__m512)in[1].v, (__m512)in[2].v, (__m512)in[3].v};
    if (count == 16) return store_fours(four, stride, rows);
    for (int k = 0; k < count; ++k)
        for (int c = 0; c < 4; ++c) rows[k * stride + c] = in[c].v[k];
}
template <> inline void scatter_boxes<float>(const Pack<float>* in, int count, Box* boxes) {
    __m512 four[4];
    for (int c = 0; c < 4; ++c) four[c] = _mm512_castsi512_ps(_mm512_cvttps_epi32((__m512)in[c].v));
    Box all[16];
    store_fours(four, 4, reinterpret_cast<float*>(all));
    memcpy(boxes, all, count * sizeof(Box));
}
// Rows of 3 numbers: three vectors hold 16 of them.
GSPARC_INLINE void gather_threes(const float* rows, Pack<float>* out) {
    const __m512 a = _mm512_loadu_ps(rows), b = _mm512_loadu_ps(rows + 16), c = _mm512_loadu_ps(rows + 32);
    for (int k = 0; k < 3; ++k) {  // lane i is number 3 i + k: 16 and more come from b, 32 and more from c
        alignas(64) int32_t from[16];
        for (int i = 0; i < 16; ++i) from[i] = 3 * i + k;
        const __m512i index = _mm512_load_si512(from);
        const __m512 ab = _mm512_permutex2var_ps(a, index, b);
        out[k] = (Vec<float>)_mm512_mask_permutexvar_ps(ab, _mm512_cmpge_epi32_mask(index, _mm512_set1_epi32(32)), index, c);
    }
}
template <> inline void gather_at<float>(const float* rows, int stride, const int32_t* which, int width, Pack<float>* out) {
    for (int c = 0; c < width; c += 4) {
        const auto four = [&](int k) { return _mm_loadu_ps(rows + int64_t(which[k]) * stride + c); };
        __m512 all[4], turned[4];
        for (int k = 0; k < 4; ++k) {  // rows 4 g + k of groups g, so that lanes come out in order
            all[k] = _mm512_insertf32x4(_mm512_castps128_ps512(four(k)), four(4 + k), 1);
            all[k] = _mm512_insertf32x4(_mm512_insertf32x4(all[k], four(8 + k), 2), four(12 + k), 3);
        }
        turn_fours(all[0], all[1], all[2], all[3], turned);
        for (int k = 0; k < 4; ++k) out[c + k] = (Vec<float>)turned[k];
    }
}
template <> inline void gather_rows<float>(const float* rows, int width, int count, Pack<float>* out) {
    if (count == 16 && width == 1) out[0] = load(rows);
    else if (count == 16 && width == 3) gather_threes(rows, out);
    else if (count == 16 && width == 4) {
        constexpr int32_t all[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
        gather_at(rows, 4, all, 4, out);
    }
    else {
        for (int c = 0; c < width; ++c)
            for (int k = 0; k < 16; ++k) out[c].v[k] = rows[(k < count ? k : count - 1) * width + c];
    }
}
#elif defined(__AVX2__)
// Four vectors as rows, and back: vector k holds rows k and 4 + k.
GSPARC_INLINE void turn_fours(__m256 a, __m256 b, __m256 c, __m256 d, Pack<float>* out) {
    const __m256d ab = _mm256_castps_pd(_mm256_unpacklo_ps(a, b)), cd = _mm256_castps_pd(_mm256_unpacklo_ps(c, d));
    const __m256d ef = _mm256_castps_pd(_mm256_unpackhi_ps(a, b)), gh = _mm256_castps_pd(_mm256_unpackhi_ps(c, d));
    out[0] = (Vec<float>)_mm256_unpacklo_pd(ab, cd), out[1] = (Vec<float>)_mm256_unpackhi_pd(ab, cd);
    out[2] = (Vec<float>)_mm256_unpacklo_pd(ef, gh), out[3] = (Vec<float>)_mm256_unpackhi_pd(ef, gh);
}
template <> inline void gather_at<float>(const float* rows, int stride, const int32_t* which, int width, Pack<float>* out) {
    for (int c = 0; c < width; c += 4) {
        const auto fours = [&](int k) {
            const float *low = rows + int64_t(which[k]) * stride + c, *high = rows + int64_t(which[4 + k]) * stride + c;
            return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(low)), _mm_loadu_ps(high), 1);
        };
        turn_fours(fours(0), fours(1), fours(2), fours(3), out + c);
    }
}
template <> inline void scatter_fours<float>(const Pack<float>* in, int stride, int count, float* rows) {
    Pack<float> turned[4];
    turn_fours((__m256)in[0].v, (__m256)in[1].v, (__m256)in[2].v, (__m256)in[3].v, turned);
    for (int k = 0; k < count; ++k) {
        const __m256 two = (__m256)turned[k % 4].v;
        _mm_storeu_ps(rows + k * stride, k < 4 ? _mm256_castps256_ps128(two) : _mm256_extractf128_ps(two, 1));
    }
}
#endif

}  // namespace GSPARC_ISA
}  // namespace gsparc

// From Gaussians to records and boxes, as many at a time as there are lanes.
#pragma once
#include "boxes.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// The lens with every number in all lanes.
template <class S> Lens<Pack<S>> widened(const Lens<S>& l) {
    return {l.height, l.width, l.periodic, l.tangent, l.compensate, l.relative, l.first_elevation, l.first_azimuth,
            l.elevation_step, l.azimuth_step, l.low_pass, l.near, l.alpha_min, l.transmittance_min, l.alpha_max, l.horizon_cosine};
}

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

// The same for four numbers out of rows that lie `stride` apart.
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
GSPARC_INLINE void gather_fours(const float* rows, Pack<float>* out) {
    __m512 all[4];
    for (int k = 0; k < 4; ++k) {  // rows 4 g + k of groups g, so that lanes come out in order
        all[k] = _mm512_castps128_ps512(_mm_loadu_ps(rows + 4 * k));
        all[k] = _mm512_insertf32x4(all[k], _mm_loadu_ps(rows + 4 * (4 + k)), 1);
        all[k] = _mm512_insertf32x4(all[k], _mm_loadu_ps(rows + 4 * (8 + k)), 2);
        all[k] = _mm512_insertf32x4(all[k], _mm_loadu_ps(rows + 4 * (12 + k)), 3);
    }
    __m512 turned[4];
    turn_fours(all[0], all[1], all[2], all[3], turned);
    for (int k = 0; k < 4; ++k) out[k] = (Vec<float>)turned[k];
}
template <> inline void gather_rows<float>(const float* rows, int width, int count, Pack<float>* out) {
    if (count == 16 && width == 1) out[0] = load(rows);
    else if (count == 16 && width == 3) gather_threes(rows, out);
    else if (count == 16 && width == 4) gather_fours(rows, out);
    else {
        for (int c = 0; c < width; ++c)
            for (int k = 0; k < 16; ++k) out[c].v[k] = rows[(k < count ? k : count - 1) * width + c];
    }
}
#endif

template <class S> inline Gaussian<Pack<S>> gaussians(const Model<S>& model, int64_t i, int count) {
    Gaussian<Pack<S>> g;
    gather_rows(model.means + 3 * i, 3, count, g.mean);
    gather_rows(model.quats + 4 * i, 4, count, g.quat);
    gather_rows(model.scales + 3 * i, 3, count, g.scale);
    return g;
}

// Whether `unsound` has nothing to say.
template <class S> inline Which<S> all_sound(const Gaussian<Pack<S>>& g, Pack<S> opacity) {
    const Pack<S> big = sizeof(S) == 4 ? S(3.4e38) : S(1.7e308), far = S(kFarthest), wide = S(kWidest), zero = S(0);
    Which<S> fine = (opacity >= zero) & (opacity <= Pack<S>(S(1))), mean = fine, quat = fine;  // three chains: masks come late
    for (int k = 0; k < 3; ++k) mean = mean & (g.mean[k] <= far) & (g.mean[k] >= -far), fine = fine & (g.scale[k] <= wide) & (g.scale[k] >= zero);
    for (int k = 0; k < 4; ++k) quat = quat & (g.quat[k] <= big) & (g.quat[k] >= -big);
    return fine & mean & quat;
}

// A receiver's pose in all lanes.
template <class S> struct Stand {
    Pack<S> position[3], rotation[9];
    Stand(const Model<S>& model, int pose) {
        for (int k = 0; k < 3; ++k) position[k] = model.positions[3 * pose + k];
        for (int k = 0; k < 9; ++k) rotation[k] = model.rotations[9 * pose + k];
    }
};

// `project_one` for rows [i, i + count), count at most the lanes.
template <class S> int64_t project_some(const ProjectArgs<S>& a, const Lens<Pack<S>>& lens, const Stand<S>& stand, int64_t i, int count) {
    constexpr int n = Pack<S>::n;
    Pack<S> opacity;
    gather_rows(a.model.opacities + i, 1, count, &opacity);
    const Gaussian<Pack<S>> g = gaussians(a.model, i, count);
    if (!none(!all_sound(g, opacity))) {
        for (int64_t k = i; k < i + count; ++k) {
            const int wrong = unsound(gaussian(a.model, k), a.model.opacities[k]);
            if (wrong >= 0) return 4 * k + wrong;
        }
    }
    const Sight<Pack<S>> s = sight_of(g, opacity, stand.position, stand.rotation, lens);
    const Pack<S> place[2] = {s.column, s.row};
    scatter_rows(place, 2, count, a.means2d + 2 * i);
    scatter_rows(&s.depth, 1, count, a.depths + i);
    const Pack<S> zero = S(0);
    Extents<Pack<S>> extents = extents_of(s.frame, lens);
    const Which<S> seen = (s.reach >= zero) & (extents.row1 > extents.row0);
    const Pack<S> ends[4] = {extents.row0, extents.row1, extents.column0, extents.columns};
    Pack<S> kept[4];
    for (int c = 0; c < 4; ++c) kept[c] = pick(seen, ends[c], zero);
    scatter_boxes(kept, count, a.boxes + i);
    const Pack<S> radius = pick(seen, s.radius, zero);
    scatter_rows(&radius, 1, count, a.radii + i);
    const unsigned bits = bits_of<S>(seen.lanes);
    for (int k = 0; k < count; ++k) a.visible[i + k] = bits >> k & 1;
    for (int c = 0; c < kRecord; c += 4) {
        for (int k = 0; k < 4; ++k) kept[k] = pick(seen, s.record[c + k], zero);
        scatter_fours(kept, kRecord, count, a.records + i * kRecord + c);
    }
    return -1;
}

template <class S> int64_t project_range(const ProjectArgs<S>& a, int begin, int end) {
    constexpr int n = Pack<S>::n;
    const Lens<Pack<S>> lens = widened(a.lens);
    const Stand<S> stand(a.model, a.pose);
    for (int64_t i = begin; i < end; i += n) {
        const int64_t wrong = project_some(a, lens, stand, i, end - i < n ? int(end - i) : n);
        if (wrong >= 0) return wrong;
    }
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

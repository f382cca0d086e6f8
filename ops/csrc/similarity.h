// Mean structural similarity of images and its gradient (Wang et al. 2004), a separable window.
#pragma once
#include "kernels.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// B images (H, W), seen through a separable window of kTaps taps.
struct SimilarityArgs {
    int count, height, width, threads;
    float c1, c2;
    const float *taps, *prediction, *target;
    float *value, *slope;           // (B,), and (B, H, W) d value / d prediction, or null
    explicit SimilarityArgs(const Call& call) : threads(call.threads), c1(float(call.numbers[0])), c2(float(call.numbers[1])) {
        Reader in(call);
        in.sizes(count, height, width);
        in.read(taps, prediction, target, value, slope);
    }
};

// Rows of an image padded to whole lanes on the right, so that a vector may overhang.
struct Plane {
    float* data;
    int stride;
    float* row(int y) const { return data + int64_t(y) * stride; }
};

// One worker's scratch: the shifted images, five windowed columns, three derivatives and a row of their windows.
struct SimilarityScratch {
    static constexpr int kMaps = 5, kSlopes = 3;
    Plane p, t, by[kSlopes], columns, half;  // columns (kMaps, stride), half (kSlopes, stride)

    static int stride_of(const SimilarityArgs& a) { return (a.width + 4 * kLanes + 2 * kRadius) / kLanes * kLanes; }
    static int64_t plane(const SimilarityArgs& a) { return int64_t(stride_of(a)) * (a.height + 2 * kRadius); }
    static int64_t size(const SimilarityArgs& a) { return (2 + kSlopes) * plane(a) + (kMaps + kSlopes) * stride_of(a); }
    SimilarityScratch(const SimilarityArgs& a, float* memory) {
        const int stride = stride_of(a);
        const int64_t each = plane(a);
        p = {memory, stride}, t = {memory + each, stride};
        for (int k = 0; k < kSlopes; ++k) by[k] = {memory + (2 + k) * each, stride};
        columns = {memory + (2 + kSlopes) * each, stride}, half = {columns.row(kMaps), stride};
    }
};

// The first lanes, `count` of them; the others are 0.
GSPARC_INLINE Vec<float> first_of(Vec<float> v, int count) {
    constexpr int n = Lanes<float>::n;
    if (count >= n) return v;
    for (int k = 0; k < n; ++k) v[k] = k < count ? v[k] : 0.0f;
    return v;
}

// Similarity at one place (eq. 13), for vectors of places. m: windowed mean of p, of t, of p p, of t t and of p t, all about
// `shift`. Where `slope`, `by` becomes `share` times the derivatives by the windowed mean of p, of p p and of p t.
GSPARC_INLINE Vec<float> similar_at(const Vec<float> (&m)[5], float shift, float c1, float c2, float share, bool slope, Vec<float> (&by)[3]) {
    const Vec<float> none = splat(0.0f), raw = m[2] - m[0] * m[0];
    const Vec<float> spread = greater<float>(raw, none) + greater<float>(m[3] - m[1] * m[1], none) + c2;
    const Vec<float> covariance = 2.0f * (m[4] - m[0] * m[1]) + c2, light_p = m[0] + shift, light_t = m[1] + shift;
    const Vec<float> power = light_p * light_p + light_t * light_t + c1, product = 2.0f * light_p * light_t + c1;
    const Vec<float> similar = product * covariance / (power * spread);
    if (!slope) return similar;
    const Vec<float> by_cross = 2.0f * share * product / (power * spread);
    const Vec<float> by_square = select(at_most(none, raw), -share * similar / spread, none);  // only rounding makes a variance negative
    const Vec<float> by_light = 2.0f * share * (light_t * covariance / spread - light_p * similar) / power;
    by[0] = by_light - m[1] * by_cross - 2.0f * m[0] * by_square, by[1] = by_square, by[2] = by_cross;
    return similar;
}

// Windowed moments of one row of the valid part; returns the row's sum of the similarity. Derivatives by the
// windowed mean, square and product go into `by`, shifted by the radius so that its border stays zero.
inline float similarity_row(const SimilarityArgs& a, const SimilarityScratch& s, int y, float shift, float share) {
    constexpr int n = Lanes<float>::n;
    const int valid = a.width - 2 * kRadius;
    for (int x = 0; x < a.width; x += n) {
        Vec<float> m[5] = {};
        for (int k = 0; k < kTaps; ++k) {
            const Vec<float> w = splat(a.taps[k]), p = load(s.p.row(y + k) + x), t = load(s.t.row(y + k) + x), wp = w * p, wt = w * t;
            m[0] += wp, m[1] += wt, m[2] = fma(wp, p, m[2]), m[3] = fma(wt, t, m[3]), m[4] = fma(wp, t, m[4]);
        }
        for (int k = 0; k < 5; ++k) store(s.columns.row(k) + x, m[k]);
    }
    Vec<float> total = splat(0.0f);
    for (int x = 0; x < valid; x += n) {
        Vec<float> m[5] = {};
        for (int k = 0; k < kTaps; ++k)
            for (int c = 0; c < 5; ++c) m[c] = fma(splat(a.taps[k]), load(s.columns.row(c) + x + k), m[c]);
        Vec<float> by[3];
        total += first_of(similar_at(m, shift, a.c1, a.c2, share, a.slope != nullptr, by), valid - x);
        if (!a.slope) continue;
        for (int c = 0; c < 3; ++c) store(s.by[c].row(y + kRadius) + x + kRadius, first_of(by[c], valid - x));
    }
    return sum<float>(total);
}

// One row of the transposed window of the derivatives, which is the window itself over a border of zeros.
inline void similarity_slope(const SimilarityArgs& a, const SimilarityScratch& s, int y, float* slope) {
    constexpr int n = Lanes<float>::n;
    const int begin = y < 2 * kRadius ? 2 * kRadius - y : 0, past = a.height - y, end = past < kTaps ? past : kTaps;  // rows that hold something
    for (int x = 0; x < a.width; x += n) {
        Vec<float> m[3] = {};
        for (int k = begin; k < end; ++k)
            for (int c = 0; c < 3; ++c) m[c] = fma(splat(a.taps[k]), load(s.by[c].row(y + k - kRadius) + x), m[c]);
        for (int c = 0; c < 3; ++c) store(s.half.row(c) + kRadius + x, m[c]);
    }
    for (int x = 0; x < a.width; x += n) {
        Vec<float> m[3] = {};
        for (int k = 0; k < kTaps; ++k)
            for (int c = 0; c < 3; ++c) m[c] = fma(splat(a.taps[k]), load(s.half.row(c) + x + k), m[c]);
        const Vec<float> all = m[0] + 2.0f * load(s.p.row(y) + x) * m[1] + load(s.t.row(y) + x) * m[2];
        float lanes[n];
        store(lanes, all);
        memcpy(slope + x, lanes, (a.width - x < n ? a.width - x : n) * sizeof(float));
    }
}

// The mean of many numbers, lanes side by side.
inline float mean_of(const float* x, int64_t count) {
    constexpr int n = Lanes<double>::n;
    double lanes[n] = {}, all = 0;
    int64_t k = 0;
    for (; k + n <= count; k += n)
        for (int j = 0; j < n; ++j) lanes[j] += x[k + j];
    for (; k < count; ++k) all += x[k];
    for (int j = 0; j < n; ++j) all += lanes[j];
    return float(all / double(count));
}

inline void similarity_image(const SimilarityArgs& a, const SimilarityScratch& s, int image) {
    const int64_t pixels = int64_t(a.height) * a.width;
    const float *prediction = a.prediction + image * pixels, *target = a.target + image * pixels;
    const float shift = mean_of(target, pixels);  // moments about it: flat images would lose every digit
    for (int y = 0; y < a.height; ++y)
        for (int x = 0; x < a.width; ++x) {
            s.p.row(y)[x] = prediction[int64_t(y) * a.width + x] - shift;
            s.t.row(y)[x] = target[int64_t(y) * a.width + x] - shift;
        }
    const int rows = a.height - 2 * kRadius;
    const double count = double(rows) * (a.width - 2 * kRadius);
    double total = 0;
    for (int y = 0; y < a.height; ++y) {
        if (y < rows) total += similarity_row(a, s, y, shift, float(1 / count));
        if (a.slope) similarity_slope(a, s, y, a.slope + image * pixels + int64_t(y) * a.width);
    }
    a.value[image] = float(total / count);
}

template <class S> int64_t similarity(const Call& call) {
    const SimilarityArgs a(call);
    const int64_t each = SimilarityScratch::size(a);
    Buffer<float> memory(each * a.threads);
    auto run = [&](int image, int worker) { similarity_image(a, SimilarityScratch(a, memory.data + worker * each), image); };
    parallel_for(a.count, a.threads, run);
    return 0;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

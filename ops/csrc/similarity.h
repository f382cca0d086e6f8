// Mean structural similarity of images and its gradient (Wang et al. 2004), a separable window.
#pragma once
#include "kernels.h"
#include "simd.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// Rows of an image padded to whole lanes on the right, so that a vector may overhang.
struct Plane {
    float* data;
    int stride;
    float* row(int y) const { return data + int64_t(y) * stride; }
};

// One worker's scratch: the shifted images, five windowed columns, three derivatives and their transposed windows.
struct SimilarityScratch {
    static constexpr int kMaps = 5, kSlopes = 3;
    Plane p, t, by[kSlopes], half[kSlopes];
    float* columns;  // (kMaps, stride)
    int stride;

    static int stride_of(const SimilarityArgs& a) { return (a.width + 4 * kLanes + 2 * a.radius) / kLanes * kLanes; }
    static int64_t size(const SimilarityArgs& a) {
        const int64_t stride = stride_of(a), tall = a.height + 2 * a.radius;
        return stride * (2 * tall + 2 * kSlopes * tall + kMaps);
    }
    SimilarityScratch(const SimilarityArgs& a, float* memory) : stride(stride_of(a)) {
        const int64_t each = int64_t(stride) * (a.height + 2 * a.radius);
        p = {memory, stride}, t = {memory + each, stride};
        for (int k = 0; k < kSlopes; ++k) by[k] = {memory + (2 + k) * each, stride}, half[k] = {memory + (2 + kSlopes + k) * each, stride};
        columns = memory + (2 + 2 * kSlopes) * each;
    }
};

// Windowed moments of one row of the valid part; returns the row's sum of the similarity. Derivatives by the
// windowed mean, square and product go into `by`, shifted by the radius so that its border stays zero.
inline float similarity_row(const SimilarityArgs& a, const SimilarityScratch& s, int y, float shift, float share) {
    constexpr int n = Lanes<float>::n;
    const int taps = 2 * a.radius + 1, valid = a.width - 2 * a.radius, stride = s.stride;
    for (int x = 0; x < a.width; x += n) {
        Vec<float> m[5] = {};
        for (int k = 0; k < taps; ++k) {
            const Vec<float> w = splat(a.taps[k]), p = load(s.p.row(y + k) + x), t = load(s.t.row(y + k) + x), wp = w * p, wt = w * t;
            m[0] += wp, m[1] += wt, m[2] = fma(wp, p, m[2]), m[3] = fma(wt, t, m[3]), m[4] = fma(wp, t, m[4]);
        }
        for (int k = 0; k < 5; ++k) store(s.columns + k * stride + x, m[k]);
    }
    const Vec<float> none = splat(0.0f);
    float total = 0;
    for (int x = 0; x < valid; x += n) {
        Vec<float> m[5] = {};
        for (int k = 0; k < taps; ++k)
            for (int c = 0; c < 5; ++c) m[c] = fma(splat(a.taps[k]), load(s.columns + c * stride + x + k), m[c]);
        const Vec<float> raw = m[2] - m[0] * m[0];
        const Vec<float> spread = greater<float>(raw, none) + greater<float>(m[3] - m[1] * m[1], none) + a.c2;
        const Vec<float> covariance = 2.0f * (m[4] - m[0] * m[1]) + a.c2, light_p = m[0] + shift, light_t = m[1] + shift;
        const Vec<float> power = light_p * light_p + light_t * light_t + a.c1, product = 2.0f * light_p * light_t + a.c1;
        const Vec<float> similar = product * covariance / (power * spread);
        float lanes[n];
        store(lanes, similar);
        const int some = valid - x < n ? valid - x : n;
        for (int k = 0; k < some; ++k) total += lanes[k];
        if (!a.slope) continue;
        const Vec<float> by_cross = 2.0f * share * product / (power * spread);
        const Vec<float> by_square = select(at_most(none, raw), -share * similar / spread, none);
        const Vec<float> by_light = 2.0f * share * (light_t * covariance / spread - light_p * similar) / power;
        const Vec<float> all[3] = {by_light - m[1] * by_cross - 2.0f * m[0] * by_square, by_square, by_cross};
        for (int c = 0; c < 3; ++c) {
            store(lanes, all[c]);
            float* to = s.by[c].row(y + a.radius) + x + a.radius;
            for (int k = 0; k < some; ++k) to[k] = lanes[k];
        }
    }
    return total;
}

// The transposed window of the derivatives, which is the window itself over a border of zeros.
inline void similarity_slopes(const SimilarityArgs& a, const SimilarityScratch& s, float* slope) {
    constexpr int n = Lanes<float>::n;
    const int taps = 2 * a.radius + 1;
    for (int y = 0; y < a.height; ++y) {
        for (int x = 0; x < a.width; x += n)  // along the rows of what the columns gave
            for (int c = 0; c < 3; ++c) {
                Vec<float> total = splat(0.0f);
                for (int k = 0; k < taps; ++k) {
                    const int from = y + k - a.radius;
                    if (from >= 0 && from < a.height) total = fma(splat(a.taps[k]), load(s.by[c].row(from) + x), total);
                }
                store(s.half[c].row(y) + a.radius + x, total);
            }
        for (int c = 0; c < 3; ++c)
            for (int k = 0; k < a.radius + n; ++k) s.half[c].row(y)[k < a.radius ? k : a.width + k] = 0;
        for (int x = 0; x < a.width; x += n) {
            Vec<float> m[3] = {};
            for (int k = 0; k < taps; ++k)
                for (int c = 0; c < 3; ++c) m[c] = fma(splat(a.taps[k]), load(s.half[c].row(y) + x + k), m[c]);
            const Vec<float> all = m[0] + 2.0f * load(s.p.row(y) + x) * m[1] + load(s.t.row(y) + x) * m[2];
            float lanes[n];
            store(lanes, all);
            memcpy(slope + int64_t(y) * a.width + x, lanes, (a.width - x < n ? a.width - x : n) * sizeof(float));
        }
    }
}

inline void similarity(const SimilarityArgs& a) {
    const int64_t each = SimilarityScratch::size(a), pixels = int64_t(a.height) * a.width;
    Buffer<float> memory(each * a.threads);
    auto run = [&](int image, int worker) {
        const SimilarityScratch s(a, memory.data + worker * each);
        const float *prediction = a.prediction + image * pixels, *target = a.target + image * pixels;
        double mean = 0;
        for (int64_t k = 0; k < pixels; ++k) mean += target[k];
        const float shift = float(mean / double(pixels));  // moments about it: flat images would lose every digit
        for (int y = 0; y < a.height; ++y)
            for (int x = 0; x < a.width; ++x) {
                s.p.row(y)[x] = prediction[int64_t(y) * a.width + x] - shift;
                s.t.row(y)[x] = target[int64_t(y) * a.width + x] - shift;
            }
        const int rows = a.height - 2 * a.radius;
        const double count = double(rows) * (a.width - 2 * a.radius);
        double total = 0;
        for (int y = 0; y < rows; ++y) total += similarity_row(a, s, y, shift, float(1 / count));
        a.value[image] = float(total / count);
        if (a.slope) similarity_slopes(a, s, a.slope + image * pixels);
    };
    parallel_for(a.count, a.threads, run);
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

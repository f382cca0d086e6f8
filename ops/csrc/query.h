// Answers to single places: an array's spectrum, and what the nearest rows say of a process.
#pragma once
#include <math.h>

#include "kernels.h"
#include "simd.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// out[j] = start[j] + sum_i by[i] rows[i][j], for columns [j, j + kMany lanes): sums stay in registers.
template <class S, int kMany>
GSPARC_INLINE void combined_columns(const S* by, const S* rows, int count, int64_t width, const S* start, S* out) {
    constexpr int n = Lanes<S>::n;
    Vec<S> sums[kMany];
    for (int k = 0; k < kMany; ++k) sums[k] = start ? load(start + k * n) : Vec<S>{};
    for (int i = 0; i < count; ++i) {
        const Vec<S> factor = splat(by[i]);
        for (int k = 0; k < kMany; ++k) sums[k] = fma(factor, load(rows + i * width + k * n), sums[k]);
    }
    for (int k = 0; k < kMany; ++k) store(out + k * n, sums[k]);
}

// The same for all columns; `start` may be null.
template <class S> void combined(const S* by, const S* rows, int count, int64_t width, const S* start, S* out) {
    constexpr int n = Lanes<S>::n, many = 8;
    int64_t j = 0;
    const auto from = [&](int64_t at) { return start ? start + at : nullptr; };
    for (; j + many * n <= width; j += many * n) combined_columns<S, many>(by, rows + j, count, width, from(j), out + j);
    for (; j + n <= width; j += n) combined_columns<S, 1>(by, rows + j, count, width, from(j), out + j);
    for (; j < width; ++j) {
        S sum = start ? start[j] : S(0);
        for (int i = 0; i < count; ++i) sum += by[i] * rows[i * width + j];
        out[j] = sum;
    }
}

template <class S> inline S dot(const S* a, const S* b, int count) {
    constexpr int n = Lanes<S>::n;
    Vec<S> sums = {};
    int i = 0;
    for (; i + n <= count; i += n) sums += load(a + i) * load(b + i);
    S total = sum<S>(sums);
    for (; i < count; ++i) total += a[i] * b[i];
    return total;
}

template <class S> inline S distance(const S* a, const S* b, int axes) {
    S squared = 0;
    for (int axis = 0; axis < axes; ++axis) squared += (a[axis] - b[axis]) * (a[axis] - b[axis]);
    return sqrt(squared);
}

// (share of Matern-5/2, its length), then the parts of Matern-3/2: distances (count,) in place to correlations, padded.
template <class S> struct Correlation {
    S smooth, smooth_length, shares[2], lengths[2];
    int parts;
    void apply(S* values, int count, S* scratch) const {
        constexpr int n = Lanes<S>::n;
        for (int i = 0; i < count; i += n) {
            const Vec<S> far = load(values + i);
            Vec<S> sum = {};
            for (int part = 0; part < parts; ++part) {
                const Vec<S> x = far * S(sqrt(3.0) / lengths[part]);
                sum += shares[part] * ((S(1) + x) * exponential(-x));
            }
            if (smooth > 0) {
                const Vec<S> x = far * S(sqrt(5.0) / smooth_length);
                sum += smooth * ((S(1) + x + x * x * S(1.0 / 3)) * exponential(-x));
            }
            store(scratch + i, sum);
        }
        for (int i = 0; i < count; ++i) values[i] = scratch[i];
    }
};

template <class S> inline int whole_lanes(int count) { return (count + Lanes<S>::n - 1) / Lanes<S>::n * Lanes<S>::n; }

// Places to spectra of a static array: features of a process, vectors linear in them, lag numbers, harmonics of each row
// of pixels, pixels. See physics/bartlett.py for the tables.
template <class S> struct ArraySpectrumArgs {
    int samples, axes, anchors, features, elements, height, columns, lags[2], waves[2], threads;
    Correlation<S> kernel;
    const S *places, *at, *whitening, *weights, *offset;  // (B, D), (E, D), (E, F), (F, 2 M + 2), (2 M + 2,)
    const S* pairs;                                       // (2 M M, all lag numbers)
    const S *table[2], *wave[2];                          // (lags, H K), (K, columns); the second absent: no half turn
    const S* square;                                      // (H, W) of the background
    S *image, *unknown;                                   // (B, H, W), (B,)
    explicit ArraySpectrumArgs(const Call& call) : threads(call.threads) {
        Reader in(call);
        in.sizes(samples, axes, anchors, features, elements, height, columns, lags[0], waves[0], lags[1], waves[1]);
        in.read(places, at, whitening, weights, offset, pairs, table[0], wave[0], table[1], wave[1], square, image, unknown);
        kernel = {S(call.numbers[0]), S(call.numbers[1]), {S(call.numbers[2])}, {S(call.numbers[3])}, 1};
    }
};

template <class S> void array_spectrum_of(const ArraySpectrumArgs<S>& a, int sample) {
    constexpr S tiny = S(1e-9);
    const int m = a.elements, padded = whole_lanes<S>(a.anchors), parts = 2 * m + 2;
    Buffer<S> encoded(2 * padded), features(a.features), vector(parts), products(2 * m * m);
    for (int e = 0; e < a.anchors; ++e) encoded[e] = distance(a.places + sample * a.axes, a.at + e * a.axes, a.axes);
    a.kernel.apply(encoded.data, a.anchors, encoded.data + padded);
    combined<S>(encoded.data, a.whitening, a.anchors, a.features, nullptr, features.data);
    combined<S>(features.data, a.weights, a.features, parts, a.offset, vector.data);
    double known = 0;
    for (int f = 0; f < a.features; ++f) known += double(features[f]) * features[f];
    const S share = known > 1 ? S(0) : S(1 - known);
    a.unknown[sample] = share;
    for (int i = 0; i < m; ++i)
        for (int j = 0; j < m; ++j) {
            const S *p = vector.data + 2 * i, *q = vector.data + 2 * j;
            products[2 * (i * m + j)] = p[0] * q[0] + p[1] * q[1];
            products[2 * (i * m + j) + 1] = p[1] * q[0] - p[0] * q[1];
        }
    const int lags = a.lags[0] + a.lags[1], width = a.wave[1] ? 2 * a.columns : a.columns;
    const int64_t sizes[2] = {int64_t(a.height) * a.waves[0], int64_t(a.height) * a.waves[1]};
    Buffer<S> numbers(lags), harmonics(sizes[0] + sizes[1]), row(2 * a.columns);
    combined<S>(products.data, a.pairs, 2 * m * m, lags, nullptr, numbers.data);
    combined<S>(numbers.data, a.table[0], a.lags[0], sizes[0], nullptr, harmonics.data);
    if (a.wave[1]) combined<S>(numbers.data + a.lags[0], a.table[1], a.lags[1], sizes[1], nullptr, harmonics.data + sizes[0]);
    for (int y = 0; y < a.height; ++y) {
        const S* square = a.square + int64_t(y) * width;
        S *stays = row.data, *flips = row.data + a.columns, *out = a.image + (int64_t(sample) * a.height + y) * width;
        combined<S>(harmonics.data + int64_t(y) * a.waves[0], a.wave[0], a.waves[0], a.columns, nullptr, stays);
        if (a.wave[1]) combined<S>(harmonics.data + sizes[0] + int64_t(y) * a.waves[1], a.wave[1], a.waves[1], a.columns, nullptr, flips);
        const auto put = [&](S value, int x) {
            value += share * square[x];
            value = value < tiny ? tiny : value;
            out[x] = sqrt(value > S(1) ? S(1) : value);
        };
        for (int x = 0; x < a.columns; ++x) put(stays[x] + flips[x], x);
        for (int x = a.columns; x < width; ++x) put(stays[x - a.columns] - flips[x - a.columns], x);
    }
}

template <class S> int64_t array_spectrum(const Call& call) {
    const ArraySpectrumArgs<S> a(call);
    auto run = [&](int sample, int) { array_spectrum_of(a, sample); };
    parallel_for(a.samples, a.threads, run);
    return 0;
}

// Of each place: weights of its nearest rows in the mean of a process, and what they take off its variance (Rasmussen and
// Williams 2006, eq. 2.25 and 2.26, of these rows alone).
template <class S> struct NearestArgs {
    int samples, axes, near, threads;
    Correlation<S> kernel;
    const S *queries, *places, *noise;  // (B, D), (n, D), (n,)
    const int64_t* rows;                // (B, k)
    S *weights, *known;                 // (B, k), (B,)
    explicit NearestArgs(const Call& call) : threads(call.threads) {
        Reader in(call);
        const double* v = call.numbers;
        kernel = {S(0), S(1), {S(v[0]), S(v[1])}, {S(v[2]), S(v[3])}, int(v[4])};
        in.sizes(samples, axes, near);
        in.read(queries, places, noise, rows, weights, known);
    }
};

// False where the rows' covariance has no Cholesky factor.
template <class S> bool nearest_weights_of(const NearestArgs<S>& a, int sample) {
    const int k = a.near, stride = whole_lanes<S>(k);
    Buffer<S> lower(int64_t(k) * stride), cross(stride), scratch(stride), white(stride);
    const int64_t* rows = a.rows + int64_t(sample) * k;
    const S* query = a.queries + int64_t(sample) * a.axes;
    for (int i = 0; i < k; ++i) cross[i] = distance(query, a.places + rows[i] * a.axes, a.axes);
    a.kernel.apply(cross.data, k, scratch.data);
    double known = 0;
    for (int i = 0; i < k; ++i) {  // row by row: of L its part left of the diagonal, then the diagonal
        S* own = lower.data + int64_t(i) * stride;
        for (int j = 0; j < i; ++j) own[j] = distance(a.places + rows[i] * a.axes, a.places + rows[j] * a.axes, a.axes);
        a.kernel.apply(own, i, scratch.data);
        for (int j = 0; j < i; ++j) {
            const S* other = lower.data + int64_t(j) * stride;
            own[j] = (own[j] - dot(own, other, j)) / other[j];
        }
        const S left = S(1) + a.noise[rows[i]] - dot(own, own, i);
        if (!(left > 0)) return false;
        own[i] = sqrt(left);
        white[i] = (cross[i] - dot(own, white.data, i)) / own[i];
        known += double(white[i]) * white[i];
    }
    a.known[sample] = S(known);
    S* weights = a.weights + int64_t(sample) * k;
    for (int i = k - 1; i >= 0; --i) {  // L^T weights = white, by columns of L^T
        const S* own = lower.data + int64_t(i) * stride;
        weights[i] = white[i] / own[i];
        for (int j = 0; j < i; ++j) white[j] -= own[j] * weights[i];
    }
    return true;
}

// Returns -1, or the first place whose rows' covariance has no factor.
template <class S> int64_t nearest_weights(const Call& call) {
    const NearestArgs<S> a(call);
    Buffer<bool> failed(a.samples);
    auto run = [&](int sample, int) { failed[sample] = !nearest_weights_of(a, sample); };
    parallel_for(a.samples, a.threads, run);
    for (int sample = 0; sample < a.samples; ++sample)
        if (failed[sample]) return sample;
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

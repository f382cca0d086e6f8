// Answers to single places: an array's spectrum, and what the nearest rows say of a process.
#pragma once
#include <math.h>

#include "kernels.h"
#include "scratch.h"
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
    Vec<S> sums[4] = {};  // one would wait for itself
    int i = 0;
    for (; i + 4 * n <= count; i += 4 * n)
        for (int k = 0; k < 4; ++k) sums[k] = fma(load(a + i + k * n), load(b + i + k * n), sums[k]);
    for (; i + n <= count; i += n) sums[0] = fma(load(a + i), load(b + i), sums[0]);
    S total = sum<S>((sums[0] + sums[1]) + (sums[2] + sums[3]));
    for (; i < count; ++i) total += a[i] * b[i];
    return total;
}

template <class S> inline S distance(const S* a, const S* b, int axes) {
    S squared = 0;
    for (int axis = 0; axis < axes; ++axis) squared += (a[axis] - b[axis]) * (a[axis] - b[axis]);
    return sqrt(squared);
}

// (share of Matern-5/2, its length), then the parts of Matern-3/2, or of Matern-1/2 where a length is negative: distances
// (count,) in place to correlations, padded.
template <class S> struct Correlation {
    S smooth, smooth_length, shares[2], lengths[2];
    int parts;
    void apply(S* values, int count, S* scratch) const {
        constexpr int n = Lanes<S>::n;
        for (int i = 0; i < count; i += n) {
            const Vec<S> far = load(values + i);
            Vec<S> sum = {};
            for (int part = 0; part < parts; ++part) {
                const bool rough = lengths[part] < 0;
                const Vec<S> x = far * S(rough ? -1.0 / lengths[part] : sqrt(3.0) / lengths[part]);
                sum += shares[part] * ((S(1) + S(!rough) * x) * exponential(-x));
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

// Features of a process at places: correlations with anchors, whitened; see processes/features.py.
template <class S> struct Features {
    int axes, anchors, count;
    Correlation<S> kernel;
    const S *at, *whitening;  // (E, D), (E, F)

    // Into `to` (F,); returns the share that they leave unknown. `scratch` has room for twice the anchors in whole lanes.
    S of(const S* place, S* to, S* scratch) const {
        const int padded = whole_lanes<S>(anchors);
        for (int e = 0; e < padded; ++e) scratch[e] = e < anchors ? distance(place, at + e * axes, axes) : S(0);
        kernel.apply(scratch, anchors, scratch + padded);
        combined<S>(scratch, whitening, anchors, count, nullptr, to);
        double known = 0;
        for (int f = 0; f < count; ++f) known += double(to[f]) * to[f];
        return known > 1 ? S(0) : S(1 - known);
    }
};

// Places to spectra of a static array: features of a process, vectors linear in them, lag numbers, harmonics of each row
// of pixels, pixels. See physics/bartlett.py for the tables.
template <class S> struct ArraySpectrumArgs {
    int samples, elements, height, columns, lags[2], waves[2], threads;
    Features<S> process;
    const S *places, *weights, *offset;                   // (B, D), (F, 2 M + 2), (2 M + 2,)
    const S* pairs;                                       // (2 M M, all lag numbers)
    const S *table[2], *wave[2];                          // (lags, H K), (K, columns); the second absent: no half turn
    const S* square;                                      // (H, W) of the background
    S *image, *unknown;                                   // (B, H, W), (B,)
    ArraySpectrumArgs() = default;
    explicit ArraySpectrumArgs(const Call& call) : threads(call.threads) {
        Reader in(call);
        in.sizes(samples, process.axes, process.anchors, process.count, elements, height, columns, lags[0], waves[0], lags[1], waves[1]);
        in.read(places, process.at, process.whitening, weights, offset, pairs, table[0], wave[0], table[1], wave[1], square, image, unknown);
        process.kernel = {S(call.numbers[0]), S(call.numbers[1]), {S(call.numbers[2])}, {S(call.numbers[3])}, 1};
    }
};

template <class S> struct ArraySpectrumMemory {
    S *encoded, *features, *vector, *products, *numbers, *harmonics, *row;
    ArraySpectrumMemory(const ArraySpectrumArgs<S>& a, Scratch& in) {
        encoded = in.take<S>(2 * whole_lanes<S>(a.process.anchors)), features = in.take<S>(a.process.count), vector = in.take<S>(2 * a.elements + 2);
        products = in.take<S>(2 * a.elements * a.elements), numbers = in.take<S>(a.lags[0] + a.lags[1]);
        harmonics = in.take<S>(int64_t(a.height) * (a.waves[0] + a.waves[1])), row = in.take<S>(2 * a.columns);
    }
};

template <class S> void array_spectrum_of(const ArraySpectrumArgs<S>& a, int sample, Scratch scratch) {
    constexpr S tiny = S(1e-9);
    const int m = a.elements, parts = 2 * m + 2;
    const ArraySpectrumMemory<S> own(a, scratch);
    S *const vector = own.vector, *const products = own.products;
    const S share = a.process.of(a.places + int64_t(sample) * a.process.axes, own.features, own.encoded);
    a.unknown[sample] = share;
    combined<S>(own.features, a.weights, a.process.count, parts, a.offset, vector);
    for (int i = 0; i < m; ++i)
        for (int j = 0; j < m; ++j) {
            const S *p = vector + 2 * i, *q = vector + 2 * j;
            products[2 * (i * m + j)] = p[0] * q[0] + p[1] * q[1];
            products[2 * (i * m + j) + 1] = p[1] * q[0] - p[0] * q[1];
        }
    const int width = a.wave[1] ? 2 * a.columns : a.columns;
    const int64_t sizes[2] = {int64_t(a.height) * a.waves[0], int64_t(a.height) * a.waves[1]};
    S *const numbers = own.numbers, *const harmonics = own.harmonics;
    if (!a.wave[1]) for (int x = 0; x < a.columns; ++x) own.row[a.columns + x] = 0;  // nothing flips
    combined<S>(products, a.pairs, 2 * m * m, a.lags[0] + a.lags[1], nullptr, numbers);
    combined<S>(numbers, a.table[0], a.lags[0], sizes[0], nullptr, harmonics);
    if (a.wave[1]) combined<S>(numbers + a.lags[0], a.table[1], a.lags[1], sizes[1], nullptr, harmonics + sizes[0]);
    for (int y = 0; y < a.height; ++y) {
        const S* square = a.square + int64_t(y) * width;
        S *stays = own.row, *flips = own.row + a.columns, *out = a.image + (int64_t(sample) * a.height + y) * width;
        combined<S>(harmonics + int64_t(y) * a.waves[0], a.wave[0], a.waves[0], a.columns, nullptr, stays);
        if (a.wave[1]) combined<S>(harmonics + sizes[0] + int64_t(y) * a.waves[1], a.wave[1], a.waves[1], a.columns, nullptr, flips);
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
    const int64_t bytes = bytes_of<ArraySpectrumMemory<S>>(a);
    Workspace<char> memory(bytes * a.threads);
    auto run = [&](int sample, int worker) { array_spectrum_of(a, sample, Scratch{uintptr_t(memory.data + worker * bytes)}); };
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
    NearestArgs() = default;
    explicit NearestArgs(const Call& call) : threads(call.threads) {
        Reader in(call);
        const double* v = call.numbers;
        kernel = {S(0), S(1), {S(v[0]), S(v[1])}, {S(v[2]), S(v[3])}, int(v[4])};
        in.sizes(samples, axes, near);
        in.read(queries, places, noise, rows, weights, known);
    }
};

template <class S> struct NearestMemory {
    S *lower, *cross, *correlated, *white;
    NearestMemory(const NearestArgs<S>& a, Scratch& in) {
        const int stride = whole_lanes<S>(a.near);
        lower = in.take<S>(int64_t(a.near) * stride), cross = in.take<S>(stride);
        correlated = in.take<S>(stride), white = in.take<S>(stride);
    }
};

// False where the rows' covariance has no Cholesky factor.
template <class S> bool nearest_weights_of(const NearestArgs<S>& a, int sample, Scratch scratch) {
    const int k = a.near, stride = whole_lanes<S>(k);
    const NearestMemory<S> memory(a, scratch);
    S *const cross = memory.cross, *const white = memory.white;
    const int64_t* rows = a.rows + int64_t(sample) * k;
    const S* query = a.queries + int64_t(sample) * a.axes;
    for (int i = k; i < stride; ++i) cross[i] = 0;
    for (int i = 0; i < k; ++i) cross[i] = distance(query, a.places + rows[i] * a.axes, a.axes);
    a.kernel.apply(cross, k, memory.correlated);
    double known = 0;
    for (int i = 0; i < k; ++i) {  // row by row: of L its part left of the diagonal, then the diagonal
        S* own = memory.lower + int64_t(i) * stride;
        for (int j = 0; j < i; ++j) own[j] = distance(a.places + rows[i] * a.axes, a.places + rows[j] * a.axes, a.axes);
        for (int j = i; j < whole_lanes<S>(i); ++j) own[j] = 0;
        a.kernel.apply(own, i, memory.correlated);
        for (int j = 0; j < i; ++j) {
            const S* other = memory.lower + int64_t(j) * stride;
            own[j] = (own[j] - dot(own, other, j)) / other[j];
        }
        const S left = S(1) + a.noise[rows[i]] - dot(own, own, i);
        if (!(left > 0)) return false;
        own[i] = sqrt(left);
        white[i] = (cross[i] - dot(own, white, i)) / own[i];
        known += double(white[i]) * white[i];
    }
    a.known[sample] = S(known);
    S* weights = a.weights + int64_t(sample) * k;
    for (int i = k - 1; i >= 0; --i) {  // L^T weights = white, by columns of L^T
        const S* own = memory.lower + int64_t(i) * stride;
        weights[i] = white[i] / own[i];
        for (int j = 0; j < i; ++j) white[j] -= own[j] * weights[i];
    }
    return true;
}

// Returns -1, or the first place whose rows' covariance has no factor.
template <class S> int64_t nearest_weights(const Call& call) {
    const NearestArgs<S> a(call);
    Buffer<bool> failed(a.samples);
    const int64_t bytes = bytes_of<NearestMemory<S>>(a);
    Workspace<char> memory(bytes * a.threads);
    auto run = [&](int sample, int worker) {
        failed[sample] = !nearest_weights_of(a, sample, Scratch{uintptr_t(memory.data + worker * bytes)});
    };
    parallel_for(a.samples, a.threads, run);
    for (int sample = 0; sample < a.samples; ++sample)
        if (failed[sample]) return sample;
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

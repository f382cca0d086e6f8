// Channels of many antennas and subcarriers from sources with a gain, a steering vector and a delay each:
// H[a, k] = sum_n g_n s_na exp(-j 2 pi f_k tau_n). Subcarriers are the lanes; the phase factors of a source come
// by recurrence from four sines, reduced in float64.
#pragma once
#include <math.h>

#include "simd.h"

namespace gsparc {
namespace GSPARC_ISA {

struct Comb {
    int tones;
    double first, step;  // frequencies [Hz]
};

constexpr int kSourcesAtOnce = 4;

template <class S> inline int padded_tones(int subcarriers) { return (subcarriers + Lanes<S>::n - 1) / Lanes<S>::n * Lanes<S>::n; }

struct Turned {
    double re, im;
    friend Turned operator*(Turned a, Turned b) { return {a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re}; }
};
// exp(-j 2 pi turns) to 1e-15: an eighth of a turn by its series, then quarters. The library's two functions take four
// times as long, which is all there is to do for a single channel.
inline Turned turned(double turns) {
    const double quarters = nearbyint(4 * turns), x = 6.283185307179586 * (turns - 0.25 * quarters), s = x * x;
    double sine = -1.0 / 1307674368000, cosine = 1.0 / 20922789888000;
    constexpr double odd[] = {1.0 / 6227020800, -1.0 / 39916800, 1.0 / 362880, -1.0 / 5040, 1.0 / 120, -1.0 / 6, 1};
    constexpr double even[] = {-1.0 / 87178291200, 1.0 / 479001600, -1.0 / 3628800, 1.0 / 40320, -1.0 / 720, 1.0 / 24, -0.5, 1};
    for (double c : odd) sine = sine * s + c;
    for (double c : even) cosine = cosine * s + c;
    sine *= x;
    const double quarter = quarters - 4 * floor(0.25 * quarters);
    const bool odd_one = quarter == 1 || quarter == 3;
    const double re = odd_one ? -sine : cosine, im = odd_one ? cosine : sine;  // of a turn the other way
    return quarter >= 2 ? Turned{-re, im} : Turned{re, -im};
}

// exp(-j 2 pi (first + k step) delay) for all subcarriers: real parts, then imaginary parts, padded.
template <class S> inline void tones(const Comb& a, double delay, S* out) {
    constexpr int n = Lanes<S>::n;
    const int padded = padded_tones<S>(a.tones);
    Turned lanes[n], step = a.tones > 1 ? turned(a.step * delay) : Turned{1, 0};
    lanes[0] = turned(a.first * delay);
    int filled = 1;
    for (; filled < n && filled < a.tones; filled *= 2, step = step * step)
        for (int k = 0; k < filled; ++k) lanes[filled + k] = lanes[k] * step;
    for (int k = filled; k < n; ++k) lanes[k] = {0, 0};
    for (int k = 0; k < n; ++k) out[k] = S(lanes[k].re), out[padded + k] = S(lanes[k].im);
    const Vec<S> re = splat(S(step.re)), im = splat(S(step.im));  // of n subcarriers
    Vec<S> x = load(out), y = load(out + padded);
    for (int k = n; k < padded; k += n) {
        const Vec<S> before = x;
        x = fma(re, x, -(im * y)), y = fma(re, y, im * before);
        store(out + k, x), store(out + padded + k, y);
    }
}

// Sums over up to kSourcesAtOnce sources: out (A, 2, padded) += weight (A) times tones, both complex.
template <class S> inline void add_sources(int antennas, int padded, const S* tones, const S* weights, S* out) {
    constexpr int n = Lanes<S>::n;
    for (int antenna = 0; antenna < antennas; ++antenna, out += 2 * padded)
        for (int k = 0; k < padded; k += n) {
            Vec<S> re = load(out + k), im = load(out + padded + k);
            for (int source = 0; source < kSourcesAtOnce; ++source) {
                const S* w = weights + 2 * (int64_t(source) * antennas + antenna);
                const Vec<S> x = load(tones + 2 * source * padded + k), y = load(tones + (2 * source + 1) * padded + k);
                re = fma(splat(w[0]), x, re), im = fma(splat(w[0]), y, im);
                re = fma(splat(-w[1]), y, re), im = fma(splat(w[1]), x, im);
            }
            store(out + k, re), store(out + padded + k, im);
        }
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

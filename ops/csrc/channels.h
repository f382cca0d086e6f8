// Channels of many antennas and subcarriers from sources with a gain, a steering vector and a delay each:
// H[a, k] = sum_n g_n s_na exp(-j 2 pi f_k tau_n). Subcarriers are the lanes; the phase factors of a source come
// by recurrence from four sines, reduced in float64.
#pragma once
#include <math.h>

#include "kernels.h"
#include "simd.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct ChannelArgs {
    int samples, count, antennas, subcarriers, threads;
    double first, step;             // frequencies [Hz]
    const S *gains, *steering;      // (B, N, 2), (N, A, 2); complex numbers are pairs
    const double* delays;           // (N,) [s]
    ChannelArgs() = default;
    ChannelArgs(const Call& call, Reader& in) : threads(call.threads), first(call.numbers[0]), step(call.numbers[1]) {
        in.sizes(samples, count, antennas, subcarriers);
        in.read(gains, steering, delays);
    }
};

constexpr int kSourcesAtOnce = 4, kSourceChunks = 16;

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
template <class S> inline void tones(const ChannelArgs<S>& a, double delay, S* out) {
    constexpr int n = Lanes<S>::n;
    const int padded = padded_tones<S>(a.subcarriers);
    Turned lanes[n], step = a.subcarriers > 1 ? turned(a.step * delay) : Turned{1, 0};
    lanes[0] = turned(a.first * delay);
    int filled = 1;
    for (; filled < n && filled < a.subcarriers; filled *= 2, step = step * step)
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

template <class S> int64_t channels(const Call& call) {
    Reader in(call);
    const ChannelArgs<S> a(call, in);
    S* const channels = in.next<S>();  // (B, A, K, 2)
    const int padded = padded_tones<S>(a.subcarriers), antennas = a.antennas;
    const int64_t plane = int64_t(2) * antennas * padded, chunk = (a.count + kSourceChunks - 1) / kSourceChunks;
    const int64_t scratch = int64_t(kSourcesAtOnce) * 2 * (padded + antennas);
    Buffer<S> parts(kSourceChunks * a.samples * plane), memory(scratch * a.threads);
    auto run = [&](int task, int worker) {
        S *phases = memory.data + worker * scratch, *weights = phases + int64_t(kSourcesAtOnce) * 2 * padded;
        const int64_t begin = task * chunk, end = begin + chunk < a.count ? begin + chunk : a.count;
        for (int64_t i = begin; i < end; i += kSourcesAtOnce) {
            const int some = end - i < kSourcesAtOnce ? int(end - i) : kSourcesAtOnce;
            for (int source = 0; source < some; ++source) tones(a, a.delays[i + source], phases + int64_t(2) * source * padded);
            for (int sample = 0; sample < a.samples; ++sample) {
                for (int source = 0; source < kSourcesAtOnce; ++source) {
                    S* w = weights + int64_t(2) * source * antennas;
                    const bool real = source < some;
                    const S* gain = a.gains + 2 * (int64_t(sample) * a.count + i + (real ? source : 0));
                    const S *steer = a.steering + 2 * (i + (real ? source : 0)) * antennas, re = real ? gain[0] : S(0), im = real ? gain[1] : S(0);
                    for (int k = 0; k < antennas; ++k) {
                        w[2 * k] = re * steer[2 * k] - im * steer[2 * k + 1];
                        w[2 * k + 1] = re * steer[2 * k + 1] + im * steer[2 * k];
                    }
                }
                add_sources(antennas, padded, phases, weights, parts.data + (int64_t(task) * a.samples + sample) * plane);
            }
        }
    };
    parallel_for(kSourceChunks, a.threads, run);
    auto gather = [&](int task, int) {
        const int64_t sample = task / antennas, antenna = task % antennas;
        S* out = channels + (sample * antennas + antenna) * a.subcarriers * 2;
        for (int k = 0; k < a.subcarriers; ++k) {
            S re = 0, im = 0;
            for (int part = 0; part < kSourceChunks; ++part) {
                const S* from = parts.data + (int64_t(part) * a.samples + sample) * plane + antenna * 2 * padded + k;
                re += from[0], im += from[padded];
            }
            out[2 * k] = re, out[2 * k + 1] = im;
        }
    };
    parallel_for(a.samples * antennas, a.threads, gather);
    return 0;
}

template <class S> int64_t channels_backward(const Call& call) {
    Reader in(call);
    const ChannelArgs<S> a(call, in);
    const S* upstream;              // (B, A, K, 2)
    S *gains, *steering;
    double* delays;
    in.read(upstream, gains, steering, delays);
    constexpr int n = Lanes<S>::n, chunk = 64;
    const int padded = padded_tones<S>(a.subcarriers), antennas = a.antennas;
    const int64_t rows = int64_t(a.samples) * antennas, scratch = int64_t(2) * padded + 2 * antennas;
    Buffer<S> slopes(rows * 2 * padded), memory(scratch * a.threads), tone(padded);
    for (int k = 0; k < a.subcarriers; ++k) tone[k] = S(k);
    auto split = [&](int row, int) {
        for (int k = 0; k < a.subcarriers; ++k)
            for (int part = 0; part < 2; ++part) slopes[(int64_t(row) * 2 + part) * padded + k] = upstream[(int64_t(row) * a.subcarriers + k) * 2 + part];
    };
    parallel_for(int(rows), a.threads, split);
    auto run = [&](int task, int worker) {
        S *phases = memory.data + worker * scratch, *by_steering = phases + 2 * padded;
        const int64_t begin = int64_t(task) * chunk, end = begin + chunk < a.count ? begin + chunk : a.count;
        for (int64_t i = begin; i < end; ++i) {
            tones(a, a.delays[i], phases);
            fill(by_steering, 2 * antennas, S(0));
            double by_delay = 0;
            for (int sample = 0; sample < a.samples; ++sample) {
                const S* gain = a.gains + 2 * (int64_t(sample) * a.count + i);
                S by_gain[2] = {0, 0};
                for (int antenna = 0; antenna < antennas; ++antenna) {
                    const S* slope = slopes.data + (int64_t(sample) * antennas + antenna) * 2 * padded;
                    // Sums over subcarriers of slope times the conjugate tone, plain and times the subcarrier's number.
                    Vec<S> re = splat(S(0)), im = re, higher_re = re, higher_im = re;
                    for (int k = 0; k < padded; k += n) {
                        const Vec<S> x = load(phases + k), y = load(phases + padded + k), u = load(slope + k), v = load(slope + padded + k);
                        const Vec<S> r = fma(u, x, v * y), m = fma(v, x, -(u * y)), number = load(tone.data + k);
                        re += r, im += m, higher_re = fma(number, r, higher_re), higher_im = fma(number, m, higher_im);
                    }
                    const S r = sum<S>(re), m = sum<S>(im), hr = sum<S>(higher_re), hm = sum<S>(higher_im);
                    const S* steer = a.steering + 2 * (i * antennas + antenna);
                    by_gain[0] += r * steer[0] + m * steer[1], by_gain[1] += m * steer[0] - r * steer[1];
                    by_steering[2 * antenna] += r * gain[0] + m * gain[1], by_steering[2 * antenna + 1] += m * gain[0] - r * gain[1];
                    // d/d tau multiplies tone k by -j 2 pi f_k.
                    const double w_re = double(gain[0]) * steer[0] - double(gain[1]) * steer[1], w_im = double(gain[0]) * steer[1] + double(gain[1]) * steer[0];
                    const double sum_re = a.first * r + a.step * hr, sum_im = a.first * m + a.step * hm;
                    by_delay += 6.283185307179586 * (w_im * sum_re - w_re * sum_im);
                }
                S* to = gains + 2 * (int64_t(sample) * a.count + i);
                to[0] = by_gain[0], to[1] = by_gain[1];
            }
            memcpy(steering + 2 * i * antennas, by_steering, 2 * antennas * sizeof(S));
            delays[i] = by_delay;
        }
    };
    parallel_for(int((a.count + chunk - 1) / chunk), a.threads, run);
    return 0;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// Weighted sums of correlations of waves that come from about each of some directions.
#pragma once
#include <math.h>
#include <string.h>
#include "kernels.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// The phase k d.u of a displacement towards a direction is the difference of one of a row and one of a column.
struct DirectionalArgs {
    int rows, columns, directions, sets, threads;
    double concentration;
    const double *squared, *before, *after;  // (n, m) of (k d)^2, (M, n) and (M, m) phases
    const double* powers;                    // (T, M)
    double* sums;                            // (T, n, m) complex
    explicit DirectionalArgs(const Call& call) : threads(call.threads), concentration(call.numbers[0]) {
        Reader in(call);
        in.sizes(rows, columns, directions, sets);
        in.read(squared, before, after, powers, sums);
    }
};

// 1 / sqrt(x) to the last bits; x of normal size.
GSPARC_INLINE Vec<double> inverse_root(Vec<double> x) {
#if defined(__AVX512F__)
    Vec<double> r = (Vec<double>)_mm512_rsqrt14_pd((__m512d)x);
    for (int i = 0; i < 2; ++i) r = fma(r * 0.5, fma(-x * r, r, splat(1.0)), r);
    return r;
#else
    return 1 / square_root<double>(x);
#endif
}

// Sine and cosine for |x| < 1e8 to 1e-15 (S. Moshier's Cephes: three parts of a half pi, polynomials to a quarter).
GSPARC_INLINE void turn(Vec<double> x, Vec<double>& sine, Vec<double>& cosine) {
    const Vec<double> shifted = x * 0.6366197723675814 + 6755399441055744.0, quarters = shifted - 6755399441055744.0;
    Vec<double> r = fma(quarters, splat(-1.5707962512969971), x);
    r = fma(quarters, splat(-7.549789415861596e-8), r);
    r = fma(quarters, splat(-5.390302858158119e-15), r);
    const Vec<double> z = r * r;
    const double odd[] = {-2.50507477628578072866e-8, 2.75573136213857245213e-6, -1.98412698295895385996e-4,
                          8.33333333332211858878e-3, -1.66666666666666307295e-1};
    const double even[] = {2.08757008419747316778e-9, -2.75573141792967388112e-7, 2.48015872888517045348e-5,
                           -1.38888888888730564116e-3, 4.16666666666665929218e-2};
    Vec<double> s = splat(1.58962301576546568060e-10), c = splat(-1.13585365213876817300e-11);
    for (int i = 0; i < 5; ++i) s = fma(s, z, splat(odd[i])), c = fma(c, z, splat(even[i]));
    s = fma(s * z, r, r), c = fma(c * z, z, 1 - 0.5 * z);
    const Mask<double> crossed = below(splat(0.5), magnitude(quarters - 2 * nearest(quarters * 0.5)));
    const Whole<double> number = (Whole<double>)shifted;
    sine = (Vec<double>)((Whole<double>)select(crossed, c, s) ^ ((number & 2) << 62));
    cosine = (Vec<double>)((Whole<double>)select(crossed, s, c) ^ (((number + 1) & 2) << 62));
}

// c / sinh(c) sinh(z) / z with z^2 = c^2 - squared + 2 j c along, see directional_correlation of gsparc/models/channels/kernels.py.
struct Directional {
    double c, norm;
    explicit Directional(double c) : c(c), norm(c / (1 - exp(-2 * c))) {}
    GSPARC_INLINE void at(Vec<double> squared, Vec<double> along, Vec<double>& real, Vec<double>& imag) const {
        const Vec<double> u = c * c - squared, v = 2 * c * along;
        const Vec<double> inverse = inverse_root(greater<double>(u * u + v * v, splat(1e-48)));  // of the size of z^2
        const Vec<double> half = 0.5 * greater<double>((u * u + v * v) * inverse + magnitude(u), splat(2e-24));
        const Vec<double> root = inverse_root(half), larger = half * root, smaller = 0.5 * v * root;
        const Mask<double> rises = below(splat(0.0), u);
        const Vec<double> a = select(rises, larger, smaller), b = select(rises, smaller, larger);
        const Vec<double> up = exponential(a - c), down = exponential(-a - c);
        Vec<double> sine, cosine;
        turn(b, sine, cosine);
        const Vec<double> x = (up - down) * cosine, y = (up + down) * sine, share = norm * inverse;
        real = fma(x, a, y * b) * share, imag = fma(y, a, -(x * b)) * share;
    }
};

GSPARC_INLINE Vec<double> first_lanes(const double* from, int count) {
    if (count == Lanes<double>::n) return load(from);
    double lanes[Lanes<double>::n] = {};
    memcpy(lanes, from, count * sizeof(double));
    return load(lanes);
}

// One row of all sums; `parts` has room for two vectors of each direction.
inline void directional_row(const DirectionalArgs& a, int row, double* parts) {
    constexpr int n = Lanes<double>::n, together = 4;  // sets whose sums stay in registers
    const Directional wave(a.concentration);
    for (int j = 0; j < a.columns; j += n) {
        const int count = a.columns - j < n ? a.columns - j : n;
        const Vec<double> squared = first_lanes(a.squared + int64_t(row) * a.columns + j, count);
        for (int k = 0; k < a.directions; ++k) {
            const Vec<double> after = first_lanes(a.after + int64_t(k) * a.columns + j, count);
            Vec<double> real, imag;
            wave.at(squared, a.before[int64_t(k) * a.rows + row] - after, real, imag);
            store(parts + 2 * k * n, real), store(parts + (2 * k + 1) * n, imag);
        }
        for (int begin = 0; begin < a.sets; begin += together) {
            const int sets = a.sets - begin < together ? a.sets - begin : together;
            Vec<double> real[together] = {}, imag[together] = {};
            for (int k = 0; k < a.directions; ++k) {
                const Vec<double> x = load(parts + 2 * k * n), y = load(parts + (2 * k + 1) * n);
                for (int t = 0; t < together; ++t) {
                    const int set = begin + (t < sets ? t : 0);
                    const Vec<double> power = splat(a.powers[int64_t(set) * a.directions + k]);
                    real[t] = fma(power, x, real[t]), imag[t] = fma(power, y, imag[t]);
                }
            }
            for (int t = 0; t < sets; ++t) {
                double own[2 * n], *out = a.sums + 2 * ((int64_t(begin + t) * a.rows + row) * a.columns + j);
                store(own, real[t]), store(own + n, imag[t]);
                for (int i = 0; i < count; ++i) out[2 * i] = own[i], out[2 * i + 1] = own[n + i];
            }
        }
    }
}

// In float64 alone.
template <class S> int64_t directional(const Call& call) {
    const DirectionalArgs a(call);
    const int64_t each = 2 * int64_t(a.directions) * Lanes<double>::n;
    Buffer<double> memory(each * a.threads);
    auto run = [&](int row, int worker) { directional_row(a, row, memory.data + worker * each); };
    parallel_for(a.rows, a.threads, run);
    return 0;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

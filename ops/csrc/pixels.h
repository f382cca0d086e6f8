// One footprint on a block of pixels, a lane each: standardised offsets. A record holds
//   tangent:  f1 (3), f2 (3), n (3), reach^2, gain    with tau_i = f_i . u / n . u for a pixel direction u
//   equirect: column, row, sqrt(A), rho, sqrt(B), -, -, -, -, reach^2, gain
#pragma once
#include "footprint.h"

#ifndef GSPARC_LANES
#define GSPARC_LANES "simd.h"  // the CPU's vectors; a GPU thread is a vector of one lane
#endif
#include GSPARC_LANES

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kReach = 9, kGain = 10;

template <class S> GSPARC_HD void write_record(const Footprint<S>& f, S column, S row, S reach, const KernelSettings<S>& settings, S* out) {
    if (settings.tangent) {
        for (int k = 0; k < 3; ++k) {
            out[k] = f.root_a * (f.e1[k] - f.rho * f.e2[k]) * f.stretch2;
            out[3 + k] = f.root_b * f.e2[k] * f.stretch2;
            out[6 + k] = f.n[k];
        }
    } else {
        out[0] = column, out[1] = row, out[2] = f.root_a, out[3] = f.rho, out[4] = f.root_b;
        for (int k = 5; k < 9; ++k) out[k] = S(0);
    }
    out[kReach] = reach, out[kGain] = f.gain, out[11] = S(0);
}

// Per-column and per-row numbers of a grid. Columns are padded with NaN: a lane past the edge passes no test.
template <class S> struct Tables {
    const S *cos_column, *sin_column, *column;  // (width + kLanes)
    const S *cos_row, *sin_row;                 // (height)
    S turn, per_turn;                           // columns in a full circle and its inverse
};

template <class S> GSPARC_HD int64_t table_size(const KernelSettings<S>& settings) { return 3 * int64_t(settings.width + kLanes) + 2 * settings.height; }

// Tables over numbers (table_size) that `fill_tables` has filled.
template <class S> inline Tables<S> tables_at(const KernelSettings<S>& settings, const S* numbers) {
    const int padded = settings.width + kLanes;
    const S turn = settings.periodic ? S(settings.width) : S(6.283185307179586) / settings.azimuth_step;
    return {numbers, numbers + padded, numbers + 2 * padded, numbers + 3 * padded, numbers + 3 * padded + settings.height, turn, 1 / turn};
}

// cos and sin of first + k step for k < count, to 1e-15: some by the library, those between by turning.
template <class S> inline void fill_circle(double first, double step, int count, S* cosines, S* sines) {
    const double c = cos(step), s = sin(step);
    double x = 0, y = 0;
    for (int k = 0; k < count; ++k) {
        const double turned = x * c - y * s;
        y = x * s + y * c, x = turned;
        if (k % 8 == 0) x = cos(first + k * step), y = sin(first + k * step);
        cosines[k] = S(x), sines[k] = S(y);
    }
}

template <class S> inline void fill_tables(const KernelSettings<S>& settings, S* numbers) {
    const int padded = settings.width + kLanes;
    fill_circle(double(settings.first_azimuth), double(settings.azimuth_step), settings.width, numbers, numbers + padded);
    for (int j = 0; j < padded; ++j) {
        if (j >= settings.width) numbers[j] = S(NAN), numbers[padded + j] = S(NAN);
        numbers[2 * padded + j] = j < settings.width ? S(j) : S(NAN);
    }
    fill_circle(double(settings.first_elevation), double(settings.elevation_step), settings.height, numbers + 3 * padded, numbers + 3 * padded + settings.height);
}

// Where a block of pixels lies: a lane each. NaN in a lane beyond the grid.
template <class S> struct Place {
    Vec<S> cos_row, sin_row, row, cos_column, sin_column, column;
};

// A footprint prepared for pixels of given rows. `look` then takes their columns and says which lie inside;
// `form` and `slopes` finish what it left: the squared standardised offset, and the two offsets themselves.
template <class S, bool kTangent> struct RowView;

template <class S> struct RowView<S, true> {
    struct Seen {
        Vec<S> a, b, d, square, d2;
    };
    Vec<S> x1, y1, z1, x2, y2, z2, xn, yn, zn, reach, horizon;

    GSPARC_INLINE RowView(const S* r, const Place<S>& at, const Tables<S>&, const KernelSettings<S>& settings) {
        const Vec<S> c = at.cos_row, s = at.sin_row;
        x1 = r[0] * c, y1 = r[1] * c, z1 = r[2] * s;
        x2 = r[3] * c, y2 = r[4] * c, z2 = r[5] * s;
        xn = r[6] * c, yn = r[7] * c, zn = r[8] * s;
        reach = splat(r[kReach]), horizon = splat(settings.horizon_cosine);
    }
    GSPARC_INLINE Mask<S> look(const Place<S>& at, Seen& seen) const {
        const Vec<S> c = at.cos_column, s = at.sin_column;
        seen.a = fma(x1, c, fma(y1, s, z1)), seen.b = fma(x2, c, fma(y2, s, z2)), seen.d = fma(xn, c, fma(yn, s, zn));
        square(seen);
        return at_most(seen.square, reach * seen.d2) & at_most(horizon, seen.d);
    }
    GSPARC_INLINE void keep(const Seen& seen, bool slopes, S* to) const {
        constexpr int n = Lanes<S>::n;
        store(to, slopes ? seen.a : seen.square), store(to + n, slopes ? seen.b : seen.d2);
        if (slopes) store(to + 2 * n, seen.d);
    }
    GSPARC_INLINE void recall(const S* from, bool slopes, Seen& seen) const {
        constexpr int n = Lanes<S>::n;
        if (!slopes) {
            seen.square = load(from), seen.d2 = load(from + n);
            return;
        }
        seen.a = load(from), seen.b = load(from + n), seen.d = load(from + 2 * n);
        square(seen);
    }
    GSPARC_INLINE Vec<S> form(const Seen& seen) const { return seen.square * reciprocal(seen.d2); }
    GSPARC_INLINE void slopes(const Seen& seen, Vec<S>& tau1, Vec<S>& tau2) const {
        const Vec<S> inverse = seen.d * reciprocal(seen.d2);
        tau1 = seen.a * inverse, tau2 = seen.b * inverse;
    }

private:
    GSPARC_INLINE void square(Seen& seen) const { seen.square = fma(seen.a, seen.a, seen.b * seen.b), seen.d2 = seen.d * seen.d; }
};

template <class S> struct RowView<S, false> {
    struct Seen {
        Vec<S> tau1, form;
    };
    Vec<S> center, root_a, shift, tau2_row, square2, reach, turn, per_turn;

    GSPARC_INLINE RowView(const S* r, const Place<S>& at, const Tables<S>& t, const KernelSettings<S>&) {
        const Vec<S> q = at.row - r[1];
        center = splat(r[0]), root_a = splat(r[2]), shift = r[3] * q, tau2_row = r[4] * q;
        square2 = tau2_row * tau2_row, reach = splat(r[kReach]), turn = splat(t.turn), per_turn = splat(t.per_turn);
    }
    GSPARC_INLINE Mask<S> look(const Place<S>& at, Seen& seen) const {
        const Vec<S> away = at.column - center;
        const Vec<S> p = away - turn * nearest(away * per_turn);  // the nearest image of this column
        seen.tau1 = root_a * (p - shift), seen.form = fma(seen.tau1, seen.tau1, square2);
        return at_most(seen.form, reach);
    }
    GSPARC_INLINE void keep(const Seen& seen, bool slopes, S* to) const { store(to, slopes ? seen.tau1 : seen.form); }
    GSPARC_INLINE void recall(const S* from, bool slopes, Seen& seen) const {
        if (slopes) seen.tau1 = load(from), seen.form = fma(seen.tau1, seen.tau1, square2);
        else seen.form = load(from);
    }
    GSPARC_INLINE Vec<S> form(const Seen& seen) const { return seen.form; }
    GSPARC_INLINE void slopes(const Seen& seen, Vec<S>& tau1, Vec<S>& tau2) const { tau1 = seen.tau1, tau2 = tau2_row; }
};

// A footprint's columns as at most two runs [from, to) of the row; each pixel occurs once, also when blocks of
// columns overhang, because a box within kLanes of the full circle was widened to it.
struct Runs {
    int from[2], to[2], count;
};
GSPARC_INLINE Runs runs_of(const Box& box, int width) {
    const int end = box.column0 + box.columns;
    if (end <= width) return {{box.column0, 0}, {end, 0}, 1};
    return {{box.column0, 0}, {width, end - width}, 2};
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// `equirect`: azimuth and elevation are linear at the Gaussian's direction (the paper); inexact near the pole, where
// sqrt(cos^2 + step^2) stands for the cosine of the elevation. A record holds column, row, sqrt(A), rho, sqrt(B).
#pragma once

namespace gsparc {
namespace GSPARC_ISA {

struct Equirect {
    static constexpr bool kCubic = false, kOpen = false;  // see tangent.h

    template <class S> GSPARC_HD static S bound2(const Footprint<S>& f, const KernelSettings<S>& settings) {
        return f.cosine * f.cosine + settings.elevation_step * settings.elevation_step;
    }
    template <class S> GSPARC_HD static S stretch(const Footprint<S>& f, const KernelSettings<S>& settings) {
        return 1 / (root(bound2(f, settings)) * settings.azimuth_step);
    }
    // On the axis itself azimuth and elevation have no slope; only the area has one.
    template <class S> GSPARC_HD static Truth<S> smooth(const Footprint<S>& f) { return f.cosine > 0; }

    template <class S> GSPARC_HD static void displace(const Footprint<S>& f, const Moments<S>&, S dp, S dq, Truth<S> smooth,
                                                      const KernelSettings<S>& settings, S& g1, S& g2, S* screen) {
        screen[0] = dp, screen[1] = dq;
        g1 = pick(smooth, dp / (f.cosine * settings.azimuth_step), S(0)), g2 = pick(smooth, dq / settings.elevation_step, S(0));
    }
    // East and north turn about n by d1 tan(elevation), and the stretch of the columns depends on it.
    template <class S> GSPARC_HD static void turn(const Footprint<S>& f, S twist, S g_area, S g_stretch1, Truth<S> smooth,
                                                  const KernelSettings<S>& settings, S& g1, S& g2) {
        g1 += pick(smooth, twist * f.n[2] / f.cosine, S(0));
        g_stretch1 += g_area * f.area / f.stretch1;
        g2 += g_stretch1 * f.stretch1 * f.cosine * f.n[2] / bound2(f, settings);
    }

    template <class S> GSPARC_HD static Frame<S> frame(const Footprint<S>& f, S, S column, S row, S reach, const KernelSettings<S>&) {
        const S half = root(reach * f.k22), across = root(reach * f.k11);
        return {row - half, row + half, column - across, column + across};
    }
    template <class S> GSPARC_HD static void write(const Footprint<S>& f, S column, S row, S* record) {
        record[0] = column, record[1] = row, record[2] = f.root_a, record[3] = f.rho, record[4] = f.root_b;
        for (int k = 5; k < 9; ++k) record[k] = S(0);
    }
    template <class S> GSPARC_INLINE static Mask<S> offsets(const S* r, const Place<S>& at, const Tables<S>& t, const KernelSettings<S>&,
                                                            Vec<S>& tau1, Vec<S>& tau2, Vec<S>& form) {
        const Vec<S> q = at.row - r[1], away = at.column - splat(r[0]);
        const Vec<S> p = away - splat(t.turn) * nearest(away * splat(t.per_turn));  // the nearest image of this column
        tau2 = r[4] * q, tau1 = splat(r[2]) * (p - r[3] * q);
        form = fma(tau1, tau1, tau2 * tau2);
        return at_most(form, splat(r[kReach]));
    }

#ifdef GSPARC_PACKS
    // The column is that of the image of the centre that is nearest to the columns up to kSeam; of those behind it the
    // next one is. record[3] becomes -root_a rho.
    static constexpr int kSeam = 5;

    template <class S> static S rise(S, S, int row) { return S(row); }
    template <class S> static void line(Pack<S>* record, S turn_) {
        for (int k = 2; k < 6; ++k) record[k] = record[k] * S(1 / kOffset);
        const Pack<S> turn = turn_, column = record[0] - downward(record[0] / turn) * turn, half = turn * S(0.5);
        const Which<S> low = column < half;
        record[0] = pick(low, column, column - turn), record[kSeam] = pick(low, column + half, column - half);
        record[3] = -record[2] * record[3] * S(kOffset);
    }

    // X counts columns, and nothing bends.
    template <class S> GSPARC_INLINE static Outline<Pack<S>> outline(const Pack<S>* record, Pack<S> reach, const KernelSettings<Pack<S>>&) {
        Outline<Pack<S>> o;
        o.column = record[0], o.middle = record[1], o.stretch = S(1);
        o.height = reach / record[4], o.width = reach / record[2], o.lean = record[3] * o.height;
        o.right = o.lean / root(o.lean * o.lean + o.width * o.width), o.left = -o.right;
        return o;
    }
    template <class S> GSPARC_INLINE static Pack<S> bend(const Outline<Pack<S>>&) { return S(0); }
    template <class S> GSPARC_INLINE static Pack<S> row_end(const Outline<Pack<S>>&, S rise, bool) { return rise; }
    template <class S> GSPARC_INLINE static Pack<S> columns(Pack<S> x, const KernelSettings<Pack<S>>&) { return x; }
    template <class S> GSPARC_INLINE static Pack<S> margin(const KernelSettings<Pack<S>>&) { return S(0.01); }

    template <class S> struct Shape {
        static constexpr int n = Lanes<S>::n;
        struct Seen {
            Vec<S> tau1, form;
        };
        const S* columns;
        Vec<S> column, seam, turn, root_a, shift, tau2, square, inside;

        GSPARC_INLINE Shape(const S* line, const Rises<S>& at, int strip)
            : columns(at.tables.column), column(splat(line[0])), seam(splat(line[kSeam])), turn(splat(at.tables.turn)), root_a(splat(line[2])), inside(splat(line[kReach])) {
            const Vec<S> q = load(at.rise.data + strip * n) - splat(line[1]);
            shift = splat(line[3]) * q, tau2 = splat(line[4]) * q, square = tau2 * tau2;
        }
        GSPARC_INLINE Mask<S> look(int tile, Seen& seen) const {
            const Vec<S> here = spread<S>(columns + tile * kTileColumns<S>), off = here - column;
            seen.tau1 = fma(root_a, select(at_most(here, seam), off, off - turn), shift);  // from the nearest image of the centre
            seen.form = fma(seen.tau1, seen.tau1, square);
            return at_most(seen.form, inside);
        }
        GSPARC_INLINE void slopes(const Seen& seen, Vec<S>& tau1, Vec<S>& tau2_) const { tau1 = seen.tau1, tau2_ = tau2; }
    };
#endif
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

// `tangent`: the footprint lies on the plane touching the sphere at the Gaussian's own direction (gnomonic); no pole.
// A record holds f1 (3), f2 (3), n (3): tau_i = f_i . u / n . u for a pixel direction u.
#pragma once

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct Extent {
    S low, high;
};

// Elevations [rad] that a footprint of tangent half widths (p, q) around elevation >= 0 (with its sine, cosine) can reach:
// a bound, exact upwards. Along p = const the elevation rises with q and then falls, so its least is at an end.
template <class S> GSPARC_HD Extent<S> elevation_extent(S elevation, S sine, S cosine, S p, S q) {
    const S half_turn = S(1.5707963267948966);
    S z[2], across[2];
    for (int k = 0; k < 2; ++k) {
        const S away = k ? q : -q, forward = cosine - away * sine;
        z[k] = sine + away * cosine;
        across[k] = root(pick(z[k] > 0, forward * forward + p * p, forward * forward));
    }
    const Truth<S> first = z[0] * across[1] < z[1] * across[0];  // the lower of the two, without their angles
    const S low = angle(pick(first, z[0], z[1]), pick(first, across[0], across[1])), top = elevation + angle(q, S(1));
    return {pick(low < half_turn, low, half_turn), pick(top < half_turn, top, half_turn)};
}

// Azimuths [rad] relative to the centre that a footprint reaches: tangent lines from the axis.
// a11, a12, a22: covariance times squared reach [rad^2]. Half a turn to each side where it holds the pole.
template <class S> GSPARC_HD Extent<S> azimuth_extent(S sine, S cosine, S a11, S a12, S a22) {
    const S d = cosine * cosine - sine * sine * a22;
    const S pi = S(3.141592653589793);
    const Truth<S> apart = (d > S(1e-4) * cosine * cosine) & (d > 0);
    const S middle = sine * a12, radius = root(middle * middle + a11 * d);
    return {pick(apart, angle(middle - radius, d), -pi), pick(apart, angle(middle + radius, d), pi)};
}

struct Tangent {
    static constexpr bool kCubic = true;  // gradients need the sums of third powers of the offsets
    static constexpr bool kOpen = true;   // near the pole an outline has no closed form

    template <class S> GSPARC_HD static S stretch(const Footprint<S>& f, const KernelSettings<S>&) { return f.stretch2; }
    template <class S> GSPARC_HD static Truth<S> smooth(const Footprint<S>& f) { return f.cosine >= 0; }

    // With the displacement (d1, d2) of n the offsets p and q move by -(d + q (q . d)).
    template <class S> GSPARC_HD static void displace(const Footprint<S>& f, const Moments<S>& m, S dp, S dq, Truth<S>,
                                                      const KernelSettings<S>& settings, S& g1, S& g2, S* screen) {
        const S step = settings.elevation_step;
        const S hq = m.h_tau2 / f.root_b, hp = m.h_tau1 / f.root_a + f.rho * hq;
        g1 = dp / step + hp * step, g2 = dq / step + hq * step;
        screen[0] = g1 * step, screen[1] = g2 * step;
    }
    template <class S> GSPARC_HD static void turn(const Footprint<S>&, S, S, S, Truth<S>, const KernelSettings<S>&, S&, S&) {}

    template <class S> GSPARC_HD static Frame<S> frame(const Footprint<S>& f, S elevation, S column, S, S reach, const KernelSettings<S>& settings) {
        const S unit = reach * settings.elevation_step * settings.elevation_step;
        const S a11 = f.k11 * unit, a12 = f.k12 * unit, a22 = f.k22 * unit;
        const Truth<S> below = f.n[2] < 0;
        const Extent<S> up = elevation_extent(pick(below, -elevation, elevation), pick(below, -f.n[2], f.n[2]), f.cosine, root(a11), root(a22));
        const S bottom = pick(below, -up.high, up.low), top = pick(below, -up.low, up.high);
        const Extent<S> across = azimuth_extent(f.n[2], f.cosine, a11, a12, a22);
        const S per_row = 1 / settings.elevation_step, per_column = 1 / settings.azimuth_step;
        return {(bottom - settings.first_elevation) * per_row, (top - settings.first_elevation) * per_row,
                column + across.low * per_column, column + across.high * per_column};
    }
    template <class S> GSPARC_HD static void write(const Footprint<S>& f, S, S, S* record) {
        for (int k = 0; k < 3; ++k) {
            record[k] = f.root_a * (f.e1[k] - f.rho * f.e2[k]) * f.stretch2;
            record[3 + k] = f.root_b * f.e2[k] * f.stretch2;
            record[6 + k] = f.n[k];
        }
    }
    template <class S> GSPARC_INLINE static Mask<S> offsets(const S* r, const Place<S>& at, const Tables<S>&, const KernelSettings<S>& settings,
                                                            Vec<S>& tau1, Vec<S>& tau2, Vec<S>& form) {
        Vec<S> along[3];
        for (int k = 0; k < 3; ++k) {
            const S* f = r + 3 * k;
            const Vec<S> x = f[0] * at.cos_row, y = f[1] * at.cos_row, z = f[2] * at.sin_row;
            along[k] = fma(x, at.cos_column, fma(y, at.sin_column, z));
        }
        const Vec<S> square = fma(along[0], along[0], along[1] * along[1]), d2 = along[2] * along[2];
        const Vec<S> per_d2 = reciprocal(d2), inverse = along[2] * per_d2;
        tau1 = along[0] * inverse, tau2 = along[1] * inverse, form = square * per_d2;
        return at_most(square, splat(r[kReach]) * d2) & at_most(splat(settings.horizon_cosine), along[2]);
    }

#ifdef GSPARC_PACKS
    template <class S> static S rise(S sine, S cosine, int) { return sine / cosine; }
    template <class S> static void line(Pack<S>* record, S) {
        for (int k = 0; k < 6; ++k) record[k] = record[k] * S(1 / kOffset);
    }

    // X is the tangent of the azimuth and bend = tan(elevation of the centre) height, because q of the tangent plane has
    // shrunk the parallel by cos - q sin.
    template <class S> GSPARC_INLINE static Outline<Pack<S>> outline(const Pack<S>* record, Pack<S> reach, const KernelSettings<Pack<S>>& settings) {
        const Pack<S>*f1 = record, *f2 = record + 3, *n = record + 6, one = S(1);
        const Pack<S> cosine = root(n[0] * n[0] + n[1] * n[1]), per_cosine = one / cosine;
        const Pack<S> a = (n[0] * f1[1] - n[1] * f1[0]) * per_cosine, b = f2[2] * per_cosine;  // f1 . e1 and f2 . e2
        const Pack<S> slant = (n[0] * f1[0] + n[1] * f1[1]) * n[2] * per_cosine - f1[2] * cosine;  // -f1 . e2: a times rho
        const Pack<S> high = reach / b, per_a = one / a;
        Outline<Pack<S>> o;
        o.column = (angle(n[1], n[0]) - settings.first_azimuth) * (one / settings.azimuth_step);
        o.middle = n[2] * per_cosine, o.height = high, o.width = reach * per_a * per_cosine, o.lean = slant * per_a * high * per_cosine;
        const Pack<S> bend = o.middle * high, straight = one - bend * bend;
        const Pack<S> far = root(o.lean * o.lean + o.width * o.width * straight), per_straight = one / straight;
        const Pack<S> most = (o.lean * bend + far) * per_straight, least = (o.lean * bend - far) * per_straight;
        o.right = (o.lean + most * bend) / most, o.left = (o.lean + least * bend) / least;
        const Pack<S> widest = largest_of(most * most, least * least);
        const Which<S> fine = (straight > S(0.03)) & (slant * slant < S(1e6) * a * a) & (widest < S(1e3));
        o.stretch = pick(fine, root(one + widest), -one);
        return o;
    }
    template <class S> GSPARC_INLINE static Pack<S> bend(const Outline<Pack<S>>& o) { return o.middle * o.height; }
    template <class S> GSPARC_INLINE static Pack<S> row_end(const Outline<Pack<S>>& o, S rise, bool outward) { return outward ? o.stretch * rise : Pack<S>(rise); }
    template <class S> GSPARC_INLINE static Pack<S> columns(Pack<S> x, const KernelSettings<Pack<S>>& settings) { return short_angle(x, Pack<S>(S(1))) / settings.azimuth_step; }
    template <class S> GSPARC_INLINE static Pack<S> margin(const KernelSettings<Pack<S>>& settings) { return S(0.01) + S(1e-6) / settings.azimuth_step; }

    // Which of the tiles from `first` on, one a lane, a footprint may reach in the rows of a strip: a bound.
    template <class S> GSPARC_INLINE static unsigned near_tiles(const S* line, const Rises<S>& at, int strip, int first) {
        const Vec<S> c = load(at.tile_cos.data + first), s = load(at.tile_sin.data + first), middle = splat(at.middle.data[strip]);
        const S half = at.half.data[strip];
        Vec<S> offset[3];
        S slack[3];
        for (int k = 0; k < 3; ++k) {
            const S *f = line + 3 * k, x = f[0], y = f[1], z = f[2];
            offset[k] = fma(splat(x), c, fma(splat(y), s, z * middle));
            slack[k] = at.across * root(x * x + y * y) + half * (z < 0 ? -z : z);
        }
        const Vec<S> none = splat(S(0)), p = greater<S>(magnitude(offset[0]) - slack[0], none), q = greater<S>(magnitude(offset[1]) - slack[1], none);
        const Vec<S> most = offset[2] + slack[2];
        return bits_of<S>(at_most(fma(p, p, q * q), splat(line[kReach] * S(1.0001)) * most * most) & at_most(none, most));
    }

    template <class S> struct Shape {  // offsets a / d and b / d
        static constexpr int n = Lanes<S>::n;
        struct Seen {
            Vec<S> a, b, d, form;
        };
        const S *cosines, *sines;
        Vec<S> x1, y1, z1, x2, y2, z2, xn, yn, zn, level, inside;

        GSPARC_INLINE Shape(const S* line, const Rises<S>& at, int strip)
            : cosines(at.tables.cos_column), sines(at.tables.sin_column), x1(splat(line[0])), y1(splat(line[1])), x2(splat(line[3])), y2(splat(line[4])),
              xn(splat(line[6])), yn(splat(line[7])), level(load(at.level.data + strip * n)), inside(splat(line[kReach])) {
            const Vec<S> rise = load(at.rise.data + strip * n);
            z1 = rise * splat(line[2]), z2 = rise * splat(line[5]), zn = rise * splat(line[8]);
        }
        GSPARC_INLINE Mask<S> look(int tile, Seen& seen) const {
            const int column = tile * kTileColumns<S>;
            const Vec<S> c = spread<S>(cosines + column), s = spread<S>(sines + column);
            seen.a = fma(x1, c, fma(y1, s, z1)), seen.b = fma(x2, c, fma(y2, s, z2)), seen.d = fma(xn, c, fma(yn, s, zn));
            seen.form = fma(seen.a, seen.a, seen.b * seen.b) / (seen.d * seen.d);
            return at_most(seen.form, inside) & at_most(level, seen.d);
        }
        GSPARC_INLINE void slopes(const Seen& seen, Vec<S>& tau1, Vec<S>& tau2) const {
            const Vec<S> inverse = reciprocal(seen.d);
            tau1 = seen.a * inverse, tau2 = seen.b * inverse;
        }
    };
#endif
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

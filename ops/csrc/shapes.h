// A footprint before the rows of a strip: what depends on its columns alone, then the pixels of a tile.
#pragma once
#include "lines.h"

namespace gsparc {
namespace GSPARC_ISA {

// kTileColumns numbers, repeated for each row of a tile.
template <class S> GSPARC_INLINE Vec<S> spread(const S* p) {
    S lanes[Lanes<S>::n];
    for (int k = 0; k < Lanes<S>::n; ++k) lanes[k] = p[k % kTileColumns<S>];
    return load(lanes);
}
#if defined(__AVX512F__)
template <> GSPARC_INLINE Vec<float> spread<float>(const float* p) { return (Vec<float>)_mm512_broadcast_f32x4(_mm_loadu_ps(p)); }
template <> GSPARC_INLINE Vec<double> spread<double>(const double* p) { return (Vec<double>)_mm512_broadcast_f64x2(_mm_loadu_pd(p)); }
#elif defined(__AVX2__)
template <> GSPARC_INLINE Vec<float> spread<float>(const float* p) {
    double two;
    memcpy(&two, p, sizeof two);
    return (Vec<float>)_mm256_set1_pd(two);
}
template <> GSPARC_INLINE Vec<double> spread<double>(const double* p) { return (Vec<double>)_mm256_set1_pd(*p); }
#endif

// How a footprint looks to the rows of a strip. `Reach` writes what depends on the column alone, kParts vectors for the
// columns from `first` on, and says which may lie inside in some row: a bound. `look` finishes a tile of them and says
// which pixels do.
template <class S> struct Facet {  // tangent: offsets a / d and b / d
    static constexpr int kParts = 3, n = Lanes<S>::n;
    struct Seen {
        Vec<S> a, b, d, form;
    };
    static GSPARC_INLINE Mask<S> reach(const S* line, const Rises<S>& at, int strip, int first, S* to) {
        const Tables<S>& t = at.tables;
        const Vec<S> middle = splat(at.middle.data[strip]), half = splat(at.half.data[strip]);
        const Vec<S> c = load(t.cos_column + first), s = load(t.sin_column + first), z1 = splat(line[2]), z2 = splat(line[5]), zn = splat(line[8]);
        const Vec<S> a = fma(splat(line[0]), c, splat(line[1]) * s), b = fma(splat(line[3]), c, splat(line[4]) * s), d = fma(splat(line[6]), c, splat(line[7]) * s);
        store(to, a), store(to + n, b), store(to + 2 * n, d);
        const Vec<S> none = splat(S(0)), p = greater<S>(fma(magnitude(z1), -half, magnitude(fma(z1, middle, a))), none);
        const Vec<S> q = greater<S>(fma(magnitude(z2), -half, magnitude(fma(z2, middle, b))), none);
        const Vec<S> most = fma(magnitude(zn), half, fma(zn, middle, d));
        return at_most(fma(p, p, q * q), splat(line[kReach] * S(1.0001)) * most * most) & at_most(none, most);
    }
    Vec<S> rise, level, z1, z2, zn, inside;

    GSPARC_INLINE Facet(const S* line, const Rises<S>& at, int strip)
        : rise(load(at.rise.data + strip * n)), level(load(at.level.data + strip * n)), z1(splat(line[2])), z2(splat(line[5])), zn(splat(line[8])), inside(splat(line[kReach])) {}
    GSPARC_INLINE Mask<S> look(const S* at, Seen& seen) const {
        seen.a = fma(rise, z1, spread<S>(at)), seen.b = fma(rise, z2, spread<S>(at + n)), seen.d = fma(rise, zn, spread<S>(at + 2 * n));
        seen.form = fma(seen.a, seen.a, seen.b * seen.b) / (seen.d * seen.d);
        return at_most(seen.form, inside) & at_most(level, seen.d);
    }
    GSPARC_INLINE void slopes(const Seen& seen, Vec<S>& tau1, Vec<S>& tau2) const {
        const Vec<S> inverse = reciprocal(seen.d);
        tau1 = seen.a * inverse, tau2 = seen.b * inverse;
    }
};

template <class S> struct Ellipse {  // equirect: line[3] is -root_a rho, see Lines
    static constexpr int kParts = 1, n = Lanes<S>::n;
    struct Seen {
        Vec<S> tau1, tau2, form;
    };
    static GSPARC_INLINE Mask<S> reach(const S* line, const Rises<S>& at, int strip, int first, S* to) {
        const Tables<S>& t = at.tables;
        const Vec<S> off = load(t.column + first) - splat(line[0]);
        const Vec<S> a = splat(line[2]) * (off - t.turn * nearest(off * t.per_turn));  // the nearest image of this column
        store(to, a);
        const Vec<S> middle = splat(at.middle.data[strip]) - splat(line[1]), half = splat(at.half.data[strip]), none = splat(S(0));
        const Vec<S> p = greater<S>(fma(magnitude(splat(line[3])), -half, magnitude(fma(splat(line[3]), middle, a))), none);
        const Vec<S> q = splat(line[4]) * greater<S>(magnitude(middle) - half, none);
        return at_most(fma(p, p, q * q), splat(line[kReach] * S(1.0001)));
    }
    Vec<S> rise, row, slant, root_b, inside;

    GSPARC_INLINE Ellipse(const S* line, const Rises<S>& at, int strip)
        : rise(load(at.rise.data + strip * n)), row(splat(line[1])), slant(splat(line[3])), root_b(splat(line[4])), inside(splat(line[kReach])) {}
    GSPARC_INLINE Mask<S> look(const S* at, Seen& seen) const {
        const Vec<S> q = rise - row;
        seen.tau1 = fma(slant, q, spread<S>(at)), seen.tau2 = root_b * q, seen.form = fma(seen.tau1, seen.tau1, seen.tau2 * seen.tau2);
        return at_most(seen.form, inside);
    }
    GSPARC_INLINE void slopes(const Seen& seen, Vec<S>& tau1, Vec<S>& tau2) const { tau1 = seen.tau1, tau2 = seen.tau2; }
};

template <class S, bool kTangent> struct ShapeOf {
    using type = Facet<S>;
};
template <class S> struct ShapeOf<S, false> {
    using type = Ellipse<S>;
};
template <class S, bool kTangent> using Shape = typename ShapeOf<S, kTangent>::type;

}  // namespace GSPARC_ISA
}  // namespace gsparc

// A footprint before the rows of a strip, and then the pixels of a tile.
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

// How a footprint looks to the rows of a strip. `look` finds the offsets of a tile's pixels and says which lie inside.
template <class S> struct Facet {  // tangent: offsets a / d and b / d
    static constexpr int n = Lanes<S>::n;
    struct Seen {
        Vec<S> a, b, d, form;
    };
    const S *cosines, *sines;
    Vec<S> x1, y1, z1, x2, y2, z2, xn, yn, zn, level, inside;

    GSPARC_INLINE Facet(const S* line, const Rises<S>& at, int strip)
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

template <class S> struct Ellipse {  // equirect: line[3] is -root_a rho, see Lines
    static constexpr int n = Lanes<S>::n;
    struct Seen {
        Vec<S> tau1, form;
    };
    const S* columns;
    Vec<S> column, seam, turn, root_a, shift, tau2, square, inside;

    GSPARC_INLINE Ellipse(const S* line, const Rises<S>& at, int strip)
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

// Which of the tiles from `first` on, one a lane, a footprint of `tangent` may reach in the rows of a strip: a bound.
template <class S> GSPARC_INLINE unsigned near_tiles(const S* line, const Rises<S>& at, int strip, int first) {
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

template <class S, bool kTangent> struct ShapeOf {
    using type = Facet<S>;
};
template <class S> struct ShapeOf<S, false> {
    using type = Ellipse<S>;
};
template <class S, bool kTangent> using Shape = typename ShapeOf<S, kTangent>::type;

}  // namespace GSPARC_ISA
}  // namespace gsparc

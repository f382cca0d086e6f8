// Which columns of a strip a footprint may reach, in closed form and for as many footprints at once as there are lanes.
//
// Let v in [-1, 1] be the height within a footprint, from its lowest point to its highest. There its outline lies at
//   X = (lean v +- width sqrt(1 - v^2)) / (1 - bend v)
// from its centre: for `equirect` X counts columns and nothing bends; for `tangent` X is the tangent of the azimuth and
// bend = tan(elevation of the centre) height, because q of the tangent plane has shrunk the parallel by cos - q sin. A row
// of elevation e meets X at v = (tan(e) sqrt(1 + X^2) - middle) / (height + bend tan(e) sqrt(1 + X^2)).
#pragma once
#include "project.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kOutline = 8;  // numbers of an Outline

template <class N> struct Outline {
    N column, middle, height, lean, width;  // of the centre its column and its tangent of elevation (`equirect`: its row)
    N left, right;                          // v where X is least and where it is greatest
    N stretch;                              // sqrt(1 + X^2) at most; negative where no closed form holds: near the pole
};

// The outline of records in lanes, their offsets in any unit; a little larger than life.
template <class S, bool kTangent> GSPARC_INLINE Outline<Pack<S>> outline_of(const Pack<S>* record, const KernelSettings<Pack<S>>& settings) {
    const Pack<S> reach = root(record[kReach]) * S(1.001), one = S(1);
    Outline<Pack<S>> o;
    if (!kTangent) {
        o.column = record[0], o.middle = record[1], o.stretch = one;
        o.height = reach / record[4], o.width = reach / record[2], o.lean = record[3] * o.height;
        o.right = o.lean / root(o.lean * o.lean + o.width * o.width), o.left = -o.right;
        return o;
    }
    const Pack<S>*f1 = record, *f2 = record + 3, *n = record + 6;
    const Pack<S> cosine = root(n[0] * n[0] + n[1] * n[1]), per_cosine = one / cosine;
    const Pack<S> a = (n[0] * f1[1] - n[1] * f1[0]) * per_cosine, b = f2[2] * per_cosine;  // f1 . e1 and f2 . e2
    const Pack<S> slant = (n[0] * f1[0] + n[1] * f1[1]) * n[2] * per_cosine - f1[2] * cosine;  // -f1 . e2: a times rho
    const Pack<S> high = reach / b, per_a = one / a;
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

// Tiles [first, first + count) and, where a footprint goes on past the last column, [0, wrapped), a footprint a lane.
template <class S> struct Spans {
    static constexpr int n = Lanes<S>::n;
    Int<S> first, count, wrapped;
    unsigned open;  // lanes without a closed form: nothing is known of their columns
};

// The columns of outlines at rows whose tangents of elevation (`equirect`: whose numbers) are low to high.
template <class S, bool kTangent> GSPARC_INLINE Spans<S> spans_of(const Outline<Pack<S>>& o, S low, S high, const KernelSettings<Pack<S>>& settings) {
    const Pack<S> none = S(0), one = S(1), bend = kTangent ? o.middle * o.height : none;
    const Pack<S> from = kTangent && low < 0 ? o.stretch * low : Pack<S>(low), to = kTangent && high > 0 ? o.stretch * high : Pack<S>(high);
    const S rounding = sizeof(S) == 4 ? S(4e-7) : S(1e-15);
    const auto size = [](Pack<S> x) { return Pack<S>(magnitude(x.v)); };
    const Pack<S> under = from - o.middle - rounding * (size(from) + size(o.middle)), over = to - o.middle + rounding * (size(to) + size(o.middle));
    const Pack<S> per_low = o.height + bend * from, per_high = o.height + bend * to;  // 0 where a row is a right angle away
    const Pack<S> bottom = pick(per_low > none, under / per_low - S(1e-3), -one), top = pick(per_high > none, over / per_high + S(1e-3), one);
    const auto edge = [&](Pack<S> best, S side) {
        const Pack<S> v = clamped(clamped(best, bottom, top), -one, one);
        return (o.lean * v + side * o.width * root(one - v * v)) / (one - bend * v);
    };
    Pack<S> left = edge(o.left, S(-1)), right = edge(o.right, S(1));
    const Pack<S> margin = kTangent ? S(0.01) + S(1e-6) / settings.azimuth_step : Pack<S>(S(0.01));
    if (kTangent) left = short_angle(left, one) / settings.azimuth_step, right = short_angle(right, one) / settings.azimuth_step;
    Extents<Pack<S>> box;
    const Pack<S> width = S(settings.width);
    set_columns(o.column + left - margin, o.column + right + margin, settings, width, box);
    const Which<S> some = (bottom <= one) & (top >= -one) & (box.columns > none);
    const S per_tile = S(1) / kTileColumns<S>;
    const Pack<S> end = box.column0 + box.columns, inner = pick(end < width, end, width), first = downward(box.column0 * per_tile);
    const auto whole = [&](Pack<S> x) { return __builtin_convertvector(pick(some, x, none).v, Int<S>); };
    return {whole(first), whole(upward(inner * per_tile) - first), whole(largest_of(upward((end - width) * per_tile), none)),
            bits_of<S>((o.stretch < none).lanes)};
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

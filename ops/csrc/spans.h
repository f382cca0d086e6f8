// Which columns of a strip a footprint may reach, in closed form and for as many footprints at once as there are lanes.
//
// Let v in [-1, 1] be the height within a footprint, from its lowest point to its highest. There its outline lies at
//   X = (lean v +- width sqrt(1 - v^2)) / (1 - bend v)
// from its centre, in an X of the projection's own, and a row of rise e (`Rises`) meets X at
//   v = (e stretch - middle) / (height + bend e stretch), where stretch = 1 if nothing bends and else sqrt(1 + X^2).
#pragma once
#include "boxes.h"
#include "rows.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kOutline = 8;  // numbers of an Outline

template <class N> struct Outline {
    N column, middle, height, lean, width;  // of the centre its column and its rise
    N left, right;                          // v where X is least and where it is greatest
    N stretch;                              // sqrt(1 + X^2) at most; negative where no closed form holds: near the pole
};

// Tiles [first, first + count) and, where a footprint goes on past the last column, [0, wrapped), a footprint a lane.
template <class S> struct Spans {
    static constexpr int n = Lanes<S>::n;
    Int<S> first, count, wrapped;
    unsigned open;  // lanes without a closed form: nothing is known of their columns
};

// The columns of outlines at rows whose rises are low to high.
template <class P, class S> GSPARC_INLINE Spans<S> spans_of(const Outline<Pack<S>>& o, S low, S high, const KernelSettings<Pack<S>>& settings) {
    const Pack<S> none = S(0), one = S(1), bend = P::bend(o);
    const Pack<S> from = P::row_end(o, low, low < 0), to = P::row_end(o, high, high > 0);
    const S rounding = sizeof(S) == 4 ? S(4e-7) : S(1e-15);
    const auto size = [](Pack<S> x) { return Pack<S>(magnitude(x.v)); };
    const Pack<S> under = from - o.middle - rounding * (size(from) + size(o.middle)), over = to - o.middle + rounding * (size(to) + size(o.middle));
    const Pack<S> per_low = o.height + bend * from, per_high = o.height + bend * to;  // 0 where a row is a right angle away
    const Pack<S> bottom = pick(per_low > none, under / per_low - S(1e-3), -one), top = pick(per_high > none, over / per_high + S(1e-3), one);
    const auto edge = [&](Pack<S> best, S side) {
        const Pack<S> v = clamped(clamped(best, bottom, top), -one, one);
        return (o.lean * v + side * o.width * root(one - v * v)) / (one - bend * v);
    };
    const Pack<S> left = P::columns(edge(o.left, S(-1)), settings), right = P::columns(edge(o.right, S(1)), settings), margin = P::margin(settings);
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

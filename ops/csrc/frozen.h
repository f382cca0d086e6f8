// A static receiver's weights as blocks of lanes, tile by tile.
#pragma once
#include "forward.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct FreezeArgs : ViewArgs<S> {  // of one pose
    int64_t* starts;                // (strips tiles + 1), first block of each tile; [1:] is counted while ranks is null
    int32_t* ranks;                 // (blocks,)
    S* weights;                     // (blocks, lanes)
    FreezeArgs(const Call& call, Reader& in) : ViewArgs<S>(call, in) { in.read(starts, ranks, weights); }
};

// Counts the blocks of each tile of a strip (ranks null) or writes them, front to back.
template <class P, class S>
void freeze_strip(const FreezeArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch, S* before) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const Vec<S> alpha_max = splat(a.settings.alpha_max), floor = splat(a.settings.transmittance_min);
    const Lights<S> lights = {before, n, floor};
    int64_t* const starts = a.starts + int64_t(task) * stage.tiles;
    Buffer<int64_t> counts(stage.tiles);
    fill(before, int64_t(stage.tiles) * n, S(1));
    const auto visit = [&](const S* line, int rank, const int32_t* hit, const int32_t* end, const Shape<S, P>& shape) __attribute__((always_inline)) {
        const Vec<S> opacity = splat(line[kOpacity]);
        for (; hit < end; ++hit) {
            typename Shape<S, P>::Seen seen;
            const Vec<S> light = load(before + *hit * n);
            const Mask<S> counts_here = shape.look(*hit, seen) & at_most(floor, light);
            if (!any(counts_here)) continue;
            const Layer<S> layer(seen.form, counts_here, opacity, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            store(before + *hit * n, light - weight);
            const int64_t number = counts[*hit]++;
            if (!a.ranks) continue;
            a.ranks[starts[*hit] + number] = rank;
            store(a.weights + (starts[*hit] + number) * n, weight);
        }
    };
    sweep<P>(strip, a.plan, stage, lines, batch, lights, visit);
    for (int tile = 0; !a.ranks && tile < stage.tiles; ++tile) starts[tile + 1] = counts[tile];
}

// Returns the lanes of a block.
template <class S> int64_t freeze(const Call& call) {
    Reader in(call);
    const FreezeArgs<S> a(call, in);
    each_strip<S>(a, nullptr, 0, 0, 1, [&](auto projection, auto, auto&&... strip) {
        freeze_strip<decltype(projection), S>(a, strip...);
    });
    return Lanes<S>::n;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

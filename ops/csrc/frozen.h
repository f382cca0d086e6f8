// A static receiver's weights as blocks of lanes (sparse: rank, tile, weights), and images from them.
#pragma once
#include "forward.h"

namespace gsparc {
namespace GSPARC_ISA {

// Counts the blocks of a strip (heads null) or writes them, in the order in which `composite` visits them.
template <class S, bool kTangent, bool kHides>
void freeze_strip(const FreezeArgs<S>& a, const Ranked<S>& ranked, const TileTables<S>& grid, int task, S* before) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.lens.height, task);
    const Vec<S> alpha_max = splat(a.lens.alpha_max);
    const Lit<S> lit = {before, n, splat(a.lens.transmittance_min)};
    fill(before, int64_t(grid.tiles) * n, S(1));
    int64_t block = a.heads ? a.starts[task] : 0;
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        const S* row = ranked.of(a.plan, strip.pose, *entry);
        const S opacity = row[0], extinction = row[1];
        each_tile<S, kTangent, false>(strip, *entry, grid, a.lens, lit, [&](int tile, Vec<S>, Vec<S>, Vec<S> form, Mask<S> counts) __attribute__((always_inline)) {
            const Vec<S> light = load(before + tile * n);
            const Layer<S, kHides> layer(form, counts, opacity, extinction, alpha_max);
            store(before + tile * n, fma(-light, layer.gamma, light));
            if (a.heads) {
                a.heads[2 * block] = *entry, a.heads[2 * block + 1] = tile;
                store(a.weights + block * n, light * layer.alpha);
            }
            ++block;
        });
    }
    if (!a.heads) a.starts[task + 1] = block;
}

template <class S> int freeze(const FreezeArgs<S>& a) {
    const TileTables<S> grid(a.lens);
    const Ranked<S> ranked(a.plan, a.model, nullptr, 0, 0, a.threads);
    const int64_t area = int64_t(grid.tiles) * Lanes<S>::n;
    Buffer<S> memory(area * a.threads);
    with_switches(a.lens.tangent, a.model.extinctions, 1, [&](auto tangent, auto hides, auto) {
        auto strip = [&](int task, int worker) {
            freeze_strip<S, tangent.value, hides.value>(a, ranked, grid, task, memory.data + worker * area);
        };
        parallel_for(a.plan.strips, a.threads, strip);
    });
    return Lanes<S>::n;
}

template <class S, int kChannels> void thaw_strip(const ThawArgs<S>& a, int task, S* cells) {
    constexpr int n = Lanes<S>::n;
    const int k_count = kChannels ? kChannels : a.channels, cell = k_count * n, row0 = task * kStripRows;
    fill(cells, int64_t(tiles_across<S>(a.width)) * cell, S(0));
    for (int64_t block = a.starts[task]; block < a.starts[task + 1]; ++block) {
        const S* feature = a.features + int64_t(a.heads[2 * block]) * k_count;
        const Vec<S> weight = load(a.weights + block * n);
        S* mine = cells + int64_t(a.heads[2 * block + 1]) * cell;
        for (int k = 0; k < k_count; ++k, mine += n) store(mine, fma(splat(feature[k]), weight, load(mine)));
    }
    Strip<S> strip;
    strip.row0 = row0, strip.row1 = row0 + kStripRows < a.height ? row0 + kStripRows : a.height;
    const int64_t pixels = int64_t(a.height) * a.width;
    each_stretch<S>(strip, a.width, [&](int tile, int lane, int64_t pixel, int count) {
        const S* mine = cells + int64_t(tile) * cell + lane;
        for (int k = 0; k < k_count; ++k) memcpy(a.image + k * pixels + pixel, mine + k * n, count * sizeof(S));
    });
}

template <class S> void thaw(const ThawArgs<S>& a) {
    const int64_t scratch = int64_t(tiles_across<S>(a.width)) * Lanes<S>::n * a.channels;
    Buffer<S> memory(scratch * a.threads);
    with_switches(false, false, a.channels, [&](auto, auto, auto channels) {
        auto strip = [&](int task, int worker) { thaw_strip<S, channels.value>(a, task, memory.data + worker * scratch); };
        parallel_for((a.height + kStripRows - 1) / kStripRows, a.threads, strip);
    });
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// A static receiver's weights as blocks of lanes (sparse: rank, tile, weights), and images from them.
#pragma once
#include "forward.h"

namespace gsparc {
namespace GSPARC_ISA {

// Counts the blocks of a strip (heads null) or writes them, tile by tile and front to back within a tile.
template <class S, bool kTangent, bool kHides>
void freeze_strip(const FreezeArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch, S* before) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const Vec<S> alpha_max = splat(a.settings.alpha_max), floor = splat(a.settings.transmittance_min);
    const Lights<S> lights = {before, n, floor};
    Buffer<int64_t> next(stage.tiles);
    for (int pass = 0; pass < (a.heads ? 2 : 1); ++pass) {  // how many blocks each tile has, then the blocks
        if (pass == 1) {
            int64_t start = a.starts[task];
            for (int tile = 0; tile < stage.tiles; ++tile) {
                const int64_t count = next[tile];
                next[tile] = start, start += count;
            }
        }
        fill(before, int64_t(stage.tiles) * n, S(1));
        const auto visit = [&](const S* line, int rank, const int32_t* hit, const int32_t* end, const Shape<S, kTangent>& shape) __attribute__((always_inline)) {
            const Vec<S> opacity = splat(line[kOpacity]), extinction = splat(line[kExtinction]);
            for (; hit < end; ++hit) {
                typename Shape<S, kTangent>::Seen seen;
                const Vec<S> light = load(before + *hit * n);
                const Mask<S> counts = shape.look(*hit, seen) & at_most(floor, light);
                if (!any(counts)) continue;
                const Layer<S, kHides> layer(seen.form, counts, opacity, extinction, alpha_max);
                const Vec<S> weight = light * layer.alpha;
                store(before + *hit * n, layer.behind(light, weight));
                const int64_t block = next[*hit]++;
                if (pass == 0) continue;
                a.heads[2 * block] = rank, a.heads[2 * block + 1] = *hit;
                store(a.weights + block * n, weight);
            }
        };
        sweep<S, kTangent>(strip, a.plan, stage, lines, batch, lights, visit);
    }
    if (a.heads) return;
    int64_t total = 0;
    for (int tile = 0; tile < stage.tiles; ++tile) total += next[tile];
    a.starts[task + 1] = total;
}

template <class S> int freeze(const FreezeArgs<S>& a) {
    const Rises<S> stage(a.settings);
    const Lines<S> lines(a.plan, a.model, stage, a.settings, nullptr, 0, 0, a.threads);
    const int64_t area = int64_t(stage.tiles) * Lanes<S>::n;
    Buffer<S> memory(area * a.threads, false);
    with_switches(a.settings.tangent, a.model.extinctions, 1, [&](auto tangent, auto hides, auto) {
        Workers<Batch> batches(a.threads, stage.tiles);
        auto strip = [&](int task, int worker) {
            freeze_strip<S, tangent.value, hides.value>(a, lines, stage, task, batches[worker], memory.data + worker * area);
        };
        parallel_for(a.plan.strips, a.threads, strip);
    });
    return Lanes<S>::n;
}

// Channels [first, first + kMany) of the tile whose blocks begin at `block`, up to `past` at most; returns where they end.
// Sums stay in registers.
template <class S, int kMany> GSPARC_INLINE int64_t thaw_channels(const ThawArgs<S>& a, int64_t block, int64_t past, int first, S* cells) {
    constexpr int n = Lanes<S>::n;
    const int32_t tile = a.heads[2 * block + 1];
    Vec<S> sums[kMany] = {};
    for (; block < past && a.heads[2 * block + 1] == tile; ++block) {
        const S* feature = a.features + int64_t(a.heads[2 * block]) * a.channels + first;
        const Vec<S> weight = load(a.weights + block * n);
        for (int k = 0; k < kMany; ++k) sums[k] = fma(splat(feature[k]), weight, sums[k]);
    }
    for (int k = 0; k < kMany; ++k) store(cells + (int64_t(tile) * a.channels + first + k) * n, sums[k]);
    return block;
}

template <class S> void thaw_strip(const ThawArgs<S>& a, int task, S* cells) {
    constexpr int n = Lanes<S>::n, many = 16;
    const int k_count = a.channels, cell = k_count * n, row0 = task * kStripRows;
    fill(cells, int64_t(tiles_across<S>(a.width)) * cell, S(0));
    const int64_t past = a.starts[task + 1];
    for (int64_t block = a.starts[task], end = block; block < past && k_count > 0; block = end) {
        int done = 0;  // all channels of a tile before the next: its weights stay near
        for (; done + many <= k_count; done += many) end = thaw_channels<S, many>(a, block, past, done, cells);
        for (; done + 2 <= k_count; done += 2) end = thaw_channels<S, 2>(a, block, past, done, cells);
        if (done < k_count) end = thaw_channels<S, 1>(a, block, past, done, cells);
    }
    Strip<S> strip;
    strip.row0 = row0, strip.row1 = row0 + kStripRows < a.height ? row0 + kStripRows : a.height;
    const int64_t pixels = int64_t(a.height) * a.width;
    each_stretch<S>(strip, a.width, [&](int tile, int lane, int64_t pixel, int count) {
        const S* mine = cells + int64_t(tile) * cell + lane;
        for (int k = 0; k < k_count; ++k) copy_stretch(a.image + k * pixels + pixel, mine + k * n, count);
    });
}

template <class S> void thaw(const ThawArgs<S>& a) {
    const int64_t scratch = int64_t(tiles_across<S>(a.width)) * Lanes<S>::n * a.channels;
    Buffer<S> memory(scratch * a.threads);
    auto strip = [&](int task, int worker) { thaw_strip<S>(a, task, memory.data + worker * scratch); };
    parallel_for((a.height + kStripRows - 1) / kStripRows, a.threads, strip);
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// A static receiver's weights as blocks of lanes (sparse: rank, tile, weights), and images from them.
#pragma once
#include "forward.h"

namespace gsparc {
namespace GSPARC_ISA {

// Counts the blocks of a strip (heads null) or writes them, tile by tile and front to back within a tile.
template <class S, bool kTangent, bool kHides>
void freeze_strip(const FreezeArgs<S>& a, const Ranked<S>& ranked, const TileTables<S>& grid, int task, S* before) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.lens.height, task);
    const Vec<S> alpha_max = splat(a.lens.alpha_max);
    const Lit<S> lit = {before, n, splat(a.lens.transmittance_min)};
    Buffer<int64_t> next(grid.tiles);
    for (int pass = 0; pass < (a.heads ? 2 : 1); ++pass) {  // how many blocks each tile has, then the blocks
        if (pass == 1) {
            int64_t start = a.starts[task];
            for (int tile = 0; tile < grid.tiles; ++tile) {
                const int64_t count = next[tile];
                next[tile] = start, start += count;
            }
        }
        fill(before, int64_t(grid.tiles) * n, S(1));
        for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
            const S* row = ranked.of(a.plan, strip.pose, *entry);
            const S opacity = row[0], extinction = row[1];
            each_tile<S, kTangent, false>(strip, *entry, grid, a.lens, lit, [&](int tile, Vec<S>, Vec<S>, Vec<S> form, Mask<S> counts) __attribute__((always_inline)) {
                const Vec<S> light = load(before + tile * n);
                const Layer<S, kHides> layer(form, counts, opacity, extinction, alpha_max);
                store(before + tile * n, fma(-light, layer.gamma, light));
                const int64_t block = next[tile]++;
                if (pass == 0) return;
                a.heads[2 * block] = *entry, a.heads[2 * block + 1] = tile;
                store(a.weights + block * n, light * layer.alpha);
            });
        }
    }
    if (a.heads) return;
    int64_t total = 0;
    for (int tile = 0; tile < grid.tiles; ++tile) total += next[tile];
    a.starts[task + 1] = total;
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

// Channels [first, first + kMany) of a strip: sums of a tile stay in registers, because its blocks lie together.
template <class S, int kMany> GSPARC_INLINE void thaw_channels(const ThawArgs<S>& a, int task, int first, S* cells) {
    constexpr int n = Lanes<S>::n;
    int64_t block = a.starts[task];
    const int64_t end = a.starts[task + 1], cell = int64_t(a.channels) * n;
    while (block < end) {
        const int32_t tile = a.heads[2 * block + 1];
        Vec<S> sums[kMany] = {};
        for (; block < end && a.heads[2 * block + 1] == tile; ++block) {
            const S* feature = a.features + int64_t(a.heads[2 * block]) * a.channels + first;
            const Vec<S> weight = load(a.weights + block * n);
            for (int k = 0; k < kMany; ++k) sums[k] = fma(splat(feature[k]), weight, sums[k]);
        }
        for (int k = 0; k < kMany; ++k) store(cells + tile * cell + (first + k) * n, sums[k]);
    }
}

template <class S> void thaw_strip(const ThawArgs<S>& a, int task, S* cells) {
    constexpr int n = Lanes<S>::n, many = 16;
    const int k_count = a.channels, cell = k_count * n, row0 = task * kStripRows;
    fill(cells, int64_t(tiles_across<S>(a.width)) * cell, S(0));
    int done = 0;
    for (; done + many <= k_count; done += many) thaw_channels<S, many>(a, task, done, cells);
    for (; done + 2 <= k_count; done += 2) thaw_channels<S, 2>(a, task, done, cells);
    if (done < k_count) thaw_channels<S, 1>(a, task, done, cells);
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
    auto strip = [&](int task, int worker) { thaw_strip<S>(a, task, memory.data + worker * scratch); };
    parallel_for((a.height + kStripRows - 1) / kStripRows, a.threads, strip);
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

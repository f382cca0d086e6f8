// A static receiver's weights as blocks of lanes (sparse: rank, tile, weights), and images from them.
#pragma once
#include "forward.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct FreezeArgs : ViewArgs<S> {  // of one pose
    int64_t* starts;                // (strips + 1), first block of each strip; [1:] is counted while heads is null
    int32_t* heads;                 // (blocks, 2) rank and tile of the strip
    S* weights;                     // (blocks, lanes)
    FreezeArgs(const Call& call, Reader& in) : ViewArgs<S>(call, in) { in.read(starts, heads, weights); }
};

template <class S> struct ThawArgs {
    int channels, height, width, threads;
    const int64_t* starts;
    const int32_t* heads;
    const S *weights, *features;    // features (V, K) by rank
    S* image;                       // (K, H, W)
    explicit ThawArgs(const Call& call) : threads(call.threads) {
        Reader in(call);
        in.sizes(channels, height, width);
        in.read(starts, heads, weights, features, image);
    }
};

// Counts the blocks of a strip (heads null) or writes them, tile by tile and front to back within a tile.
template <class P, class S, bool kHides>
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
        const auto visit = [&](const S* line, int rank, const int32_t* hit, const int32_t* end, const Shape<S, P>& shape) __attribute__((always_inline)) {
            const Vec<S> opacity = splat(line[kOpacity]), extinction = splat(line[kExtinction]);
            for (; hit < end; ++hit) {
                typename Shape<S, P>::Seen seen;
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
        sweep<P>(strip, a.plan, stage, lines, batch, lights, visit);
    }
    if (a.heads) return;
    int64_t total = 0;
    for (int tile = 0; tile < stage.tiles; ++tile) total += next[tile];
    a.starts[task + 1] = total;
}

// Returns the lanes of a block.
template <class S> int64_t freeze(const Call& call) {
    Reader in(call);
    const FreezeArgs<S> a(call, in);
    each_strip<S>(a, nullptr, 0, 0, 1, [&](auto projection, auto hides, auto, auto&&... strip) {
        freeze_strip<decltype(projection), S, hides.value>(a, strip...);
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

template <class S> int64_t thaw(const Call& call) {
    const ThawArgs<S> a(call);
    const int64_t scratch = int64_t(tiles_across<S>(a.width)) * Lanes<S>::n * a.channels;
    Buffer<S> memory(scratch * a.threads);
    auto strip = [&](int task, int worker) { thaw_strip<S>(a, task, memory.data + worker * scratch); };
    parallel_for(strips_of(a.height), a.threads, strip);
    return 0;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

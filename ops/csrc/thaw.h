// Images from a static receiver's weights, blocks of lanes tile by tile; frozen.h makes them.
#pragma once
#include "finite.h"
#include "simd.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct ThawArgs {
    int channels, height, width, samples, seen, given, threads;
    const int64_t* starts;
    const int32_t* ranks;
    const S *weights, *features;    // features (samples, given, channels)
    const int64_t* rows;            // (seen,) of the features by rank; null: the rank
    S* image;                       // (samples channels, H, W)
    ThawArgs() = default;
    explicit ThawArgs(const Call& call) : threads(call.threads) {
        Reader in(call);
        in.sizes(samples, channels, height, width, seen, given);
        in.read(starts, ranks, weights, features, rows, image);
    }
};

// Channels [first, first + kMany) of the tile whose blocks are [block, past), of features (seen, k_count). Sums stay in
// registers; where they are few, neighbouring blocks have sums of their own: one would wait for the other.
template <class S, int kMany> GSPARC_INLINE void thaw_channels(const ThawArgs<S>& a, const S* features, int k_count, int64_t block, int64_t past, int first, S* cell) {
    constexpr int n = Lanes<S>::n, chains = kMany > 2 ? 1 : 4;
    constexpr int64_t ahead = 8192 / sizeof(Vec<S>);  // blocks: two pages, at whose ends the machine's own prefetching stops
    Vec<S> sums[chains][kMany] = {};
    const auto add = [&](int64_t at, Vec<S>* to) __attribute__((always_inline)) {
        if (first == 0) __builtin_prefetch(a.weights + (at + ahead) * n, 0, 2);  // as far as the second cache
        const S* feature = features + int64_t(a.ranks[at]) * k_count + first;
        const Vec<S> weight = load(a.weights + at * n);
        for (int k = 0; k < kMany; ++k) to[k] = fma(splat(feature[k]), weight, to[k]);
    };
    for (; block + chains <= past; block += chains)
        for (int chain = 0; chain < chains; ++chain) add(block + chain, sums[chain]);
    for (int chain = 0; block < past; ++block, ++chain) add(block, sums[chain]);
    for (int half = chains / 2; half > 0; half /= 2)
        for (int chain = 0; chain < half; ++chain)
            for (int k = 0; k < kMany; ++k) sums[chain][k] += sums[chain + half][k];
    for (int k = 0; k < kMany; ++k) store(cell + (first + k) * n, sums[0][k]);
}

template <class S> void thaw_strip(const ThawArgs<S>& a, const S* features, int k_count, int task, S* cells) {
    constexpr int n = Lanes<S>::n, many = 16;
    const int cell = k_count * n, row0 = task * kStripRows, tiles = tiles_across<S>(a.width);
    for (int tile = 0; tile < tiles; ++tile) {
        const int64_t *at = a.starts + int64_t(task) * tiles + tile, block = at[0], past = at[1];
        S* const mine = cells + int64_t(tile) * cell;
        int done = 0;  // all channels of a tile before the next: its weights stay near
        for (; done + many <= k_count; done += many) thaw_channels<S, many>(a, features, k_count, block, past, done, mine);
        for (; done + 2 <= k_count; done += 2) thaw_channels<S, 2>(a, features, k_count, block, past, done, mine);
        if (done < k_count) thaw_channels<S, 1>(a, features, k_count, block, past, done, mine);
    }
    Strip<S> strip;
    strip.row0 = row0, strip.row1 = row0 + kStripRows < a.height ? row0 + kStripRows : a.height;
    const int64_t pixels = int64_t(a.height) * a.width;
    each_stretch<S>(strip, a.width, [&](int tile, int lane, int64_t pixel, int count) {
        const S* mine = cells + int64_t(tile) * cell + lane;
        for (int k = 0; k < k_count; ++k) copy_stretch(a.image + k * pixels + pixel, mine + k * n, count);
    });
}

// Returns -1, kUnsoundFeatures, or the first rank whose row the features do not have.
template <class S> int64_t thaw(const Call& call) {
    const ThawArgs<S> a(call);
    const int k_count = a.samples * a.channels;
    for (int rank = 0; a.rows && rank < a.seen; ++rank)
        if (a.rows[rank] < 0 || a.rows[rank] >= a.given) return rank;
    const bool as_they_are = !a.rows && a.samples == 1;
    Buffer<S> side_by_side(as_they_are ? 0 : int64_t(a.seen) * k_count, false);  // (seen, samples channels)
    constexpr int chunk = 512;
    auto pick = [&](int task, int) {  // rank by rank: what is written lies together
        for (int rank = task * chunk; rank < a.seen && rank < (task + 1) * chunk; ++rank) {
            S* to = side_by_side.data + int64_t(rank) * k_count;
            const int64_t row = a.rows ? a.rows[rank] : rank;
            for (int sample = 0; sample < a.samples; ++sample)
                for (int k = 0; k < a.channels; ++k) *to++ = a.features[(int64_t(sample) * a.given + row) * a.channels + k];
        }
    };
    if (!as_they_are) parallel_for((a.seen + chunk - 1) / chunk, a.threads, pick);
    const S* features = as_they_are ? a.features : side_by_side.data;
    if (!all_finite(features, int64_t(a.seen) * k_count)) return kUnsoundFeatures;
    const int64_t scratch = int64_t(tiles_across<S>(a.width)) * Lanes<S>::n * k_count;
    Buffer<S> memory(scratch * a.threads, false);
    auto strip = [&](int task, int worker) { thaw_strip<S>(a, features, k_count, task, memory.data + worker * scratch); };
    parallel_for(strips_of(a.height), a.threads, strip);
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

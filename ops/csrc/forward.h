// Front-to-back blending: images, and each Gaussian's weights.
#pragma once
#include "layer.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// No std::integral_constant: nothing of the standard library is compiled per instruction set.
template <class T, T kValue> struct Constant {
    static constexpr T value = kValue;
};

// Calls run(kTangent, kHides, kChannels) with the switches as constants; kChannels 0 stands for any number.
template <class F> inline void with_switches(bool tangent, bool hides, int channels, F run) {
    const auto most = [&](auto t, auto h) {
        if (channels == 1) run(t, h, Constant<int, 1>());
        else if (channels == 2) run(t, h, Constant<int, 2>());
        else run(t, h, Constant<int, 0>());
    };
    const auto some = [&](auto t) { hides ? most(t, Constant<bool, true>()) : most(t, Constant<bool, false>()); };
    tangent ? some(Constant<bool, true>()) : some(Constant<bool, false>());
}

// A cell holds what one tile accumulates: transmittance, then the channels, Lanes<S>::n numbers each.
template <class S, bool kTangent, bool kHides, int kChannels>
void composite_strip(const CompositeArgs<S>& a, const Ranked<S>& ranked, const TileTables<S>& grid, int task, S* cells) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.lens.height, task);
    const int k_count = kChannels ? kChannels : ranked.width - 2, cell = (1 + k_count) * n;
    const Vec<S> alpha_max = splat(a.lens.alpha_max);
    const Lit<S> lit = {cells, cell, splat(a.lens.transmittance_min)};
    fill(cells, int64_t(grid.tiles) * cell, S(0));
    for (int tile = 0; tile < grid.tiles; ++tile) store(cells + int64_t(tile) * cell, splat(S(1)));
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        if ((entry - strip.first) % 64 == 63 && !any_lit(cells, grid.tiles, cell, a.lens.transmittance_min)) break;
        const S* row = ranked.of(a.plan, strip.pose, *entry);
        const S opacity = row[0], extinction = row[1];
        each_tile<S, kTangent, false>(strip, *entry, grid, a.lens, lit, [&](int tile, Vec<S>, Vec<S>, Vec<S> form, Mask<S> counts) __attribute__((always_inline)) {
            S* mine = cells + int64_t(tile) * cell;
            const Vec<S> light = load(mine);
            const Layer<S, kHides> layer(form, counts, opacity, extinction, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            store(mine, fma(-light, layer.gamma, light));
            for (int k = 0; k < k_count; ++k) {
                mine += n;
                store(mine, fma(splat(row[2 + k]), weight, load(mine)));
            }
        });
    }
    const int64_t pixels = int64_t(a.lens.height) * a.lens.width;
    S *image = a.image + strip.pose * k_count * pixels, *transmittance = a.transmittance + strip.pose * pixels;
    each_stretch<S>(strip, a.lens.width, [&](int tile, int lane, int64_t pixel, int count) {
        const S* mine = cells + int64_t(tile) * cell + lane;
        memcpy(transmittance + pixel, mine, count * sizeof(S));
        for (int k = 0; k < k_count; ++k) memcpy(image + k * pixels + pixel, mine + (1 + k) * n, count * sizeof(S));
    });
}

template <class S> void composite(const CompositeArgs<S>& a) {
    const TileTables<S> grid(a.lens);
    const Ranked<S> ranked(a.plan, a.model, a.features, a.samples, a.channels, a.threads);
    const int64_t scratch = int64_t(grid.tiles) * Lanes<S>::n * (ranked.width - 1);
    Buffer<S> memory(scratch * a.threads);
    with_switches(a.lens.tangent, a.model.extinctions, ranked.width - 2, [&](auto tangent, auto hides, auto channels) {
        auto strip = [&](int task, int worker) {
            composite_strip<S, tangent.value, hides.value, channels.value>(a, ranked, grid, task, memory.data + worker * scratch);
        };
        parallel_for(a.plan.poses * a.plan.strips, a.threads, strip);
    });
}

template <class S, bool kTangent, bool kHides>
void weigh_strip(const WeightArgs<S>& a, const Ranked<S>& ranked, const TileTables<S>& grid, int task, S* before, S* sums) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.lens.height, task);
    const Vec<S> floor = splat(a.lens.transmittance_min), alpha_max = splat(a.lens.alpha_max), none = splat(S(0));
    fill(before, int64_t(grid.tiles) * n, S(1));
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        const S* row = ranked.of(a.plan, strip.pose, *entry);
        const S opacity = row[0], extinction = row[1];
        Vec<S> seen = none, total = none;
        each_tile<S, kTangent, false>(strip, *entry, grid, a.lens, Always<S>(), [&](int tile, Vec<S>, Vec<S>, Vec<S> form, Mask<S> inside) __attribute__((always_inline)) {
            S* mine = before + tile * n;
            const Vec<S> light = load(mine);
            const Mask<S> lit = at_most(floor, light);
            const Layer<S, kHides> layer(form, inside, opacity, extinction, alpha_max);
            total += layer.alpha;
            seen += select(lit, light * layer.alpha, none);
            store(mine, select(lit, fma(-light, layer.gamma, light), light));
        });
        S* slot = sums + 2 * strip.slot(*entry);
        slot[0] = sum<S>(seen), slot[1] = sum<S>(total);
    }
}

template <class S> void weights(const WeightArgs<S>& a) {
    const TileTables<S> grid(a.lens);
    const Ranked<S> ranked(a.plan, a.model, nullptr, 0, 0, a.threads);
    const int64_t area = int64_t(grid.tiles) * Lanes<S>::n;
    Buffer<S> memory(area * a.threads), sums(2 * a.plan.strip_starts[a.plan.poses * a.plan.strips]);
    with_switches(a.lens.tangent, a.model.extinctions, 1, [&](auto tangent, auto hides, auto) {
        auto strip = [&](int task, int worker) {
            weigh_strip<S, tangent.value, hides.value>(a, ranked, grid, task, memory.data + worker * area, sums.data);
        };
        parallel_for(a.plan.poses * a.plan.strips, a.threads, strip);
    });
    constexpr int chunk = 1024;
    const int chunks = (a.plan.count + chunk - 1) / chunk;
    auto gather = [&](int task, int) {
        const int pose = task / chunks, begin = task % chunks * chunk;
        const int end = begin + chunk < a.plan.count ? begin + chunk : a.plan.count;
        const int64_t base = int64_t(pose) * a.plan.count;
        const int64_t* slots = a.plan.slots + int64_t(pose) * (a.plan.count + 1);
        for (int rank = begin; rank < end; ++rank) {
            S seen = 0, total = 0;
            for (int64_t slot = slots[rank]; slot < slots[rank + 1]; ++slot) seen += sums[2 * slot], total += sums[2 * slot + 1];
            a.visible_sum[base + a.plan.order[base + rank]] = seen, a.total[base + a.plan.order[base + rank]] = total;
        }
    };
    parallel_for(a.plan.poses * chunks, a.threads, gather);
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// Front-to-back blending: images, and each Gaussian's weights.
#pragma once
#include "layer.h"
#include "sweep.h"

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
void composite_strip(const CompositeArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch, S* cells) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const int k_count = kChannels ? kChannels : channels_of(a), cell = (1 + k_count) * n;
    const Vec<S> alpha_max = splat(a.settings.alpha_max), floor = splat(a.settings.transmittance_min);
    fill(cells, int64_t(stage.tiles) * cell, S(0));
    for (int tile = 0; tile < stage.tiles; ++tile) store(cells + int64_t(tile) * cell, splat(S(1)));
    const Lights<S> lights = {cells, cell, floor};
    const auto visit = [&](const S* line, int, const int32_t* hit, const int32_t* end, const Shape<S, kTangent>& shape) __attribute__((always_inline)) {
        const Vec<S> opacity = splat(line[kOpacity]), extinction = splat(line[kExtinction]);
        Vec<S> feature[kChannels ? kChannels : 1];
        for (int k = 0; k < kChannels; ++k) feature[k] = splat(line[kFeatures + k]);
        for (; hit < end; ++hit) {
            S* mine = cells + int64_t(*hit) * cell;
            typename Shape<S, kTangent>::Seen seen;
            const Vec<S> light = load(mine);
            const Mask<S> counts = shape.look(*hit, seen) & at_most(floor, light);
            const Layer<S, kHides> layer(seen.form, counts, opacity, extinction, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            store(mine, layer.behind(light, weight));
            for (int k = 0; k < k_count; ++k) {
                mine += n;
                store(mine, fma(kChannels ? feature[k] : splat(line[kFeatures + k]), weight, load(mine)));
            }
        }
    };
    sweep<S, kTangent>(strip, a.plan, stage, lines, batch, lights, visit);
    const int64_t pixels = int64_t(a.settings.height) * a.settings.width;
    S *image = a.image + strip.pose * k_count * pixels, *transmittance = a.transmittance + strip.pose * pixels;
    each_stretch<S>(strip, a.settings.width, [&](int tile, int lane, int64_t pixel, int count) {
        const S* mine = cells + int64_t(tile) * cell + lane;
        copy_stretch(transmittance + pixel, mine, count);
        for (int k = 0; k < k_count; ++k) copy_stretch(image + k * pixels + pixel, mine + (1 + k) * n, count);
    });
}

template <class S> void composite(const CompositeArgs<S>& a) {
    const Rises<S> stage(a.settings);
    const Lines<S> lines(a.plan, a.model, stage, a.settings, a.features, a.samples, a.channels, a.threads);
    const int64_t scratch = int64_t(stage.tiles) * Lanes<S>::n * (1 + channels_of(a));
    with_switches(a.settings.tangent, a.model.extinctions, channels_of(a), [&](auto tangent, auto hides, auto channels) {
        Buffer<S> memory(scratch * a.threads, false);
        Workers<Batch> batches(a.threads, stage.tiles);
        auto strip = [&](int task, int worker) {
            composite_strip<S, tangent.value, hides.value, channels.value>(a, lines, stage, task, batches[worker], memory.data + worker * scratch);
        };
        parallel_for(a.plan.poses * a.plan.strips, a.threads, strip);
    });
}

template <class S, bool kTangent, bool kHides>
void weigh_strip(const WeightArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch, S* before, S* sums) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const Vec<S> floor = splat(a.settings.transmittance_min), alpha_max = splat(a.settings.alpha_max), none = splat(S(0));
    fill(before, int64_t(stage.tiles) * n, S(1));
    const auto visit = [&](const S* line, int rank, const int32_t* hit, const int32_t* end, const Shape<S, kTangent>& shape) __attribute__((always_inline)) {
        const Vec<S> opacity = splat(line[kOpacity]), extinction = splat(line[kExtinction]);
        Vec<S> seen_sum = none, total = none;
        for (; hit < end; ++hit) {
            S* mine = before + int64_t(*hit) * n;
            typename Shape<S, kTangent>::Seen seen;
            const Vec<S> light = load(mine);
            const Mask<S> inside = shape.look(*hit, seen), lit = at_most(floor, light);
            const Layer<S, kHides> layer(seen.form, inside, opacity, extinction, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            total += layer.alpha, seen_sum += select(lit, weight, none);
            store(mine, select(lit, layer.behind(light, weight), light));
        }
        S* slot = sums + 2 * strip.slot(rank);
        slot[0] = sum<S>(seen_sum), slot[1] = sum<S>(total);
    };
    sweep<S, kTangent>(strip, a.plan, stage, lines, batch, AllLit(), visit);
}

template <class S> void weights(const WeightArgs<S>& a) {
    const Rises<S> stage(a.settings);
    const Lines<S> lines(a.plan, a.model, stage, a.settings, nullptr, 0, 0, a.threads);
    const int64_t area = int64_t(stage.tiles) * Lanes<S>::n;
    Buffer<S> memory(area * a.threads, false), sums(2 * a.plan.strip_starts[a.plan.poses * a.plan.strips]);
    with_switches(a.settings.tangent, a.model.extinctions, 1, [&](auto tangent, auto hides, auto) {
        Workers<Batch> batches(a.threads, stage.tiles);
        auto strip = [&](int task, int worker) {
            weigh_strip<S, tangent.value, hides.value>(a, lines, stage, task, batches[worker], memory.data + worker * area, sums.data);
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

// Front-to-back blending: images, and each Gaussian's weights.
#pragma once
#include "layer.h"
#include "sweep.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct CompositeArgs : ViewArgs<S> {
    int samples, channels;
    const S* features;              // (B, N, C)
    S *image, *transmittance;       // (B, C, H, W), (P, H, W)
    CompositeArgs(const Call& call, Reader& in) : ViewArgs<S>(call, in) {
        in.sizes(samples, channels);
        in.read(features, image, transmittance);
    }
};

// Channels of one pose: those of all samples where they share it.
template <class S> inline int channels_of(const CompositeArgs<S>& a) { return Lines<S>::per_pose(a.plan, a.samples, a.channels); }

template <class S> struct WeightArgs : ViewArgs<S> {
    S *visible_sum, *total;         // (P, N): sums over pixels of alpha T and alpha
    WeightArgs(const Call& call, Reader& in) : ViewArgs<S>(call, in) { in.read(visible_sum, total); }
};

// No std::integral_constant: nothing of the standard library is compiled per instruction set.
template <int kValue> struct Constant {
    static constexpr int value = kValue;
};

// Calls run(P, kChannels) with both as constants; kChannels 0 stands for any number.
template <class F> inline void with_switches(int projection, int channels, F run) {
    with_projection(projection, [&](auto p) {
        if (channels == 1) run(p, Constant<1>());
        else if (channels == 2) run(p, Constant<2>());
        else run(p, Constant<0>());
    });
}

// Calls run(P, kChannels, lines, stage, task, batch, memory) for every strip of a plan, in parallel. The memory is
// uninitialised: so many `vectors` for each tile, and for one tile more.
template <class S, class F>
void each_strip(const ViewArgs<S>& a, const S* features, int samples, int channels, int vectors, F run) {
    with_switches(a.settings.projection, Lines<S>::per_pose(a.plan, samples, channels), [&](auto projection, auto constant) {
        const Rises<S> stage(projection, a.settings);
        const Lines<S> lines(projection, a.plan, a.model, stage, features, samples, channels, a.threads);
        const int64_t each = int64_t(stage.tiles + 1) * Lanes<S>::n * vectors;
        Buffer<S> memory(each * a.threads, false);
        Workers<Batch> batches(a.threads, stage.tiles);
        auto strip = [&](int task, int worker) { run(projection, constant, lines, stage, task, batches[worker], memory.data + worker * each); };
        parallel_for(a.plan.poses * a.plan.strips, a.threads, strip);
    });
}

// A cell holds what one tile accumulates: transmittance, then the channels, Lanes<S>::n numbers each.
template <class P, class S, int kChannels>
void composite_strip(const CompositeArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch, S* cells) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const int k_count = kChannels ? kChannels : channels_of(a), cell = (1 + k_count) * n;
    const Vec<S> alpha_max = splat(a.settings.alpha_max), floor = splat(a.settings.transmittance_min);
    fill(cells, int64_t(stage.tiles) * cell, S(0));
    for (int tile = 0; tile < stage.tiles; ++tile) store(cells + int64_t(tile) * cell, splat(S(1)));
    const Lights<S> lights = {cells, cell, floor};
    const auto visit = [&](const S* line, int, const int32_t* hit, const int32_t* end, const Shape<S, P>& shape) __attribute__((always_inline)) {
        const Vec<S> opacity = splat(line[kOpacity]);
        Vec<S> feature[kChannels ? kChannels : 1];
        for (int k = 0; k < kChannels; ++k) feature[k] = splat(line[kFeatures + k]);
        for (; hit < end; ++hit) {
            S* mine = cells + int64_t(*hit) * cell;
            typename Shape<S, P>::Seen seen;
            const Vec<S> light = load(mine);
            const Mask<S> counts = shape.look(*hit, seen) & at_most(floor, light);
            const Layer<S> layer(seen.form, counts, opacity, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            store(mine, light - weight);
            for (int k = 0; k < k_count; ++k) {
                mine += n;
                store(mine, fma(kChannels ? feature[k] : splat(line[kFeatures + k]), weight, load(mine)));
            }
        }
    };
    sweep<P>(strip, a.plan, stage, lines, batch, lights, visit);
    const int64_t pixels = int64_t(a.settings.height) * a.settings.width;
    S *image = a.image + strip.pose * k_count * pixels, *transmittance = a.transmittance + strip.pose * pixels;
    each_stretch<S>(strip, a.settings.width, [&](int tile, int lane, int64_t pixel, int count) {
        const S* mine = cells + int64_t(tile) * cell + lane;
        copy_stretch(transmittance + pixel, mine, count);
        for (int k = 0; k < k_count; ++k) copy_stretch(image + k * pixels + pixel, mine + (1 + k) * n, count);
    });
}

template <class S> int64_t composite(const Call& call) {
    Reader in(call);
    const CompositeArgs<S> a(call, in);
    each_strip<S>(a, a.features, a.samples, a.channels, 1 + channels_of(a), [&](auto projection, auto channels, auto&&... strip) {
        composite_strip<decltype(projection), S, channels.value>(a, strip...);
    });
    return 0;
}

template <class P, class S>
void weigh_strip(const WeightArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch, S* before, S* sums) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const Vec<S> floor = splat(a.settings.transmittance_min), alpha_max = splat(a.settings.alpha_max), none = splat(S(0));
    fill(before, int64_t(stage.tiles) * n, S(1));
    const auto visit = [&](const S* line, int rank, const int32_t* hit, const int32_t* end, const Shape<S, P>& shape) __attribute__((always_inline)) {
        const Vec<S> opacity = splat(line[kOpacity]);
        Vec<S> seen_sum = none, total = none;
        for (; hit < end; ++hit) {
            S* mine = before + int64_t(*hit) * n;
            typename Shape<S, P>::Seen seen;
            const Vec<S> light = load(mine);
            const Mask<S> inside = shape.look(*hit, seen), lit = at_most(floor, light);
            const Layer<S> layer(seen.form, inside, opacity, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            total += layer.alpha, seen_sum += select(lit, weight, none);
            store(mine, select(lit, light - weight, light));
        }
        S* slot = sums + 2 * strip.slot(rank);
        slot[0] = sum<S>(seen_sum), slot[1] = sum<S>(total);
    };
    sweep<P>(strip, a.plan, stage, lines, batch, AllLit(), visit);
}

template <class S> int64_t weights(const Call& call) {
    Reader in(call);
    const WeightArgs<S> a(call, in);
    Buffer<S> sums(2 * a.plan.strip_starts[a.plan.poses * a.plan.strips]);
    each_strip<S>(a, nullptr, 0, 0, 1, [&](auto projection, auto, auto&&... strip) {
        weigh_strip<decltype(projection), S>(a, strip..., sums.data);
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
    return 0;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

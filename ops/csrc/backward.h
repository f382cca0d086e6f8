// Gradients, front to back with the forward's own recurrence: what lies behind a layer is the total less what
// came before it, so nothing is divided but 1 / (1 - alpha) <= 100. Each strip leaves its sums in slots of its
// own; they are added per Gaussian in strip order, whoever computed them.
#pragma once
#include "forward.h"
#include "project.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct CompositeBackwardArgs : CompositeArgs<S> {
    const S *grad_image, *grad_transmittance;    // as above; the second may be null
    S *means, *quats, *scales, *opacities, *grad_features, *screen;  // gradients; screen (P, N, 2)
    CompositeBackwardArgs(const Call& call, Reader& in) : CompositeArgs<S>(call, in) {
        in.read(grad_image, grad_transmittance, means, quats, scales, opacities, grad_features, screen);
    }
};

template <class S> struct WeightBackwardArgs : ViewArgs<S> {
    const S *grad_visible_sum, *grad_total;      // (P, N)
    S *means, *quats, *scales, *opacities;
    WeightBackwardArgs(const Call& call, Reader& in) : ViewArgs<S>(call, in) {
        in.read(grad_visible_sum, grad_total, means, quats, scales, opacities);
    }
};

// A cell holds what one tile needs: transmittance, what is still to come, upstream gradient per channel.
template <class P, class S, int kChannels>
void composite_backward_strip(const CompositeBackwardArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch,
                              S* cells, S* moments, S* feature_slots) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const int k_count = kChannels ? kChannels : channels_of(a), cell = (2 + k_count) * n;
    const Vec<S> alpha_max = splat(a.settings.alpha_max), floor = splat(a.settings.transmittance_min);
    S* const sums_memory = cells + int64_t(stage.tiles) * cell;
    const int64_t pixels = int64_t(a.settings.height) * a.settings.width;
    fill(cells, int64_t(stage.tiles) * cell, S(0));
    for (int tile = 0; tile < stage.tiles; ++tile) store(cells + int64_t(tile) * cell, splat(S(1)));
    each_stretch<S>(strip, a.settings.width, [&](int tile, int lane, int64_t pixel, int count) {
        S *behind = cells + int64_t(tile) * cell + n + lane, *g = behind;
        for (int k = 0; k < k_count; ++k) {
            const int64_t at = (int64_t(strip.pose) * k_count + k) * pixels + pixel;
            g += n;
            for (int j = 0; j < count; ++j) g[j] = a.grad_image[at + j], behind[j] += g[j] * a.image[at + j];
        }
        const int64_t at = strip.pose * pixels + pixel;
        if (a.grad_transmittance)
            for (int j = 0; j < count; ++j) behind[j] += a.grad_transmittance[at + j] * a.transmittance[at + j];
    });
    const Lights<S> lights = {cells, cell, floor};
    const auto visit = [&](const S* line, int rank, const int32_t* hit, const int32_t* end, const Shape<S, P>& shape) __attribute__((always_inline)) {
        const Vec<S> opacity = splat(line[kOpacity]);
        Vec<S> feature[kChannels ? kChannels : 1], local[kChannels ? kChannels : 1];
        for (int k = 0; k < kChannels; ++k) feature[k] = splat(line[kFeatures + k]), local[k] = splat(S(0));
        if (!kChannels) fill(sums_memory, int64_t(k_count) * n, S(0));
        MomentSums<S, P> sums;
        for (; hit < end; ++hit) {
            S* mine = cells + int64_t(*hit) * cell;
            typename Shape<S, P>::Seen seen;
            const Vec<S> light = load(mine);
            const Mask<S> counts = shape.look(*hit, seen) & at_most(floor, light);
            const Layer<S> layer(seen.form, counts, opacity, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            Vec<S> gain = splat(S(0));
            for (int k = 0; k < k_count; ++k) {
                const Vec<S> g = load(mine + (2 + k) * n);
                gain = fma(kChannels ? feature[k] : splat(line[kFeatures + k]), g, gain);
                if (kChannels) local[k] = fma(weight, g, local[k]);
                else store(sums_memory + k * n, fma(weight, g, load(sums_memory + k * n)));
            }
            const Vec<S> behind = load(mine + n) - weight * gain;
            store(mine + n, behind);
            store(mine, light - weight);
            const Vec<S> d_alpha = fma(light, gain, -behind * reciprocal(S(1) - layer.alpha));
            Vec<S> t1, t2;
            shape.slopes(seen, t1, t2);
            sums.add(layer, counts, d_alpha, t1, t2, seen.form, alpha_max);
        }
        const int64_t slot = strip.slot(rank);
        sums.write(moments + slot * kMoments, S(kOffset));
        for (int k = 0; k < k_count; ++k) feature_slots[slot * k_count + k] = sum<S>(kChannels ? local[k] : load(sums_memory + k * n));
    };
    sweep<P>(strip, a.plan, stage, lines, batch, lights, visit);
}

// Adds the slots of each Gaussian and chains them into its parameters; poses are added in order.
template <class P, class S, class Args> void chain(const Args& a, const S* moments, S* screen) {
    const PlanView<S>& plan = a.plan;
    const Model<S>& model = a.model;
    Buffer<int32_t> rank_of(int64_t(plan.poses) * plan.count);
    auto invert = [&](int pose, int) {
        const int64_t base = int64_t(pose) * plan.count;
        for (int rank = 0; rank < plan.count; ++rank) rank_of[base + plan.order[base + rank]] = rank;
    };
    parallel_for(plan.poses, a.threads, invert);
    constexpr int chunk = 256, n = Pack<S>::n;
    static_assert(chunk % n == 0, "a chunk is whole lanes");
    const auto wide = in_precision<Pack<S>>(a.settings);
    auto run = [&](int task, int) {
        const int64_t end = int64_t(task + 1) * chunk < plan.count ? int64_t(task + 1) * chunk : plan.count;
        for (int64_t i = int64_t(task) * chunk; i < end; i += n) {
            const int some = end - i < n ? int(end - i) : n;
            const Gaussian<Pack<S>> g = gaussians(model, i, some);
            Pack<S> opacity;
            gather_rows(model.opacities + i, 1, some, &opacity);
            Pack<S> total[11];  // mean, quat, scale, opacity
            for (Pack<S>& t : total) t = S(0);
            for (int pose = 0; pose < plan.poses; ++pose) {
                S sums[kMoments][n] = {}, seen[n] = {};
                bool nothing = true;
                for (int k = 0; k < some; ++k) {
                    const int64_t* slots = plan.slots + int64_t(pose) * (plan.count + 1) + rank_of[int64_t(pose) * plan.count + i + k];
                    if (slots[0] == slots[1]) continue;
                    nothing = false, seen[k] = 1;
                    S m[kMoments] = {};
                    for (int64_t slot = slots[0]; slot < slots[1]; ++slot)
                        for (int c = 0; c < kMoments; ++c) m[c] += moments[slot * kMoments + c];
                    for (int c = 0; c < kMoments; ++c) sums[c][k] = m[c];
                }
                Pack<S> shift[2] = {S(0), S(0)};
                if (!nothing) {
                    const Stand<S> stand(model, pose);
                    const Footprint<Pack<S>> f = project<P>(g, stand.position, stand.rotation, wide);
                    Pack<S> m[kMoments];
                    for (int c = 0; c < kMoments; ++c) m[c] = load(sums[c]);
                    const Gradients<Pack<S>> one = project_backward<P, Pack<S>>(f, {m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7]}, opacity, stand.rotation, wide);
                    const Which<S> counts = Pack<S>(load(seen)) > 0;
                    const Pack<S> none = S(0);
                    for (int k = 0; k < 3; ++k) total[k] += pick(counts, one.mean[k], none), total[7 + k] += pick(counts, one.scale[k], none);
                    for (int k = 0; k < 4; ++k) total[3 + k] += pick(counts, one.quat[k], none);
                    total[10] += pick(counts, one.opacity, none);
                    for (int k = 0; k < 2; ++k) shift[k] = pick(counts, one.screen[k], none);
                }
                if (screen) scatter_rows(shift, 2, some, screen + 2 * (int64_t(pose) * plan.count + i));
            }
            scatter_rows(total, 3, some, a.means + 3 * i);
            scatter_rows(total + 3, 4, some, a.quats + 4 * i);
            scatter_rows(total + 7, 3, some, a.scales + 3 * i);
            scatter_rows(total + 10, 1, some, a.opacities + i);
        }
    };
    parallel_for((plan.count + chunk - 1) / chunk, a.threads, run);
}

template <class S> int64_t composite_backward(const Call& call) {
    Reader in(call);
    const CompositeBackwardArgs<S> a(call, in);
    const PlanView<S>& plan = a.plan;
    const int k_count = channels_of(a);
    const int64_t entries = plan.strip_starts[plan.poses * plan.strips];
    Buffer<S> moments(entries * kMoments), feature_slots(entries * k_count);
    each_strip<S>(a, a.features, a.samples, a.channels, 2 + k_count, [&](auto projection, auto channels, auto&&... strip) {
        composite_backward_strip<decltype(projection), S, channels.value>(a, strip..., moments.data, feature_slots.data);
    });

    constexpr int chunk = 256;
    const int chunks = (plan.count + chunk - 1) / chunk;
    auto gather = [&](int task, int) {
        const int pose = task / chunks, begin = task % chunks * chunk, end = begin + chunk < plan.count ? begin + chunk : plan.count;
        const int64_t* slots = plan.slots + int64_t(pose) * (plan.count + 1);
        const int first = plan.poses == 1 ? 0 : pose;
        for (int rank = begin; rank < end; ++rank) {
            const int64_t i = plan.order[int64_t(pose) * plan.count + rank];
            for (int k = 0; k < k_count; ++k) {
                S total = 0;
                for (int64_t slot = slots[rank]; slot < slots[rank + 1]; ++slot) total += feature_slots[slot * k_count + k];
                a.grad_features[(int64_t(first + k / a.channels) * plan.count + i) * a.channels + k % a.channels] = total;
            }
        }
    };
    if (k_count > 0) parallel_for(plan.poses * chunks, a.threads, gather);
    with_projection(a.settings.projection, [&](auto projection) { chain<decltype(projection)>(a, moments.data, a.screen); });
    return 0;
}

template <class P, class S>
void weigh_backward_strip(const WeightBackwardArgs<S>& a, const Lines<S>& lines, const Rises<S>& stage, int task, Batch& batch, S* cells,
                          S* moments) {
    constexpr int n = Lanes<S>::n;
    const Strip<S> strip(a.plan, a.settings.height, task);
    const Vec<S> floor = splat(a.settings.transmittance_min), alpha_max = splat(a.settings.alpha_max), none = splat(S(0));
    fill(cells, int64_t(stage.tiles) * 2 * n, S(0));
    for (int pass = 0; pass < 2; ++pass) {  // first what each pixel holds in all, then the gradients
        for (int tile = 0; tile < stage.tiles; ++tile) store(cells + int64_t(tile) * 2 * n, splat(S(1)));
        const auto visit = [&](const S* line, int rank, const int32_t* hit, const int32_t* end, const Shape<S, P>& shape) __attribute__((always_inline)) {
            const Vec<S> opacity = splat(line[kOpacity]);
            const Vec<S> per_seen = splat(line[kFeatures]), per_alpha = splat(line[kFeatures + 1]);
            MomentSums<S, P> sums;
            for (; hit < end; ++hit) {
                S* mine = cells + int64_t(*hit) * 2 * n;
                typename Shape<S, P>::Seen seen;
                const Vec<S> light = load(mine);
                const Mask<S> inside = shape.look(*hit, seen), lit = at_most(floor, light);
                const Layer<S> layer(seen.form, inside, opacity, alpha_max);
                const Vec<S> gain = select(lit, per_seen, none), weight = light * layer.alpha, part = weight * gain;
                store(mine, select(lit, light - weight, light));
                if (pass == 0) {
                    store(mine + n, load(mine + n) + part);
                    continue;
                }
                const Vec<S> rest = load(mine + n) - part;
                store(mine + n, rest);
                const Vec<S> d_alpha = fma(light, gain, per_alpha) + select(lit, -rest * reciprocal(S(1) - layer.alpha), none);
                Vec<S> t1, t2;
                shape.slopes(seen, t1, t2);
                sums.add(layer, inside, d_alpha, t1, t2, seen.form, alpha_max);
            }
            if (pass == 1) sums.write(moments + strip.slot(rank) * kMoments, S(kOffset));
        };
        sweep<P>(strip, a.plan, stage, lines, batch, AllLit(), visit);
    }
}

template <class S> int64_t weights_backward(const Call& call) {
    Reader in(call);
    const WeightBackwardArgs<S> a(call, in);
    const PlanView<S>& plan = a.plan;
    const int64_t all = int64_t(plan.poses) * plan.count;
    Buffer<S> upstream(2 * all, false);
    for (int64_t i = 0; i < all; ++i) upstream[2 * i] = a.grad_visible_sum[i], upstream[2 * i + 1] = a.grad_total[i];
    Buffer<S> moments(plan.strip_starts[plan.poses * plan.strips] * kMoments);
    each_strip<S>(a, upstream.data, 1, 2, 2, [&](auto projection, auto, auto&&... strip) {
        weigh_backward_strip<decltype(projection), S>(a, strip..., moments.data);
    });
    with_projection(a.settings.projection, [&](auto projection) { chain<decltype(projection)>(a, moments.data, static_cast<S*>(nullptr)); });
    return 0;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

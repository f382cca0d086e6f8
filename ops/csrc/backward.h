// Gradients, front to back with the forward's own recurrence: what lies behind a layer is the total less what
// came before it, so nothing is divided but 1 / (1 - gamma) <= 100. Each strip leaves its sums in slots of its
// own; they are added per Gaussian in strip order, whoever computed them.
#pragma once
#include "forward.h"
#include "project.h"

namespace gsparc {
namespace GSPARC_ISA {

// A cell holds what one tile needs: transmittance, what is still to come, upstream gradient per channel.
template <class S, bool kTangent, bool kHides, int kChannels>
void composite_backward_strip(const CompositeBackwardArgs<S>& b, const Ranked<S>& ranked, const TileTables<S>& grid, int task,
                              S* cells, S* sums_memory, S* moments, S* feature_slots) {
    constexpr int n = Lanes<S>::n;
    const CompositeArgs<S>& a = b.forward;
    const Strip<S> strip(a.plan, a.lens.height, task);
    const int k_count = kChannels ? kChannels : ranked.width - 2, cell = (2 + k_count) * n;
    const Vec<S> alpha_max = splat(a.lens.alpha_max);
    const Lit<S> lit = {cells, cell, splat(a.lens.transmittance_min)};
    const int64_t pixels = int64_t(a.lens.height) * a.lens.width;
    fill(cells, int64_t(grid.tiles) * cell, S(0));
    for (int tile = 0; tile < grid.tiles; ++tile) store(cells + int64_t(tile) * cell, splat(S(1)));
    each_stretch<S>(strip, a.lens.width, [&](int tile, int lane, int64_t pixel, int count) {
        S *behind = cells + int64_t(tile) * cell + n + lane, *g = behind;
        for (int k = 0; k < k_count; ++k) {
            const int64_t at = (int64_t(strip.pose) * k_count + k) * pixels + pixel;
            g += n;
            for (int j = 0; j < count; ++j) g[j] = b.grad_image[at + j], behind[j] += g[j] * a.image[at + j];
        }
        const int64_t at = strip.pose * pixels + pixel;
        if (b.grad_transmittance)
            for (int j = 0; j < count; ++j) behind[j] += b.grad_transmittance[at + j] * a.transmittance[at + j];
    });
    Vec<S> local[kChannels ? kChannels : 1];
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        if ((entry - strip.first) % 64 == 63 && !any_lit(cells, grid.tiles, cell, a.lens.transmittance_min)) break;
        const S* row = ranked.of(a.plan, strip.pose, *entry);
        const S opacity = row[0], extinction = row[1];
        MomentSums<S, kTangent, kHides> sums;
        if (kChannels)
            for (int k = 0; k < kChannels; ++k) local[k] = splat(S(0));
        else fill(sums_memory, int64_t(k_count) * n, S(0));
        each_tile<S, kTangent, true>(strip, *entry, grid, a.lens, lit, [&](int tile, Vec<S> t1, Vec<S> t2, Vec<S> form, Mask<S> counts) __attribute__((always_inline)) {
            S* mine = cells + int64_t(tile) * cell;
            const Vec<S> light = load(mine);
            const Layer<S, kHides> layer(form, counts, opacity, extinction, alpha_max);
            const Vec<S> weight = light * layer.alpha, through = S(1) - layer.gamma;
            Vec<S> gain = splat(S(0));
            for (int k = 0; k < k_count; ++k) {
                const Vec<S> g = load(mine + (2 + k) * n);
                gain = fma(splat(row[2 + k]), g, gain);
                if (kChannels) local[k] = fma(weight, g, local[k]);
                else store(sums_memory + k * n, fma(weight, g, load(sums_memory + k * n)));
            }
            const Vec<S> behind = load(mine + n) - weight * gain;
            store(mine + n, behind);
            store(mine, fma(-light, layer.gamma, light));
            const Vec<S> d_gamma = -behind * reciprocal(through);
            sums.add(layer, counts, kHides ? light * gain : fma(light, gain, d_gamma), d_gamma, t1, t2, form, alpha_max);
        });
        const int64_t slot = strip.slot(*entry);
        sums.write(moments + slot * kMoments);
        for (int k = 0; k < k_count; ++k) feature_slots[slot * k_count + k] = sum<S>(kChannels ? local[k] : load(sums_memory + k * n));
    }
}

// Adds the slots of each Gaussian and chains them into its parameters; poses are added in order.
template <class S>
void chain(const PlanView<S>& plan, const Model<S>& model, const Lens<S>& lens, int threads, const S* moments, S* means, S* quats,
           S* scales, S* opacities, S* extinctions, S* screen) {
    Buffer<int32_t> rank_of(int64_t(plan.poses) * plan.count);
    auto invert = [&](int pose, int) {
        const int64_t base = int64_t(pose) * plan.count;
        for (int rank = 0; rank < plan.count; ++rank) rank_of[base + plan.order[base + rank]] = rank;
    };
    parallel_for(plan.poses, threads, invert);
    constexpr int chunk = 256, n = Pack<S>::n;
    static_assert(chunk % n == 0, "a chunk is whole lanes");
    const Lens<Pack<S>> wide = widened(lens);
    auto run = [&](int task, int) {
        const int64_t end = int64_t(task + 1) * chunk < plan.count ? int64_t(task + 1) * chunk : plan.count;
        for (int64_t i = int64_t(task) * chunk; i < end; i += n) {
            const int some = end - i < n ? int(end - i) : n;
            const Gaussian<Pack<S>> g = gaussians(model, i, some);
            Pack<S> opacity, extinction = S(0);
            gather_rows(model.opacities + i, 1, some, &opacity);
            if (model.extinctions) gather_rows(model.extinctions + i, 1, some, &extinction);
            Pack<S> total[12];  // mean, quat, scale, opacity, extinction
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
                    const Footprint<Pack<S>> f = project(g, stand.position, stand.rotation, wide);
                    Pack<S> m[kMoments];
                    for (int c = 0; c < kMoments; ++c) m[c] = load(sums[c]);
                    const Gradients<Pack<S>> one = project_backward<Pack<S>>(f, {m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8]},
                                                                             opacity, extinction, stand.rotation, wide);
                    const Which<S> counts = Pack<S>(load(seen)) > 0;
                    const Pack<S> none = S(0);
                    for (int k = 0; k < 3; ++k) total[k] += pick(counts, one.mean[k], none), total[7 + k] += pick(counts, one.scale[k], none);
                    for (int k = 0; k < 4; ++k) total[3 + k] += pick(counts, one.quat[k], none);
                    total[10] += pick(counts, one.opacity, none), total[11] += pick(counts, one.extinction, none);
                    for (int k = 0; k < 2; ++k) shift[k] = pick(counts, one.screen[k], none);
                }
                if (screen) scatter_rows(shift, 2, some, screen + 2 * (int64_t(pose) * plan.count + i));
            }
            scatter_rows(total, 3, some, means + 3 * i);
            scatter_rows(total + 3, 4, some, quats + 4 * i);
            scatter_rows(total + 7, 3, some, scales + 3 * i);
            scatter_rows(total + 10, 1, some, opacities + i);
            if (extinctions) scatter_rows(total + 11, 1, some, extinctions + i);
        }
    };
    parallel_for((plan.count + chunk - 1) / chunk, threads, run);
}

template <class S> void composite_backward(const CompositeBackwardArgs<S>& b) {
    const CompositeArgs<S>& a = b.forward;
    const PlanView<S>& plan = a.plan;
    const TileTables<S> grid(a.lens);
    const Ranked<S> ranked(plan, a.model, a.features, a.samples, a.channels, a.threads);
    const int k_count = ranked.width - 2;
    const int64_t area = int64_t(grid.tiles) * Lanes<S>::n * (2 + k_count), scratch = area + int64_t(k_count) * Lanes<S>::n;
    const int64_t entries = plan.strip_starts[plan.poses * plan.strips];
    Buffer<S> memory(scratch * a.threads), moments(entries * kMoments), feature_slots(entries * k_count);
    with_switches(a.lens.tangent, a.model.extinctions, k_count, [&](auto tangent, auto hides, auto channels) {
        auto strip = [&](int task, int worker) {
            S* mine = memory.data + worker * scratch;
            composite_backward_strip<S, tangent.value, hides.value, channels.value>(b, ranked, grid, task, mine, mine + area, moments.data, feature_slots.data);
        };
        parallel_for(plan.poses * plan.strips, a.threads, strip);
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
                b.features[(int64_t(first + k / a.channels) * plan.count + i) * a.channels + k % a.channels] = total;
            }
        }
    };
    if (k_count > 0) parallel_for(plan.poses * chunks, a.threads, gather);
    chain(plan, a.model, a.lens, a.threads, moments.data, b.means, b.quats, b.scales, b.opacities, b.extinctions, b.screen);
}

template <class S, bool kTangent, bool kHides>
void weigh_backward_strip(const WeightBackwardArgs<S>& b, const Ranked<S>& ranked, const TileTables<S>& grid, int task, S* cells,
                          S* moments) {
    constexpr int n = Lanes<S>::n;
    const WeightArgs<S>& a = b.forward;
    const Strip<S> strip(a.plan, a.lens.height, task);
    const Vec<S> floor = splat(a.lens.transmittance_min), alpha_max = splat(a.lens.alpha_max), none = splat(S(0));
    fill(cells, int64_t(grid.tiles) * 2 * n, S(0));
    for (int pass = 0; pass < 2; ++pass) {  // first what each pixel holds in all, then the gradients
        for (int tile = 0; tile < grid.tiles; ++tile) store(cells + int64_t(tile) * 2 * n, splat(S(1)));
        for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
            const S* row = ranked.of(a.plan, strip.pose, *entry);
            const S opacity = row[0], extinction = row[1];
            const Vec<S> per_seen = splat(row[2]), per_alpha = splat(row[3]);
            MomentSums<S, kTangent, kHides> sums;
            each_tile<S, kTangent, true>(strip, *entry, grid, a.lens, Always<S>(), [&](int tile, Vec<S> t1, Vec<S> t2, Vec<S> form, Mask<S> inside) __attribute__((always_inline)) {
                S* mine = cells + int64_t(tile) * 2 * n;
                const Vec<S> light = load(mine);
                const Mask<S> lit = at_most(floor, light);
                const Layer<S, kHides> layer(form, inside, opacity, extinction, alpha_max);
                const Vec<S> gain = select(lit, per_seen, none), through = S(1) - layer.gamma;
                const Vec<S> part = light * layer.alpha * gain;
                store(mine, select(lit, fma(-light, layer.gamma, light), light));
                if (pass == 0) {
                    store(mine + n, load(mine + n) + part);
                    return;
                }
                const Vec<S> rest = load(mine + n) - part;
                store(mine + n, rest);
                const Vec<S> d_alpha = fma(light, gain, per_alpha), d_gamma = select(lit, -rest * reciprocal(through), none);
                sums.add(layer, inside, kHides ? d_alpha : d_alpha + d_gamma, d_gamma, t1, t2, form, alpha_max);
            });
            if (pass == 1) sums.write(moments + strip.slot(*entry) * kMoments);
        }
    }
}

template <class S> void weights_backward(const WeightBackwardArgs<S>& b) {
    const WeightArgs<S>& a = b.forward;
    const PlanView<S>& plan = a.plan;
    const TileTables<S> grid(a.lens);
    const int64_t all = int64_t(plan.poses) * plan.count;
    Buffer<S> upstream(2 * all);
    for (int64_t i = 0; i < all; ++i) upstream[2 * i] = b.grad_visible_sum[i], upstream[2 * i + 1] = b.grad_total[i];
    const Ranked<S> ranked(plan, a.model, upstream.data, 1, 2, a.threads);
    const int64_t area = int64_t(grid.tiles) * 2 * Lanes<S>::n;
    Buffer<S> memory(area * a.threads), moments(plan.strip_starts[plan.poses * plan.strips] * kMoments);
    with_switches(a.lens.tangent, a.model.extinctions, 2, [&](auto tangent, auto hides, auto) {
        auto strip = [&](int task, int worker) {
            weigh_backward_strip<S, tangent.value, hides.value>(b, ranked, grid, task, memory.data + area * worker, moments.data);
        };
        parallel_for(plan.poses * plan.strips, a.threads, strip);
    });
    chain(plan, a.model, a.lens, a.threads, moments.data, b.means, b.quats, b.scales, b.opacities, b.extinctions, static_cast<S*>(nullptr));
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

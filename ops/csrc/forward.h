// Front-to-back blending: images, and each Gaussian's weights.
#pragma once
#include "layer.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S, bool kTangent, bool kHides>
void composite_strip(const CompositeArgs<S>& a, const Ranked<S>& ranked, const Tables<S>& tables, int task, S* before, S* planes) {
    const Strip<S> strip(a.plan, a.lens.height, task);
    const int stride = padded(a.lens.width), area = kStripRows * stride, k_count = ranked.width - 2;
    const Vec<S> floor = splat(a.lens.transmittance_min), alpha_max = splat(a.lens.alpha_max);
    fill(before, area, S(1));
    fill(planes, int64_t(area) * k_count, S(0));
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        if ((entry - strip.first) % 64 == 63 && !any_lit(before, area, a.lens.transmittance_min)) break;
        const S* row = ranked.of(a.plan, strip.pose, *entry);
        const S opacity = row[0], extinction = row[1];
        each_block<S, kTangent>(strip, *entry, tables, a.lens, stride, [&](int at, Vec<S>, Vec<S>, Vec<S> form, Mask<S> inside) __attribute__((always_inline)) {
            const Vec<S> light = load(before + at);
            const Mask<S> counts = inside & at_most(floor, light);
            if (!any(counts)) return;
            const Layer<S, kHides> layer(form, counts, opacity, extinction, alpha_max);
            const Vec<S> weight = light * layer.alpha;
            store(before + at, light * (S(1) - layer.gamma));
            S* plane = planes + at;
            for (int k = 0; k < k_count; ++k, plane += area) store(plane, fma(splat(row[2 + k]), weight, load(plane)));
        });
    }
    const int64_t pixels = int64_t(a.lens.height) * a.lens.width;
    for (int row = strip.row0; row < strip.row1; ++row) {
        const int64_t from = (row - strip.row0) * stride, to = int64_t(row) * a.lens.width;
        memcpy(a.transmittance + strip.pose * pixels + to, before + from, a.lens.width * sizeof(S));
        for (int k = 0; k < k_count; ++k)
            memcpy(a.image + (int64_t(strip.pose) * k_count + k) * pixels + to, planes + int64_t(k) * area + from, a.lens.width * sizeof(S));
    }
}

template <class S> void composite(const CompositeArgs<S>& a) {
    const GridTables<S> grid(a.lens);
    const Ranked<S> ranked(a.plan, a.model, a.features, a.samples, a.channels, a.threads);
    const int64_t area = int64_t(kStripRows) * padded(a.lens.width), scratch = area * (ranked.width - 1);
    Buffer<S> memory(scratch * a.threads);
    auto strip = [&](int task, int worker) {
        S* mine = memory.data + worker * scratch;
        const bool hides = a.model.extinctions != nullptr;
        const auto run = a.lens.tangent ? (hides ? composite_strip<S, true, true> : composite_strip<S, true, false>)
                                        : (hides ? composite_strip<S, false, true> : composite_strip<S, false, false>);
        run(a, ranked, grid.tables, task, mine, mine + area);
    };
    parallel_for(a.plan.poses * a.plan.strips, a.threads, strip);
}

template <class S, bool kTangent, bool kHides>
void weigh_strip(const WeightArgs<S>& a, const Ranked<S>& ranked, const Tables<S>& tables, int task, S* before, S* sums) {
    const Strip<S> strip(a.plan, a.lens.height, task);
    const int stride = padded(a.lens.width);
    const Vec<S> floor = splat(a.lens.transmittance_min), alpha_max = splat(a.lens.alpha_max), none = splat(S(0));
    fill(before, int64_t(kStripRows) * stride, S(1));
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        const S* row = ranked.of(a.plan, strip.pose, *entry);
        const S opacity = row[0], extinction = row[1];
        Vec<S> seen = none, total = none;
        each_block<S, kTangent>(strip, *entry, tables, a.lens, stride, [&](int at, Vec<S>, Vec<S>, Vec<S> form, Mask<S> inside) __attribute__((always_inline)) {
            const Vec<S> light = load(before + at);
            const Mask<S> lit = at_most(floor, light);
            const Layer<S, kHides> layer(form, inside, opacity, extinction, alpha_max);
            total += layer.alpha;
            seen += select(lit, light * layer.alpha, none);
            store(before + at, select(lit, light * (S(1) - layer.gamma), light));
        });
        S* slot = sums + 2 * strip.slot(*entry);
        slot[0] = sum<S>(seen), slot[1] = sum<S>(total);
    }
}

template <class S> void weights(const WeightArgs<S>& a) {
    const GridTables<S> grid(a.lens);
    const Ranked<S> ranked(a.plan, a.model, nullptr, 0, 0, a.threads);
    const int64_t area = int64_t(kStripRows) * padded(a.lens.width);
    Buffer<S> memory(area * a.threads), sums(2 * a.plan.strip_starts[a.plan.poses * a.plan.strips]);
    auto strip = [&](int task, int worker) {
        const bool hides = a.model.extinctions != nullptr;
        const auto run = a.lens.tangent ? (hides ? weigh_strip<S, true, true> : weigh_strip<S, true, false>)
                                        : (hides ? weigh_strip<S, false, true> : weigh_strip<S, false, false>);
        run(a, ranked, grid.tables, task, memory.data + worker * area, sums.data);
    };
    parallel_for(a.plan.poses * a.plan.strips, a.threads, strip);
    auto gather = [&](int pose, int) {
        const int64_t base = int64_t(pose) * a.plan.count;
        const int64_t* slots = a.plan.slots + int64_t(pose) * (a.plan.count + 1);
        for (int rank = 0; rank < a.plan.count; ++rank) {
            S seen = 0, total = 0;
            for (int64_t slot = slots[rank]; slot < slots[rank + 1]; ++slot) seen += sums[2 * slot], total += sums[2 * slot + 1];
            a.visible_sum[base + a.plan.order[base + rank]] = seen, a.total[base + a.plan.order[base + rank]] = total;
        }
    };
    parallel_for(a.plan.poses, a.threads, gather);
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

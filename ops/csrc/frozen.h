// A static receiver's weights as blocks of lanes (sparse: rank, place, weights), and images from them.
#pragma once
#include "forward.h"

namespace gsparc {
namespace GSPARC_ISA {

// Counts the blocks of a strip (heads null) or writes them, in the order in which `composite` visits them.
template <class S, bool kTangent, bool kHides>
void freeze_strip(const FreezeArgs<S>& a, const Ranked<S>& ranked, const Tables<S>& tables, int task, S* before) {
    const Strip<S> strip(a.plan, a.lens.height, task);
    const int stride = padded(a.lens.width);
    const Vec<S> floor = splat(a.lens.transmittance_min), alpha_max = splat(a.lens.alpha_max);
    fill(before, int64_t(kStripRows) * stride, S(1));
    int64_t block = a.heads ? a.starts[task] : 0;
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        const S* row = ranked.of(a.plan, strip.pose, *entry);
        const S opacity = row[0], extinction = row[1];
        each_block<S, kTangent>(strip, *entry, tables, a.lens, stride, [&](int at, Vec<S>, Vec<S>, Vec<S> form, Mask<S> inside) __attribute__((always_inline)) {
            const Vec<S> light = load(before + at);
            const Mask<S> counts = inside & at_most(floor, light);
            if (!any(counts)) return;
            const Layer<S, kHides> layer(form, counts, opacity, extinction, alpha_max);
            store(before + at, light * (S(1) - layer.gamma));
            if (a.heads) {
                a.heads[2 * block] = *entry, a.heads[2 * block + 1] = at;
                store(a.weights + block * Lanes<S>::n, light * layer.alpha);
            }
            ++block;
        });
    }
    if (!a.heads) a.starts[task + 1] = block;
}

template <class S> int freeze(const FreezeArgs<S>& a) {
    const GridTables<S> grid(a.lens);
    const Ranked<S> ranked(a.plan, a.model, nullptr, 0, 0, a.threads);
    const int64_t area = int64_t(kStripRows) * padded(a.lens.width);
    Buffer<S> memory(area * a.threads);
    auto strip = [&](int task, int worker) {
        const bool hides = a.model.extinctions != nullptr;
        const auto run = a.lens.tangent ? (hides ? freeze_strip<S, true, true> : freeze_strip<S, true, false>)
                                        : (hides ? freeze_strip<S, false, true> : freeze_strip<S, false, false>);
        run(a, ranked, grid.tables, task, memory.data + worker * area);
    };
    parallel_for(a.plan.strips, a.threads, strip);
    return Lanes<S>::n;
}

template <class S> void thaw(const ThawArgs<S>& a) {
    const int stride = padded(a.width), area = kStripRows * stride, strips = (a.height + kStripRows - 1) / kStripRows;
    const int64_t scratch = int64_t(area) * a.channels, pixels = int64_t(a.height) * a.width;
    Buffer<S> memory(scratch * a.threads);
    auto strip = [&](int task, int worker) {
        S* planes = memory.data + worker * scratch;
        fill(planes, scratch, S(0));
        for (int64_t block = a.starts[task]; block < a.starts[task + 1]; ++block) {
            const S* feature = a.features + int64_t(a.heads[2 * block]) * a.channels;
            const Vec<S> weight = load(a.weights + block * Lanes<S>::n);
            S* plane = planes + a.heads[2 * block + 1];
            for (int k = 0; k < a.channels; ++k, plane += area) store(plane, fma(splat(feature[k]), weight, load(plane)));
        }
        const int row0 = task * kStripRows, row1 = row0 + kStripRows < a.height ? row0 + kStripRows : a.height;
        for (int k = 0; k < a.channels; ++k)
            for (int row = row0; row < row1; ++row)
                memcpy(a.image + k * pixels + int64_t(row) * a.width, planes + int64_t(k) * area + (row - row0) * stride, a.width * sizeof(S));
    };
    parallel_for(strips, a.threads, strip);
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

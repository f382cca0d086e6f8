// Roofline of this machine: peak rates that timings are divided by. Written before the kernels were tuned and with an
// exponential of their own, so that no change to the kernels moves them.
#pragma once
#include <string.h>

#include "projection.h"

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kMarkPixels = 384, kMarkRounds = 64;

// sum += exp(x) at a row of pixels that stays in the first-level cache: one load, one exponential, one accumulation each.
// Sizes: tasks. Returns how many.
template <class S> int64_t mark_exponentials(const Call& call) {
    const int tasks = call.sizes[0], threads = call.threads;
    Buffer<float> sums(tasks);
    constexpr int n = Lanes<float>::n;
    Buffer<float> memory(int64_t(threads) * 2 * kMarkPixels);
    auto run = [&](int task, int worker) {
        float *x = memory.data + int64_t(worker) * 2 * kMarkPixels, *total = x + kMarkPixels;
        for (int j = 0; j < kMarkPixels; ++j) x[j] = -0.01f * float(j), total[j] = 0;
        for (int round = 0; round < kMarkRounds; ++round) {
            const Vec<float> scale = splat(1.0f / float(1 + round));
            for (int j = 0; j < kMarkPixels; j += n) {
                const Vec<float> y = load(x + j) * scale;
                const Vec<float> shifted = y * 1.44269504f + 12582912.0f, whole = shifted - 12582912.0f;
                const Vec<float> r = fma(whole, splat(-1.42860677e-6f), fma(whole, splat(-0.693145752f), y));
                Vec<float> p = splat(1.38888889e-3f);
                p = fma(p, r, splat(8.33333333e-3f));
                p = fma(p, r, splat(4.16666667e-2f));
                p = fma(p, r, splat(0.166666667f));
                p = fma(p, r, splat(0.5f));
                p = fma(p, r, splat(1.0f));
                p = fma(p, r, splat(1.0f));
                store(total + j, load(total + j) + (Vec<float>)((Int<float>)p + ((Int<float>)shifted << 23)));
            }
        }
        float all = 0;
        for (int j = 0; j < kMarkPixels; ++j) all += total[j];
        sums[task] = all;
    };
    parallel_for(tasks, threads, run);
    return int64_t(tasks) * kMarkPixels * kMarkRounds;
}

// Copies bytes in pieces, as the kernels would move them at best.
// Tensors: from and to. Numbers: bytes.
template <class S> int64_t mark_copy(const Call& call) {
    Reader in(call);
    const char* from = in.next<const char>();
    char* to = in.next<char>();
    const int64_t bytes = int64_t(call.numbers[0]);
    constexpr int64_t piece = 1 << 18;
    auto run = [&](int task, int) {
        const int64_t begin = int64_t(task) * piece, end = begin + piece < bytes ? begin + piece : bytes;
        memcpy(to + begin, from + begin, end - begin);
    };
    parallel_for(int((bytes + piece - 1) / piece), call.threads, run);
    return bytes;
}

template <class P, class S> int64_t mark_strip(const Strip<S>& strip, const Tables<S>& t, const KernelSettings<S>& settings) {
    int64_t found = 0;
    for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
        const S* record = strip.records + int64_t(strip.order[*entry]) * kRecord;
        const Runs runs = runs_of(strip.boxes[*entry], settings.width);
        for (int row = strip.row0; row < strip.row1; ++row)
            for (int run = 0; run < runs.count; ++run)
                for (int column = runs.from[run]; column < runs.to[run]; column += Lanes<S>::n) {
                    const Place<S> at = {splat(t.cos_row[row]), splat(t.sin_row[row]), splat(S(row)), load(t.cos_column + column), load(t.sin_column + column), load(t.column + column)};
                    Vec<S> tau1, tau2, form;
                    found += __builtin_popcount(bits_of<S>(P::offsets(record, at, t, settings, tau1, tau2, form)));
                }
    }
    return found;
}

// Pixel-Gaussian pairs inside the exact footprints of a plan: the exponentials that no renderer can avoid.
template <class S> int64_t mark_pairs(const Call& call) {
    Reader in(call);
    const ViewArgs<S> a(call, in);
    const PlanView<S>& plan = a.plan;
    const KernelSettings<S>& settings = a.settings;
    Buffer<S> numbers(table_size(settings));
    fill_tables(settings, numbers.data);
    const Tables<S> tables = tables_at(settings, numbers.data);
    const int tasks = plan.poses * plan.strips;
    Buffer<int64_t> counts(tasks);
    auto run = [&](int task, int) {
        counts[task] = with_projection(settings.projection, [&](auto projection) { return mark_strip<decltype(projection)>(Strip<S>(plan, settings.height, task), tables, settings); });
    };
    parallel_for(tasks, a.threads, run);
    int64_t total = 0;
    for (int task = 0; task < tasks; ++task) total += counts[task];
    return total;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// Roofline of this machine: peak rates that timings are divided by. Written before the kernels were tuned and with an
// exponential of their own, so that no change to the kernels moves them.
#pragma once
#include <string.h>

#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// sum += exp(x) at a row of pixels that stays in the first-level cache: one load, one exponential, one accumulation each.
inline void mark_exponentials(int tasks, int threads, float* sums) {
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
}

// Copies bytes in pieces, as the kernels would move them at best.
inline void mark_copy(const char* from, char* to, int64_t bytes, int threads) {
    constexpr int64_t piece = 1 << 18;
    auto run = [&](int task, int) {
        const int64_t begin = int64_t(task) * piece, end = begin + piece < bytes ? begin + piece : bytes;
        memcpy(to + begin, from + begin, end - begin);
    };
    parallel_for(int((bytes + piece - 1) / piece), threads, run);
}

// Pixel-Gaussian pairs inside the exact footprints of a plan: the exponentials that no renderer can avoid.
template <class S> int64_t mark_pairs(const PlanView<S>& plan, const KernelSettings<S>& settings, int threads) {
    const TileTables<S> grid(settings);
    const int tasks = plan.poses * plan.strips;
    Buffer<int64_t> counts(tasks);
    auto run = [&](int task, int) {
        const Strip<S> strip(plan, settings.height, task);
        for (const int32_t* entry = strip.first; entry < strip.last; ++entry) {
            Vec<S> found = splat(S(0));
            const auto count = [&](int, Vec<S>, Vec<S>, Vec<S>, Mask<S> inside) { found += select(inside, splat(S(1)), splat(S(0))); };
            if (settings.tangent) each_tile<S, true, false>(strip, *entry, grid, settings, Always<S>(), count);
            else each_tile<S, false, false>(strip, *entry, grid, settings, Always<S>(), count);
            counts[task] += int64_t(sum<S>(found));
        }
    };
    parallel_for(tasks, threads, run);
    int64_t total = 0;
    for (int task = 0; task < tasks; ++task) total += counts[task];
    return total;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

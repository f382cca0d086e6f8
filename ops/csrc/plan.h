// Order and bins: which strip holds which footprints, front to back.
#pragma once
#include "kernels.h"

namespace gsparc {

template <class S> struct PlanArgs {
    Model<S> model;                    // opacities: the larger of opacity and extinction
    const int64_t* ids;                // (N,) or null: the row number
    int poses, count, strips, threads;
    KernelSettings<S> settings;
    S *records, *means2d, *radii;      // (P, N, kRecord) by depth; (P, N, 2) and (P, N) by Gaussian
    bool* visible;                     // (P, N)
    Box* boxes;                        // (P, N) by depth
    int32_t *order, *shown;            // (P, N), (P,)
    int64_t *slots, *strip_starts;     // (P, N + 1), (P strips + 1)
};

// Fills all of the above; returns -1, the first unsound Gaussian as `Kernels::project` does, or kUnsoundPose.
template <class S> int64_t make_plan(const PlanArgs<S>& args);

// Fills entries (strip_starts[P strips],) of a plan made before.
template <class S> void fill_entries(const PlanView<S>& plan, int threads, int32_t* entries);

}  // namespace gsparc

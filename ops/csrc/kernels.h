// What one instruction set offers; kernels.cpp implements it once per set, dispatch.cpp picks one at run time.
#pragma once
#include "layout.h"

namespace gsparc {

template <class S> struct ProjectArgs {
    Model<S> model;
    int count;
    KernelSettings<S> settings;
    S *records, *depths, *means2d, *radii;  // (N, kRecord), (N,), (N, 2), (N,)
    Box* boxes;                     // (N,), rows empty where culled
    bool* visible;                  // (N,)
    int pose;
};

// Kernels of Python, each a `template <class S> int64_t NAME(const Call&)` in a header of kernels.cpp.
#define GSPARC_KERNELS(X) \
    X(composite) X(composite_backward) X(weights) X(weights_backward) X(freeze) X(thaw) X(similarity) \
    X(array_spectrum) X(nearest_weights) X(directional)

template <class S> struct Kernels {
    // Returns -1, or 4 * Gaussian + (0 means, 1 quats, 2 scales, 3 opacities) for the first that is not sound.
    int64_t (*project)(const ProjectArgs<S>&, int begin, int end);
#define X(name) int64_t (*name)(const Call&);
    GSPARC_KERNELS(X)
#undef X
};

template <class S> const Kernels<S>& kernels();  // the fastest set this machine has
const char* instruction_set();
bool use_instruction_set(const char* name);  // for tests; false if this machine or build lacks it

// Of plan.cpp. The first fills a plan but for its entries; returns -1, the first unsound Gaussian as `Kernels::project`
// does, or kUnsoundPose. The second fills the entries.
int64_t plan(const Call& call);
int64_t entries(const Call& call);

}  // namespace gsparc

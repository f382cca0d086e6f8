// What one instruction set offers; kernels.cpp implements it once per set, dispatch.cpp picks one at run time.
#pragma once
#include "layout.h"

namespace gsparc {

template <class S> struct ProjectArgs {
    Model<S> model;                 // opacities here: the larger of opacity and extinction
    int count;
    KernelSettings<S> settings;
    S *records, *depths, *means2d, *radii;  // (N, kRecord), (N,), (N, 2), (N,)
    Box* boxes;                     // (N,), rows empty where culled
    bool* visible;                  // (N,)
    int pose;
};

template <class S> struct CompositeArgs {
    PlanView<S> plan;
    Model<S> model;
    KernelSettings<S> settings;
    int samples, channels, threads;
    const S* features;              // (B, N, C)
    S *image, *transmittance;       // (B, C, H, W), (P, H, W)
};

// Channels of one pose: those of all samples where they share it.
template <class S> inline int channels_of(const CompositeArgs<S>& a) { return a.plan.poses == 1 ? a.samples * a.channels : a.channels; }

template <class S> struct CompositeBackwardArgs {
    CompositeArgs<S> forward;
    const S *grad_image, *grad_transmittance;    // as above; the second may be null
    S *means, *quats, *scales, *opacities, *extinctions, *features, *screen;  // gradients; screen (P, N, 2)
};

template <class S> struct WeightArgs {
    PlanView<S> plan;
    Model<S> model;
    KernelSettings<S> settings;
    int threads;
    S *visible_sum, *total;         // (P, N): sums over pixels of alpha T and alpha
};

template <class S> struct WeightBackwardArgs {
    WeightArgs<S> forward;
    const S *grad_visible_sum, *grad_total;      // (P, N)
    S *means, *quats, *scales, *opacities, *extinctions;
};

template <class S> struct FreezeArgs {
    PlanView<S> plan;               // of one pose
    Model<S> model;
    KernelSettings<S> settings;
    int threads;
    int64_t* starts;                // (strips + 1), first block of each strip; [1:] is counted while heads is null
    int32_t* heads;                 // (blocks, 2) rank and tile of the strip
    S* weights;                     // (blocks, lanes)
};

template <class S> struct ThawArgs {
    int height, width, channels, threads;
    const int64_t* starts;
    const int32_t* heads;
    const S *weights, *features;    // features (V, K) by rank
    S* image;                       // (K, H, W)
};

template <class S> struct NetworkArgs {
    int samples, count, inputs, hidden, outputs, threads;
    const S *encoded, *weight1, *bias1, *weight2, *bias2;  // (B, E), (N, E, H), (N, H), (N, H, C), (N, C)
    S* out;                         // (B, N, C)
};

template <class S> struct NetworkBackwardArgs {
    NetworkArgs<S> forward;         // out unused
    const S* slope;                 // (B, N, C)
    S *weight1, *bias1, *weight2, *bias2;
};

// Factored channels H = sum over sources of gain, steering and delay; complex numbers are pairs.
template <class S> struct ChannelArgs {
    int samples, count, antennas, subcarriers, threads;
    double first, step;             // frequencies [Hz]
    const S *gains, *steering;      // (B, N, 2), (N, A, 2)
    const double* delays;           // (N,) [s]
    S* out;                         // (B, A, K, 2)
};

template <class S> struct ChannelBackwardArgs {
    ChannelArgs<S> forward;         // out unused
    const S* slope;                 // (B, A, K, 2)
    S *gains, *steering;
    double* delays;
};

// B images (H, W), seen through a separable window of 2 radius + 1 taps.
struct SimilarityArgs {
    int count, height, width, radius, threads;
    const float *taps, *prediction, *target;
    float c1, c2;
    float *value, *slope;           // (B,), and (B, H, W) d value / d prediction, or null
};

// Returns -1, or 4 * Gaussian + (0 means, 1 quats, 2 scales, 3 opacities) for the first that is not sound.
template <class S> struct Kernels {
    int64_t (*project)(const ProjectArgs<S>&, int begin, int end);
    void (*composite)(const CompositeArgs<S>&);
    void (*composite_backward)(const CompositeBackwardArgs<S>&);
    void (*weights)(const WeightArgs<S>&);
    void (*weights_backward)(const WeightBackwardArgs<S>&);
    int (*freeze)(const FreezeArgs<S>&);  // returns the lanes of a block
    void (*thaw)(const ThawArgs<S>&);
    void (*networks)(const NetworkArgs<S>&);
    void (*networks_backward)(const NetworkBackwardArgs<S>&);
    void (*similarity)(const SimilarityArgs&);
    void (*channels)(const ChannelArgs<S>&);
    void (*channels_backward)(const ChannelBackwardArgs<S>&);
    void (*mark_exponentials)(int tasks, int threads, float* sums);  // see machine_limits.h
    void (*mark_copy)(const char* from, char* to, int64_t bytes, int threads);
    int64_t (*mark_pairs)(const PlanView<S>&, const KernelSettings<S>&, int threads);
    void (*bin_strip)(const int16_t* first, const int16_t* last, int count, int strip, int32_t* to);  // see bins.h; may be null
};

template <class S> const Kernels<S>& kernels();  // the fastest set this machine has
const char* instruction_set();
bool use_instruction_set(const char* name);  // for tests; false if this machine or build lacks it

}  // namespace gsparc

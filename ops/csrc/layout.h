// What Python, the plan and the kernels hand each other. Plain data.
#pragma once
#include <stdint.h>

namespace gsparc {

// Grid, optics and thresholds; `KernelSettings` of settings.py has the same fields in the same order.
#define GSPARC_SETTINGS(X) \
    X(int, height) X(int, width) X(int, projection) X(bool, periodic) X(bool, compensate) X(bool, relative) \
    X(S, first_elevation) X(S, first_azimuth) X(S, elevation_step) X(S, azimuth_step) X(S, low_pass) X(S, near) \
    X(S, alpha_min) X(S, transmittance_min) X(S, alpha_max) X(S, horizon_cosine)

// Class in projection/ and name of each projection, in the order of `PROJECTIONS` of projection.py.
#define GSPARC_PROJECTIONS(X) X(Tangent, tangent) X(Equirect, equirect)

template <class S> struct KernelSettings {
#define X(type, name) type name;
    GSPARC_SETTINGS(X)
#undef X
};

template <class S, class From> KernelSettings<S> in_precision(const KernelSettings<From>& from) {
    KernelSettings<S> to;
#define X(type, name) to.name = type(from.name);
    GSPARC_SETTINGS(X)
#undef X
    return to;
}

constexpr int kRecord = 12;     // scalars of one footprint, see pixels.h
constexpr int kMoments = 8;     // scalars of Moments
constexpr int kLanes = 16;      // most pixels done at a time by any instruction set

// What a plan returns of a pose, and of equal ids at one distance; of a Gaussian 4 i + parameter.
constexpr int64_t kUnsoundPose = int64_t(1) << 62, kEqualIds = int64_t(1) << 61;
// What an image of a frozen view returns besides.
constexpr int64_t kUnsoundFeatures = int64_t(1) << 60;

// A strip is kStripRows rows of the image, the unit of work. Row-wise strips let azimuth wrap without tiles.
constexpr int kStripRows = 4;

// Taps of the similarity's window to either side of the middle one.
constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;

// Of the CUDA kernels: pixels of a tile, which a warp takes at a time.
constexpr int kTileWidth = 8, kTileHeight = 4;

// A footprint's rows [row0, row1) and columns column0 + [0, columns), modulo the width.
struct Box {
    int32_t row0, row1, column0, columns;
};

// N Gaussians for P poses, in depth order within each pose.
template <class S> struct PlanView {
    int poses, count, strips;
    const S* records;            // (P, N, kRecord) by Gaussian
    const Box* boxes;            // (P, N) by rank
    const int32_t* order;        // (P, N) rank -> Gaussian
    const int32_t* shown;        // (P,) how many ranks are visible
    const int64_t* slots;        // (P, N + 1) first entry of each rank, over all poses
    const int64_t* strip_starts; // (P strips + 1) into entries
    const int32_t* entries;      // (E,) ranks, front to back within each strip
};

template <class S> struct Model {
    const S *means, *quats, *scales, *opacities;
    const S *positions, *rotations;  // (P, 3), (P, 3, 3)
};

// One call of a kernel from Python; `Call` of calls.py has the same fields. What sizes, numbers and tensors mean is the
// kernel's business. An address of 0 is an absent tensor.
struct Call {
    int32_t twice, threads, device;
    int32_t built_for, driver;  // CUDA versions
    int32_t sizes[12];
    KernelSettings<double> settings;
    double numbers[8];
    uint64_t tensors[32];
    uint64_t scratch, stream;  // of the CUDA kernels
};

// Reads a call's sizes and tensors one after the other.
struct Reader {
    const int32_t* size;
    const uint64_t* tensor;
    explicit Reader(const Call& call) : size(call.sizes), tensor(call.tensors) {}
    template <class T> T* next() { return reinterpret_cast<T*>(uintptr_t(*tensor++)); }
    template <class... T> void read(T*&... to) { ((to = next<T>()), ...); }
    template <class... T> void sizes(T&... to) { ((to = *size++), ...); }
};

template <class S> Model<S> read_model(Reader& in) {
    Model<S> m;
    in.read(m.means, m.quats, m.scales, m.opacities, m.positions, m.rotations);
    return m;
}

inline int strips_of(int height) { return (height + kStripRows - 1) / kStripRows; }

// What calls on a plan begin with: P and N; the plan, the Gaussians and the poses.
template <class S> struct ViewArgs {
    PlanView<S> plan;
    Model<S> model;
    KernelSettings<S> settings;
    int threads;
    ViewArgs(const Call& call, Reader& in) : settings(in_precision<S>(call.settings)), threads(call.threads) {
        in.sizes(plan.poses, plan.count);
        plan.strips = strips_of(settings.height);
        in.read(plan.records, plan.boxes, plan.order, plan.shown, plan.slots, plan.strip_starts, plan.entries);
        model = read_model<S>(in);
    }
};

}  // namespace gsparc

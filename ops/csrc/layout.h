// What the kernels, the plan and the bindings hand each other. Plain data.
#pragma once
#include <stdint.h>

namespace gsparc {

// Grid and optics: settings.py and geometry.py are where these numbers come from.
template <class S> struct Lens {
    int height, width;
    bool periodic, tangent, compensate, relative;
    S first_elevation, first_azimuth, elevation_step, azimuth_step;
    S low_pass, near, alpha_min, transmittance_min, alpha_max, horizon_cosine;
};

constexpr int kRecord = 12;     // scalars of one footprint, see pixels.h
constexpr int kMoments = 9;     // scalars of Moments
constexpr int kLanes = 16;      // most pixels done at a time by any instruction set

constexpr int64_t kUnsoundPose = int64_t(1) << 62;  // what a plan returns of a pose; of a Gaussian 4 i + parameter

constexpr int kMarkPixels = 384, kMarkRounds = 64, kMarkPairs = kMarkPixels * kMarkRounds;  // see yardstick.h

// A strip is kStripRows rows of the image, the unit of work. Row-wise strips let azimuth wrap without tiles.
constexpr int kStripRows = 4;

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
    const S *means, *quats, *scales, *opacities, *extinctions;  // extinctions may be null
    const S *positions, *rotations;                             // (P, 3), (P, 3, 3)
};

}  // namespace gsparc

// From Gaussians to records and boxes, as many at a time as there are lanes.
#pragma once
#include "boxes.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

// The lens with every number in all lanes.
template <class S> Lens<Pack<S>> widened(const Lens<S>& l) {
    return {l.height, l.width, l.periodic, l.tangent, l.compensate, l.relative, l.first_elevation, l.first_azimuth,
            l.elevation_step, l.azimuth_step, l.low_pass, l.near, l.alpha_min, l.transmittance_min, l.alpha_max, l.horizon_cosine};
}

// Rows [0, count) of `width` numbers each, one row a lane; lanes past the end repeat the last row.
template <class S> inline void gather_rows(const S* rows, int width, int count, Pack<S>* out) {
    constexpr int n = Pack<S>::n;
    S lanes[16][n];
    for (int k = 0; k < n; ++k)
        for (int c = 0; c < width; ++c) lanes[c][k] = rows[(k < count ? k : count - 1) * width + c];
    for (int c = 0; c < width; ++c) out[c] = load(lanes[c]);
}
template <class S> inline void scatter_rows(const Pack<S>* in, int width, int count, S* rows) {
    constexpr int n = Pack<S>::n;
    S lanes[16][n];
    for (int c = 0; c < width; ++c) store(lanes[c], in[c].v);
    for (int k = 0; k < count; ++k)
        for (int c = 0; c < width; ++c) rows[k * width + c] = lanes[c][k];
}

template <class S> inline Gaussian<Pack<S>> gaussians(const Model<S>& model, int64_t i, int count) {
    Gaussian<Pack<S>> g;
    gather_rows(model.means + 3 * i, 3, count, g.mean);
    gather_rows(model.quats + 4 * i, 4, count, g.quat);
    gather_rows(model.scales + 3 * i, 3, count, g.scale);
    return g;
}

// A receiver's pose in all lanes.
template <class S> struct Stand {
    Pack<S> position[3], rotation[9];
    Stand(const Model<S>& model, int pose) {
        for (int k = 0; k < 3; ++k) position[k] = model.positions[3 * pose + k];
        for (int k = 0; k < 9; ++k) rotation[k] = model.rotations[9 * pose + k];
    }
};

// `project_one` for rows [i, i + count), count at most the lanes.
template <class S> int64_t project_some(const ProjectArgs<S>& a, const Lens<Pack<S>>& lens, const Stand<S>& stand, int64_t i, int count) {
    constexpr int n = Pack<S>::n;
    for (int64_t k = i; k < i + count; ++k) {
        const int wrong = unsound(gaussian(a.model, k), a.model.opacities[k]);
        if (wrong >= 0) return 4 * k + wrong;
    }
    Pack<S> opacity;
    gather_rows(a.model.opacities + i, 1, count, &opacity);
    const Sight<Pack<S>> s = sight_of(gaussians(a.model, i, count), opacity, stand.position, stand.rotation, lens);
    const Pack<S> place[2] = {s.column, s.row};
    scatter_rows(place, 2, count, a.means2d + 2 * i);
    scatter_rows(&s.depth, 1, count, a.depths + i);
    S reach[n], radius[n], frame[4][n], record[kRecord][n];
    store(reach, s.reach.v), store(radius, s.radius.v);
    store(frame[0], s.frame.bottom.v), store(frame[1], s.frame.top.v), store(frame[2], s.frame.left.v), store(frame[3], s.frame.right.v);
    for (int c = 0; c < kRecord; ++c) store(record[c], s.record[c].v);
    for (int k = 0; k < count; ++k) {
        const int64_t to = i + k;
        a.radii[to] = 0, a.visible[to] = false;
        if (!(reach[k] >= 0)) continue;
        a.boxes[to] = box_of<S>({frame[0][k], frame[1][k], frame[2][k], frame[3][k]}, a.lens);
        a.visible[to] = a.boxes[to].row1 > a.boxes[to].row0;
        if (!a.visible[to]) continue;
        a.radii[to] = radius[k];
        for (int c = 0; c < kRecord; ++c) a.records[to * kRecord + c] = record[c][k];
    }
    return -1;
}

template <class S> int64_t project_range(const ProjectArgs<S>& a, int begin, int end) {
    constexpr int n = Pack<S>::n;
    const Lens<Pack<S>> lens = widened(a.lens);
    const Stand<S> stand(a.model, a.pose);
    for (int64_t i = begin; i < end; i += n) {
        const int64_t wrong = project_some(a, lens, stand, i, end - i < n ? int(end - i) : n);
        if (wrong >= 0) return wrong;
    }
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// One Gaussian before one receiver: is it sound, which rows and columns may it reach, what do its pixels need.
#pragma once
#include <string.h>

#include "kernels.h"
#include "pixels.h"
#include "pose.h"

namespace gsparc {
namespace GSPARC_ISA {

constexpr double kWidest = 1e5;  // WIDEST in settings.py [m]

template <class S> GSPARC_HD int unsound(const Gaussian<S>& g, S opacity) {
    const S big = sizeof(S) == 4 ? S(3.4e38) : S(1.7e308);
    for (int k = 0; k < 3; ++k)
        if (!(fabs(g.mean[k]) <= S(kFarthest))) return 0;
    for (int k = 0; k < 4; ++k)
        if (!(fabs(g.quat[k]) <= big)) return 1;
    for (int k = 0; k < 3; ++k)
        if (!(g.scale[k] >= 0 && g.scale[k] <= S(kWidest))) return 2;
    return opacity >= 0 && opacity <= 1 ? -1 : 3;
}

template <class S> GSPARC_HD Gaussian<S> gaussian(const Model<S>& model, int64_t i) {
    Gaussian<S> g;
    memcpy(g.mean, model.means + 3 * i, sizeof g.mean);
    memcpy(g.quat, model.quats + 4 * i, sizeof g.quat);
    memcpy(g.scale, model.scales + 3 * i, sizeof g.scale);
    return g;
}

// Rows and columns (fractional) between which a footprint lies.
template <class S> struct Frame {
    S bottom, top, left, right;
};
// A box in whole numbers of type S, so that lanes of Gaussians are boxed together; all 0 where it holds no pixel.
template <class S> struct Extents {
    S row0, row1, column0, columns;
};

// Columns [low, high] (fractional) of the circle; the full row where they are nearly that many.
template <class S> GSPARC_HD void set_columns(S low, S high, const KernelSettings<S>& settings, S width, Extents<S>& box) {
    const S turn = settings.periodic ? width : S(6.283185307179586) / settings.azimuth_step, none = S(0);
    const S first = upward(low), last = downward(high);
    const Truth<S> apart = last - first < turn - S(kLanes + 1);
    if (settings.periodic) {
        const S start = first - downward(first / turn) * turn;
        box.column0 = pick(apart & (start < turn), start, none);
        box.columns = pick(apart, pick(last < first, none, last - first + S(1)), width);
        return;
    }
    const S shift = downward(low / turn) * turn, edge = width - S(1);  // not a whole number of columns: round only after shifting
    S from = none, to = S(-1), images = none;
    for (int k = 0; k < 2; ++k) {  // the first image starts inside [0, turn), the second one turn before
        const S a = upward(low - shift - S(k) * turn), b = downward(high - shift - S(k) * turn);
        const Truth<S> seen = !(b < a) & !(b < none) & !(a > edge);
        images = pick(seen, images + S(1), images);
        from = pick(seen, pick(a > none, a, none), from), to = pick(seen, pick(b < edge, b, edge), to);
    }
    const Truth<S> full = !apart | (images > S(1.5));
    box.column0 = pick(full, none, from), box.columns = pick(full, width, to - from + S(1));
}

template <class S> GSPARC_HD Extents<S> extents_of(const Frame<S>& frame, const KernelSettings<S>& settings) {
    const S height = S(settings.height), none = S(0);
    Extents<S> box;
    box.row0 = clamped(upward(frame.bottom), none, height), box.row1 = clamped(downward(frame.top) + S(1), none, height);
    set_columns(frame.left, frame.right, settings, S(settings.width), box);
    const Truth<S> some = (box.row1 > box.row0) & (box.columns > none);
    box.row0 = pick(some, box.row0, none), box.row1 = pick(some, box.row1, none);
    box.column0 = pick(some, box.column0, none), box.columns = pick(some, box.columns, none);
    return box;
}

template <class S> GSPARC_HD Box box_of(const Frame<S>& frame, const KernelSettings<S>& settings) {
    const Extents<S> box = extents_of(frame, settings);
    return {int32_t(box.row0), int32_t(box.row1), int32_t(box.column0), int32_t(box.columns)};
}

// What a plan needs of one Gaussian before one receiver.
template <class S> struct Sight {
    S depth, column, row, reach, radius;  // reach < 0 where there is nothing to see
    Frame<S> frame;
    S record[kRecord];
};
template <class P, class S> GSPARC_HD Sight<S> sight_of(const Gaussian<S>& g, S opacity, const S* position, const S* rotation, const KernelSettings<S>& settings) {
    Sight<S> s;
    const Footprint<S> f = project<P>(g, position, rotation, settings);
    s.depth = f.r;
    const S azimuth = pick(f.cosine > 0, angle(f.n[1], f.n[0]), S(0)), elevation = angle(f.n[2], f.cosine);
    s.column = pick(f.present, (azimuth - settings.first_azimuth) * (1 / settings.azimuth_step), S(0));
    s.row = pick(f.present, (elevation - settings.first_elevation) * (1 / settings.elevation_step), S(0));
    s.reach = pick(f.present, reach2(f, opacity, settings), S(-1));
    const Frame<S> in = P::frame(f, elevation, s.column, s.row, s.reach * S(1.0001), settings);
    const S margin = S(0.01);  // rounding may not cut a pixel off
    s.frame = {in.bottom - margin, in.top + margin, in.left - margin, in.right + margin};
    const S middle = (f.k11 + f.k22) / 2, half = (f.k11 - f.k22) / 2;
    s.radius = root(s.reach * (middle + root(half * half + f.k12 * f.k12)));
    P::write(f, s.column, s.row, s.record);
    s.record[kReach] = s.reach, s.record[kGain] = f.gain, s.record[11] = S(0);
    return s;
}

// Fills row i of everything in ProjectArgs; returns what is unsound as `unsound` does.
template <class P, class S> GSPARC_HD int project_one(const ProjectArgs<S>& a, int64_t i) {
    const Gaussian<S> g = gaussian(a.model, i);
    const S opacity = a.model.opacities[i];
    const int wrong = unsound(g, opacity);
    if (wrong >= 0) return wrong;
    const Sight<S> s = sight_of<P>(g, opacity, a.model.positions + 3 * a.pose, a.model.rotations + 9 * a.pose, a.settings);
    a.depths[i] = s.depth, a.radii[i] = 0;
    a.means2d[2 * i] = s.column, a.means2d[2 * i + 1] = s.row;
    a.visible[i] = false;
    if (!(s.reach >= 0)) return -1;
    a.boxes[i] = box_of(s.frame, a.settings);
    a.visible[i] = a.boxes[i].row1 > a.boxes[i].row0;
    if (!a.visible[i]) return -1;
    a.radii[i] = s.radius;
    memcpy(a.records + i * kRecord, s.record, sizeof s.record);
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

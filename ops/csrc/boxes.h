// One Gaussian before one receiver: is it sound, which rows and columns may it reach, what do its pixels need.
#pragma once
#include <string.h>

#include "kernels.h"
#include "pixels.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> GSPARC_HD int unsound(const Gaussian<S>& g, S opacity) {
    const S big = sizeof(S) == 4 ? S(3.4e38) : S(1.7e308);
    for (int k = 0; k < 3; ++k)
        if (!(fabs(g.mean[k]) <= big)) return 0;
    for (int k = 0; k < 4; ++k)
        if (!(fabs(g.quat[k]) <= big)) return 1;
    for (int k = 0; k < 3; ++k)
        if (!(g.scale[k] >= 0 && g.scale[k] <= big)) return 2;
    return opacity >= 0 && opacity <= 1 ? -1 : 3;
}

template <class S> GSPARC_HD Gaussian<S> gaussian(const Model<S>& model, int64_t i) {
    Gaussian<S> g;
    memcpy(g.mean, model.means + 3 * i, sizeof g.mean);
    memcpy(g.quat, model.quats + 4 * i, sizeof g.quat);
    memcpy(g.scale, model.scales + 3 * i, sizeof g.scale);
    return g;
}

// Pixels [low, high] (fractional) as whole columns of the circle; the full row where it is that wide.
template <class S> GSPARC_HD void set_columns(S low, S high, const Lens<S>& lens, Box& box) {
    const S turn = lens.periodic ? S(lens.width) : S(6.283185307179586) / lens.azimuth_step;
    const S first = S(ceil(low)), last = S(floor(high));
    box.column0 = 0, box.columns = lens.width;
    if (!(last - first < turn - kLanes - 1)) return;
    if (lens.periodic) {
        box.columns = 0;
        if (last < first) return;
        S start = first - S(floor(first / turn)) * turn;
        if (start >= turn) start = 0;
        box.column0 = int32_t(start), box.columns = int32_t(last - first) + 1;
        return;
    }
    int images = 0;
    const S shift = S(floor(low / turn)) * turn;  // not a whole number of columns: round only after shifting
    S from = 0, to = -1;
    for (int k = 0; k < 2; ++k) {  // the first image starts inside [0, turn), the second one turn before
        const S a = S(ceil(low - shift - k * turn)), b = S(floor(high - shift - k * turn));
        if (b < a || b < 0 || a > lens.width - 1) continue;
        ++images, from = a > 0 ? a : 0, to = b < lens.width - 1 ? b : S(lens.width - 1);
    }
    if (images == 2) return;
    box.column0 = images ? int32_t(from) : 0, box.columns = images ? int32_t(to) - int32_t(from) + 1 : 0;
}

template <class S> GSPARC_HD Box box_of(const Footprint<S>& f, S column, S row, S reach, const Lens<S>& lens) {
    const S margin = S(0.01), wide = reach * S(1.0001);  // rounding may not cut a pixel off
    S low, high;
    Box box;
    if (lens.tangent) {
        const S unit = wide * lens.elevation_step * lens.elevation_step;
        const S a11 = f.k11 * unit, a12 = f.k12 * unit, a22 = f.k22 * unit;
        const bool below = f.n[2] < 0;
        const Extent<S> up = elevation_extent(below ? -f.n[2] : f.n[2], f.cosine, root(a11), root(a22));
        const S bottom = below ? -up.high : up.low, top = below ? -up.low : up.high;
        low = (bottom - lens.first_elevation) / lens.elevation_step, high = (top - lens.first_elevation) / lens.elevation_step;
        const Extent<S> across = azimuth_extent(f.n[2], f.cosine, a11, a12, a22);
        set_columns(column + across.low / lens.azimuth_step - margin, column + across.high / lens.azimuth_step + margin, lens, box);
    } else {
        const S half = root(wide * f.k22);
        low = row - half, high = row + half;
        const S across = root(wide * f.k11);
        set_columns(column - across - margin, column + across + margin, lens, box);
    }
    const S limit = S(lens.height);
    box.row0 = int32_t(clamped(S(ceil(low - margin)), S(0), limit));
    box.row1 = int32_t(clamped(S(floor(high + margin)) + 1, S(0), limit));
    if (box.row1 <= box.row0 || box.columns <= 0) box = {0, 0, 0, 0};
    return box;
}

// Fills row i of everything in ProjectArgs; returns what is unsound as `unsound` does.
template <class S> GSPARC_HD int project_one(const ProjectArgs<S>& a, int64_t i) {
    const Gaussian<S> g = gaussian(a.model, i);
    const S opacity = a.model.opacities[i];
    const int wrong = unsound(g, opacity);
    if (wrong >= 0) return wrong;
    const Footprint<S> f = project(g, a.model.positions + 3 * a.pose, a.model.rotations + 9 * a.pose, a.lens);
    a.depths[i] = f.r;
    a.visible[i] = false, a.radii[i] = 0, a.means2d[2 * i] = a.means2d[2 * i + 1] = 0;
    if (!f.present) return -1;
    const S azimuth = f.cosine > 0 ? angle(f.n[1], f.n[0]) : S(0), elevation = angle(f.n[2], f.cosine);
    const S column = (azimuth - a.lens.first_azimuth) / a.lens.azimuth_step;
    const S row = (elevation - a.lens.first_elevation) / a.lens.elevation_step;
    a.means2d[2 * i] = column, a.means2d[2 * i + 1] = row;
    const S reach = reach2(f, opacity, a.lens);
    if (!(reach >= 0)) return -1;
    a.boxes[i] = box_of(f, column, row, reach, a.lens);
    a.visible[i] = a.boxes[i].row1 > a.boxes[i].row0;
    if (!a.visible[i]) return -1;
    const S middle = (f.k11 + f.k22) / 2, half = (f.k11 - f.k22) / 2;
    a.radii[i] = root(reach * (middle + root(half * half + f.k12 * f.k12)));
    write_record(f, column, row, reach, a.lens, a.records + i * kRecord);
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// From Gaussians to records and boxes, as many at a time as there are lanes.
#pragma once
#include "projection.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> inline Gaussian<Pack<S>> gaussians(const Model<S>& model, int64_t i, int count) {
    Gaussian<Pack<S>> g;
    gather_rows(model.means + 3 * i, 3, count, g.mean);
    gather_rows(model.quats + 4 * i, 4, count, g.quat);
    gather_rows(model.scales + 3 * i, 3, count, g.scale);
    return g;
}

// Whether `unsound` has nothing to say.
template <class S> inline Which<S> all_sound(const Gaussian<Pack<S>>& g, Pack<S> opacity) {
    const Pack<S> big = sizeof(S) == 4 ? S(3.4e38) : S(1.7e308), far = S(kFarthest), wide = S(kWidest), zero = S(0);
    Which<S> fine = (opacity >= zero) & (opacity <= Pack<S>(S(1))), mean = fine, quat = fine;  // three chains: masks come late
    for (int k = 0; k < 3; ++k) mean = mean & (g.mean[k] <= far) & (g.mean[k] >= -far), fine = fine & (g.scale[k] <= wide) & (g.scale[k] >= zero);
    for (int k = 0; k < 4; ++k) quat = quat & (g.quat[k] <= big) & (g.quat[k] >= -big);
    return fine & mean & quat;
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
template <class P, class S> int64_t project_some(const ProjectArgs<S>& a, const KernelSettings<Pack<S>>& settings, const Stand<S>& stand, int64_t i, int count) {
    Pack<S> opacity;
    gather_rows(a.model.opacities + i, 1, count, &opacity);
    const Gaussian<Pack<S>> g = gaussians(a.model, i, count);
    if (!none(!all_sound(g, opacity))) {
        for (int64_t k = i; k < i + count; ++k) {
            const int wrong = unsound(gaussian(a.model, k), a.model.opacities[k]);
            if (wrong >= 0) return 4 * k + wrong;
        }
    }
    const Sight<Pack<S>> s = sight_of<P>(g, opacity, stand.position, stand.rotation, settings);
    const Pack<S> place[2] = {s.column, s.row};
    scatter_rows(place, 2, count, a.means2d + 2 * i);
    scatter_rows(&s.depth, 1, count, a.depths + i);
    const Pack<S> zero = S(0);
    Extents<Pack<S>> extents = extents_of(s.frame, settings);
    const Which<S> seen = (s.reach >= zero) & (extents.row1 > extents.row0);
    const Pack<S> ends[4] = {extents.row0, extents.row1, extents.column0, extents.columns};
    Pack<S> kept[4];
    for (int c = 0; c < 4; ++c) kept[c] = pick(seen, ends[c], zero);
    scatter_boxes(kept, count, a.boxes + i);
    const Pack<S> radius = pick(seen, s.radius, zero);
    scatter_rows(&radius, 1, count, a.radii + i);
    const unsigned bits = bits_of<S>(seen.lanes);
    for (int k = 0; k < count; ++k) a.visible[i + k] = bits >> k & 1;
    for (int c = 0; c < kRecord; c += 4) {
        for (int k = 0; k < 4; ++k) kept[k] = pick(seen, s.record[c + k], zero);
        scatter_fours(kept, kRecord, count, a.records + i * kRecord + c);
    }
    return -1;
}

template <class S> int64_t project_range(const ProjectArgs<S>& a, int begin, int end) {
    constexpr int n = Pack<S>::n;
    const auto settings = in_precision<Pack<S>>(a.settings);
    const Stand<S> stand(a.model, a.pose);
    return with_projection(a.settings.projection, [&](auto projection) -> int64_t {
        for (int64_t i = begin; i < end; i += n) {
            const int64_t wrong = project_some<decltype(projection)>(a, settings, stand, i, end - i < n ? int(end - i) : n);
            if (wrong >= 0) return wrong;
        }
        return -1;
    });
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

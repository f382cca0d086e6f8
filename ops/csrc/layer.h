// One layer at a block of pixels: its opacity, and the sums that carry its gradient.
#pragma once
#include "pixels.h"

namespace gsparc {
namespace GSPARC_ISA {

// Opacity of one layer at a block of pixels, before and after the clamp. Used by forward and backward alike, so that the
// transmittance of the second is that of the first, bit for bit: the light behind it is the light less light times alpha.
template <class S> struct Layer {
    Vec<S> shape, emits, alpha;

    GSPARC_INLINE Layer(Vec<S> form, Mask<S> counts, Vec<S> opacity, Vec<S> alpha_max) {
        shape = bell<S>(form);
        emits = opacity * shape;
        alpha = select(counts, lesser<S>(emits, alpha_max), splat(S(0)));
    }
};

// The sums of Moments over blocks of lanes.
template <class S, class P> struct MomentSums {
    Vec<S> tau1{}, tau2{}, h1{}, h2{}, tau11{}, tau12{}, tau22{}, emits{};

    // d_alpha: loss by opacity.
    GSPARC_INLINE void add(const Layer<S>& layer, Mask<S> counts, Vec<S> d_alpha, Vec<S> t1, Vec<S> t2, Vec<S> form, Vec<S> alpha_max) {
        const Vec<S> none = splat(S(0)), shape = select(counts, layer.shape, none);
        d_alpha = select(counts & at_most(layer.emits, alpha_max), d_alpha, none);
        emits = fma(d_alpha, shape, emits);
        const Vec<S> e = d_alpha * layer.alpha;
        t1 = select(counts, t1, none), t2 = select(counts, t2, none);
        const Vec<S> e1 = e * t1, e2 = e * t2;
        tau1 += e1, tau2 += e2;
        tau11 = fma(e1, t1, tau11), tau12 = fma(e1, t2, tau12), tau22 = fma(e2, t2, tau22);
        if (P::kCubic) {
            form = select(counts, form, none);
            h1 = fma(form, e1, h1), h2 = fma(form, e2, h2);
        }
    }
    // Offsets came in units of `unit`.
    GSPARC_INLINE void write(S* to, S unit = 1) const {
        const Vec<S> all[kMoments] = {tau1, tau2, h1, h2, tau11, tau12, tau22, emits};
        const S square = unit * unit, units[kMoments] = {unit, unit, unit * square, unit * square, square, square, square, 1};
        for (int k = 0; k < kMoments; ++k) to[k] = units[k] * sum<S>(all[k]);
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

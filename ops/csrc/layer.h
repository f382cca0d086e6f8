// One layer at a block of pixels: what it emits and hides, and the sums that carry its gradient.
#pragma once
#include "pixels.h"

namespace gsparc {
namespace GSPARC_ISA {

// Emitted and hidden share of one layer at a block of pixels. Used by forward and backward alike, so that the
// transmittance of the second is that of the first, bit for bit.
template <class S, bool kHides> struct Layer {
    Vec<S> shape, emits, hides, alpha, gamma;

    GSPARC_INLINE Layer(Vec<S> form, Mask<S> counts, Vec<S> opacity, Vec<S> extinction, Vec<S> alpha_max) {
        const Vec<S> none = splat(S(0));
        shape = bell<S>(form);
        emits = opacity * shape;
        alpha = select(counts, lesser<S>(emits, alpha_max), none);
        hides = kHides ? extinction * shape : emits;
        gamma = kHides ? select(counts, lesser<S>(hides, alpha_max), none) : alpha;
    }
    // The light that passes; weight is the light emitted, light times alpha.
    GSPARC_INLINE Vec<S> behind(Vec<S> light, Vec<S> weight) const { return kHides ? fma(-light, gamma, light) : light - weight; }
};

// The sums of Moments over blocks of lanes.
template <class S, class P, bool kHides> struct MomentSums {
    Vec<S> tau1{}, tau2{}, h1{}, h2{}, tau11{}, tau12{}, tau22{}, emits{}, hides{};

    // d_alpha, d_gamma: loss by emitted and hidden share; without kHides the first holds both.
    GSPARC_INLINE void add(const Layer<S, kHides>& layer, Mask<S> counts, Vec<S> d_alpha, Vec<S> d_gamma, Vec<S> t1, Vec<S> t2,
                           Vec<S> form, Vec<S> alpha_max) {
        const Vec<S> none = splat(S(0)), shape = select(counts, layer.shape, none);
        d_alpha = select(counts & at_most(layer.emits, alpha_max), d_alpha, none);
        emits = fma(d_alpha, shape, emits);
        Vec<S> e = d_alpha * layer.alpha;
        if (kHides) {
            d_gamma = select(counts & at_most(layer.hides, alpha_max), d_gamma, none);
            hides = fma(d_gamma, shape, hides);
            e = fma(d_gamma, layer.gamma, e);
        }
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
        const Vec<S> all[kMoments] = {tau1, tau2, h1, h2, tau11, tau12, tau22, emits, hides};
        const S square = unit * unit, units[kMoments] = {unit, unit, unit * square, unit * square, square, square, square, 1, 1};
        for (int k = 0; k < kMoments; ++k) to[k] = units[k] * sum<S>(all[k]);
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

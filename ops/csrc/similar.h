// Structural similarity at one place of two images (Wang et al. 2004, eq. 13), for vectors of places.
#pragma once
#ifndef GSPARC_LANES
#define GSPARC_LANES "simd.h"
#endif
#include GSPARC_LANES

namespace gsparc {
namespace GSPARC_ISA {

// m: windowed mean of p, of t, of p p, of t t and of p t, all about `shift`. Where `slope`, `by` becomes `share` times
// the derivatives by the windowed mean of p, of p p and of p t.
GSPARC_INLINE Vec<float> similar_at(const Vec<float> (&m)[5], float shift, float c1, float c2, float share, bool slope, Vec<float> (&by)[3]) {
    const Vec<float> none = splat(0.0f), raw = m[2] - m[0] * m[0];
    const Vec<float> spread = greater<float>(raw, none) + greater<float>(m[3] - m[1] * m[1], none) + c2;
    const Vec<float> covariance = 2.0f * (m[4] - m[0] * m[1]) + c2, light_p = m[0] + shift, light_t = m[1] + shift;
    const Vec<float> power = light_p * light_p + light_t * light_t + c1, product = 2.0f * light_p * light_t + c1;
    const Vec<float> similar = product * covariance / (power * spread);
    if (!slope) return similar;
    const Vec<float> by_cross = 2.0f * share * product / (power * spread);
    const Vec<float> by_square = select(at_most(none, raw), -share * similar / spread, none);  // only rounding makes a variance negative
    const Vec<float> by_light = 2.0f * share * (light_t * covariance / spread - light_p * similar) / power;
    by[0] = by_light - m[1] * by_cross - 2.0f * m[0] * by_square, by[1] = by_square, by[2] = by_cross;
    return similar;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

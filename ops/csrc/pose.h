// What a receiver's pose may be.
#pragma once
#include <math.h>

#ifndef GSPARC_HD
#define GSPARC_HD inline __attribute__((always_inline))
#endif

namespace gsparc {

constexpr double kFarthest = 1e6;  // FARTHEST in settings.py: of a pose or a Gaussian [m]
constexpr double kSkew = 2e-3;     // SKEW there: of the products of a rotation's columns

// Whether a pose stands within kFarthest and its matrix is a rotation, within the rounding of a written quaternion.
template <class S> GSPARC_HD bool sound_pose(const S* position, const S* r) {
    bool sound = true;  // comparisons that NaN fails
    for (int k = 0; k < 3; ++k) sound &= fabs(position[k]) <= S(kFarthest);
    for (int a = 0; a < 3; ++a) {
        for (int b = a; b < 3; ++b) {
            const S product = r[a] * r[b] + r[3 + a] * r[3 + b] + r[6 + a] * r[6 + b];
            sound &= fabs(product - S(a == b)) <= S(kSkew);
        }
        const int b = (a + 1) % 3, c = (a + 2) % 3;  // right-handed: each column is the product of the next two
        sound &= fabs(r[3 + b] * r[6 + c] - r[6 + b] * r[3 + c] - r[a]) <= S(2 * kSkew);
    }
    return sound;
}

}  // namespace gsparc

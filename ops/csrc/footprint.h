// The arithmetic of one Gaussian seen by one receiver, forward and backward: each formula exists once, here.
//
// Notation as in reference.py. x = R^T (mu - p), r = |x|, n = x / r; (e1, e2) east and north at n;
// a_i the Gaussian's axes and sigma_i = s_i / r its angular standard deviations;
// K the covariance of the footprint [px^2], area^2 its determinant before the low-pass.
//
// Standardised offsets of a pixel: tau1 = sqrt(A) (p - rho q), tau2 = sqrt(B) q with A = K22 / det, B = 1 / K22,
// rho = K12 / K22: then the exponent is -(tau1^2 + tau2^2) / 2, without cancellation along a needle.
#pragma once
#include <math.h>

#ifndef GSPARC_HD
#define GSPARC_HD inline __attribute__((always_inline))
#endif
#ifndef GSPARC_ISA
#define GSPARC_ISA baseline
#endif

#include "layout.h"
#ifdef GSPARC_PACKS
#include "pack.h"
#endif

namespace gsparc {
namespace GSPARC_ISA {

// S is a number, or lanes of numbers (pack.h): a choice is `pick`, and what is not picked may be anything.
template <class S> struct TruthOf {
    using type = bool;
};
template <class S> using Truth = typename TruthOf<S>::type;
#ifdef GSPARC_PACKS
template <class S> struct TruthOf<Pack<S>> {
    using type = Which<S>;
};
GSPARC_HD Pack<float> smallest(Pack<float>) { return 1.17549435e-38f; }
GSPARC_HD Pack<double> smallest(Pack<double>) { return 2.2250738585072014e-308; }
#endif
template <class S> GSPARC_HD S pick(bool which, S a, S b) { return which ? a : b; }

GSPARC_HD float root(float x) { return sqrtf(x); }
GSPARC_HD double root(double x) { return sqrt(x); }
GSPARC_HD float logarithm(float x) { return logf(x); }
GSPARC_HD double logarithm(double x) { return log(x); }
GSPARC_HD float upward(float x) { return ceilf(x); }
GSPARC_HD double upward(double x) { return ceil(x); }
GSPARC_HD float downward(float x) { return floorf(x); }
GSPARC_HD double downward(double x) { return floor(x); }
GSPARC_HD float smallest(float) { return 1.17549435e-38f; }
GSPARC_HD double smallest(double) { return 2.2250738585072014e-308; }

// atan2 to 3e-7 rad (Abramowitz and Stegun 4.4.49): the library's took half of the planning time.
template <class S> GSPARC_HD S short_angle(S y, S x) {
    const S ax = pick(x < 0, -x, x), ay = pick(y < 0, -y, y), long_side = pick(ax > ay, ax, ay);
    const S t = pick(long_side > 0, pick(ax > ay, ay, ax) / long_side, S(0)), s = t * t;
    S p = S(0.0028662257f);
    p = p * s - S(0.0161657367f), p = p * s + S(0.0429096138f), p = p * s - S(0.0752896400f), p = p * s + S(0.1065626393f);
    p = p * s - S(0.1420889944f), p = p * s + S(0.1999355085f), p = p * s - S(0.3333314528f);
    S a = t + t * s * p;
    a = pick(ay > ax, S(1.57079633f) - a, a);
    a = pick(x < 0, S(3.14159265f) - a, a);
    return pick(y < 0, -a, a);
}
GSPARC_HD float angle(float y, float x) { return short_angle(y, x); }
GSPARC_HD double angle(double y, double x) { return atan2(y, x); }
#ifdef GSPARC_PACKS
GSPARC_HD Pack<float> angle(Pack<float> y, Pack<float> x) { return short_angle(y, x); }
GSPARC_HD Pack<double> angle(Pack<double> y, Pack<double> x) { return each_lane<double>(y, x, angle); }
#endif
template <class S> GSPARC_HD S largest_of(S a, S b) { return pick(a > b, a, b); }
template <class S> GSPARC_HD S dot(const S* a, const S* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
template <class S> GSPARC_HD S clamped(S x, S low, S high) { return pick(x < low, low, pick(x > high, high, x)); }

constexpr double kShortestQuaternion = 1e-18;  // SHORTEST_QUATERNION in settings.py; shorter ones do not turn

// One Gaussian and one pose, both as they come: no derived quantity.
template <class S> struct Gaussian {
    S mean[3], quat[4], scale[3];
};

template <class S> struct Footprint {
    Truth<S> present;
    S r, n[3], e1[3], e2[3], cosine;        // cosine of the elevation
    S unit[4], norm;                        // quaternion of length 1 and the length it came with (0: undefined)
    S axis[3][3];                           // a_i, receiver frame
    S sigma[3], along1[3], along2[3], b[3]; // e1.a_i, e2.a_i, n.a_i
    S stretch1, stretch2;                   // px per radian
    S k11, k12, k22;                        // with the low-pass
    S y[3], length_y, area, det;
    S root_a, root_b, rho;
    S fade, compensation, gain;
};

template <class S> GSPARC_HD void rotation_of(const S* q, S m[9]) {
    const S w = q[0], x = q[1], y = q[2], z = q[3];
    m[0] = 1 - 2 * (y * y + z * z), m[1] = 2 * (x * y - w * z), m[2] = 2 * (x * z + w * y);
    m[3] = 2 * (x * y + w * z), m[4] = 1 - 2 * (x * x + z * z), m[5] = 2 * (y * z - w * x);
    m[6] = 2 * (x * z - w * y), m[7] = 2 * (y * z + w * x), m[8] = 1 - 2 * (x * x + y * y);
}

// P is a projection: a class in projection/.
template <class P, class S> GSPARC_HD Footprint<S> project(const Gaussian<S>& g, const S* position, const S* rotation, const KernelSettings<S>& settings) {
    Footprint<S> f;
    S x[3], d[3] = {g.mean[0] - position[0], g.mean[1] - position[1], g.mean[2] - position[2]};
    for (int k = 0; k < 3; ++k) x[k] = rotation[k] * d[0] + rotation[3 + k] * d[1] + rotation[6 + k] * d[2];
    f.r = root(dot(x, x));
    f.present = f.r > settings.near;  // of one that is not present the rest means nothing
    const S per_r = 1 / f.r;  // one division instead of many: they take longest
    for (int k = 0; k < 3; ++k) f.n[k] = x[k] * per_r;
    f.cosine = root(f.n[0] * f.n[0] + f.n[1] * f.n[1]);
    const S per_cosine = 1 / f.cosine, c0 = pick(f.cosine > 0, f.n[0] * per_cosine, S(1)), c1 = pick(f.cosine > 0, f.n[1] * per_cosine, S(0));
    f.e1[0] = -c1, f.e1[1] = c0, f.e1[2] = S(0);
    f.e2[0] = -f.n[2] * c0, f.e2[1] = -f.n[2] * c1, f.e2[2] = f.cosine;

    S longest = 0, square = 0;  // by the longest component first: squares of 1e-20 and 1e20 are no float32 numbers
    for (int k = 0; k < 4; ++k) longest = largest_of(longest, pick(g.quat[k] < 0, -g.quat[k], g.quat[k]));
    const Truth<S> usable = longest > S(kShortestQuaternion);
    const S per_longest = 1 / longest;
    for (int k = 0; k < 4; ++k) f.unit[k] = g.quat[k] * per_longest, square += f.unit[k] * f.unit[k];
    const S length = root(square), per_length = 1 / length;
    f.norm = pick(usable, longest * length, S(0));
    for (int k = 0; k < 4; ++k) f.unit[k] = pick(usable, f.unit[k] * per_length, S(k == 0));
    S turn[9];
    rotation_of(f.unit, turn);
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            f.axis[i][k] = rotation[k] * turn[i] + rotation[3 + k] * turn[3 + i] + rotation[6 + k] * turn[6 + i];

    f.stretch2 = 1 / settings.elevation_step;
    f.stretch1 = P::stretch(f, settings);
    f.k11 = settings.low_pass, f.k12 = S(0), f.k22 = settings.low_pass;
    S spread = 0;
    for (int i = 0; i < 3; ++i) {
        f.sigma[i] = g.scale[i] * per_r;
        f.along1[i] = dot(f.e1, f.axis[i]), f.along2[i] = dot(f.e2, f.axis[i]), f.b[i] = dot(f.n, f.axis[i]);
        const S v1 = f.stretch1 * f.along1[i] * f.sigma[i], v2 = f.stretch2 * f.along2[i] * f.sigma[i];
        f.k11 += v1 * v1, f.k12 += v1 * v2, f.k22 += v2 * v2;
        spread += v1 * v1 + v2 * v2;
    }
    // det(P M M^T P) = |cof(M)^T n|^2: exact for needles and pancakes, where k11 k22 - k12^2 cancels.
    for (int i = 0; i < 3; ++i) f.y[i] = f.sigma[(i + 1) % 3] * f.sigma[(i + 2) % 3] * f.b[i];
    f.length_y = root(dot(f.y, f.y));
    f.area = f.stretch1 * f.stretch2 * f.length_y;
    f.det = f.area * f.area + settings.low_pass * spread + settings.low_pass * settings.low_pass;
    f.present = f.present & (f.det > smallest(S())) & (f.k22 > smallest(S()));
    const S b = 1 / f.k22;
    f.root_a = root(f.k22 / f.det), f.root_b = root(b), f.rho = f.k12 * b;

    const S near = clamped((f.r - settings.near) * (1 / settings.near), S(0), S(1));
    f.fade = near * near * (3 - 2 * near);
    f.compensation = settings.compensate ? f.area / root(f.det) : S(1);
    f.gain = f.fade * f.compensation;
    return f;
}

// Sums over pixels of E = dL/d(exponent) times powers of the standardised offsets; h = tau1^2 + tau2^2.
template <class S> struct Moments {
    S tau1, tau2, h_tau1, h_tau2, tau11, tau12, tau22;
    S emits;  // sum of dL/d(alpha) G
};

template <class S> struct Gradients {
    S mean[3], quat[4], scale[3], opacity, screen[2];
};

template <class P, class S> GSPARC_HD Gradients<S> project_backward(
    const Footprint<S>& f, const Moments<S>& m, S opacity, const S* rotation, const KernelSettings<S>& settings) {
    Gradients<S> out;
    out.opacity = f.gain * m.emits;
    const Truth<S> smooth = P::smooth(f);

    // Slopes by p and q, then by the displacement (d1, d2) of n along (e1, e2) [rad].
    const S dp = f.root_a * m.tau1, dq = f.root_b * m.tau2 - f.root_a * f.rho * m.tau1;
    S g1, g2;
    P::displace(f, m, dp, dq, smooth, settings, g1, g2, out.screen);

    // (A, B, rho) and the gain -> (k11, k12, k22, area), written so that no square of det appears.
    const S g_gain = opacity * m.emits;
    const S b = f.root_b * f.root_b, g_rho = m.tau12 * f.root_a / f.root_b;
    const S g_k12 = g_rho * b;
    S g_det = m.tau11 / (2 * f.det), g_area = 0;
    if (settings.compensate) g_area = g_gain * f.fade / root(f.det), g_det -= g_gain * f.gain / (2 * f.det);
    g_area += 2 * f.area * g_det;
    const S g_k11 = settings.low_pass * g_det;
    const S g_k22 = b * ((m.tau22 - m.tau11) / 2 - g_rho * f.rho) + settings.low_pass * g_det;

    S g_sigma[3] = {0, 0, 0}, g_axis[3][3], g_stretch1 = 0, twist = 0;
    S g_b[3], g_cofactor[3];
    const S per_length = pick(f.length_y > 0, f.stretch1 * f.stretch2 * g_area / f.length_y, S(0));
    for (int i = 0; i < 3; ++i) {
        const S g_y = per_length * f.y[i];
        g_b[i] = g_y * f.sigma[(i + 1) % 3] * f.sigma[(i + 2) % 3];
        g_cofactor[i] = g_y * f.b[i];
    }
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        const S v1 = f.stretch1 * f.along1[i] * f.sigma[i], v2 = f.stretch2 * f.along2[i] * f.sigma[i];
        const S u1 = (2 * g_k11 * v1 + g_k12 * v2) * f.stretch1, u2 = (2 * g_k22 * v2 + g_k12 * v1) * f.stretch2;
        g_sigma[i] = u1 * f.along1[i] + u2 * f.along2[i] + g_cofactor[j] * f.sigma[k] + g_cofactor[k] * f.sigma[j];
        g_stretch1 += u1 * f.along1[i] * f.sigma[i] / f.stretch1;
        for (int c = 0; c < 3; ++c)
            g_axis[i][c] = f.sigma[i] * (u1 * f.e1[c] + u2 * f.e2[c]) + g_b[i] * f.n[c];
        // Parallel transport: e1 -> e1 - d1 n, e2 -> e2 - d2 n, n -> n + d1 e1 + d2 e2.
        g1 += g_b[i] * f.along1[i] - pick(smooth, u1 * f.sigma[i] * f.b[i], S(0));
        g2 += g_b[i] * f.along2[i] - pick(smooth, u2 * f.sigma[i] * f.b[i], S(0));
        twist += f.sigma[i] * (u1 * f.along2[i] - u2 * f.along1[i]);
    }
    P::turn(f, twist, g_area, g_stretch1, smooth, settings, g1, g2);

    S g_r = 0;
    for (int i = 0; i < 3; ++i) out.scale[i] = g_sigma[i] / f.r, g_r -= g_sigma[i] * f.sigma[i] / f.r;
    const S near = (f.r - settings.near) / settings.near;
    g_r += pick(near < 1, g_gain * f.compensation * 6 * near * (1 - near) / settings.near, S(0));
    S g_x[3];
    for (int c = 0; c < 3; ++c) g_x[c] = (g1 * f.e1[c] + g2 * f.e2[c]) / f.r + g_r * f.n[c];
    for (int c = 0; c < 3; ++c) out.mean[c] = dot(rotation + 3 * c, g_x);

    S t[9];  // dL/d(rotation of the Gaussian): column i is R g_axis[i]
    for (int i = 0; i < 3; ++i)
        for (int c = 0; c < 3; ++c) t[3 * c + i] = dot(rotation + 3 * c, g_axis[i]);
    const S w = f.unit[0], x = f.unit[1], y = f.unit[2], z = f.unit[3];
    const S g_unit[4] = {
        2 * (x * (t[7] - t[5]) + y * (t[2] - t[6]) + z * (t[3] - t[1])),
        2 * (y * (t[1] + t[3]) + z * (t[2] + t[6]) + w * (t[7] - t[5]) - 2 * x * (t[4] + t[8])),
        2 * (x * (t[1] + t[3]) + z * (t[5] + t[7]) + w * (t[2] - t[6]) - 2 * y * (t[0] + t[8])),
        2 * (x * (t[2] + t[6]) + y * (t[5] + t[7]) + w * (t[3] - t[1]) - 2 * z * (t[0] + t[4])),
    };
    const S radial = w * g_unit[0] + x * g_unit[1] + y * g_unit[2] + z * g_unit[3];
    for (int k = 0; k < 4; ++k) out.quat[k] = pick(f.norm > 0, (g_unit[k] - f.unit[k] * radial) / f.norm, S(0));
    return out;
}

// Squared reach of the footprint in standardised offsets, or negative if it reaches nothing.
template <class S> GSPARC_HD S reach2(const Footprint<S>& f, S opacity, const KernelSettings<S>& settings) {
    const S strength = f.gain * opacity, peak = settings.relative ? pick(strength > 0, S(1), S(0)) : strength;
    return pick((peak >= settings.alpha_min) & (peak > 0), 2 * logarithm(peak / settings.alpha_min), S(-1));
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

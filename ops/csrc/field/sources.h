// Channels as sums of sources, each a spherical wave whose gain is a process of places.
#pragma once
#include "../channels.h"
#include "../query.h"
#include "form.h"

namespace gsparc {
namespace GSPARC_ISA {

struct SourcesForm final : Form {
    static constexpr double kLight = 299792458.0, kNear = 0.001;  // of physics/waves.py
    int count, rows, outputs, antennas, still, padded;  // K, n, R; places of either end's antennas; n in whole lanes
    int combs;                                          // of evenly spaced tones
    double carrier;
    const double *middle, *moving;            // (3,), (antennas, 3) [m]: origin of the fit, antennas of the moving end
    const double *sources, *images;           // (K, 3), (still, K, 3) [m]: of the still end's middle, and of its antennas
    const double* offsets;                    // (still, 3) [m] of the still end's antennas, which gains depend on; none of one
    const double* comb;                       // (combs, 3): first [Hz], step [Hz], tones
    const float *by_angle, *by_length;        // (K,)
    const float *places, *towards;            // (D, padded), (K, 3, padded)
    const float *level, *weights;             // (K, 2 R), (K, 2 R, padded)
    const float* factors;                     // (A, 2), of the normalised channel

    struct Memory {
        double *delay, *nearness;
        float *squared, *varying, *gains, *phases, *scaled, *sums;
        Memory(const SourcesForm& f, int tones, Scratch& in) {
            delay = in.take<double>(f.count), nearness = in.take<double>(f.count);
            squared = in.take<float>(f.padded), varying = in.take<float>(f.padded);
            gains = in.take<float>(2 * int64_t(f.outputs) * f.count);
            const int64_t wide = padded_tones<float>(tones);
            phases = in.take<float>(kSourcesAtOnce * 2 * wide), scaled = in.take<float>(kSourcesAtOnce * 2 * int64_t(f.outputs));
            sums = in.take<float>(2 * f.outputs * wide);
        }
    };

    SourcesForm(const Blob& blob, Numbers& in) {
        facts.kind = GSPARC_CHANNEL;
        in.sizes(count, rows, outputs, antennas, still, combs);
        carrier = in.next();
        if (!count || !outputs || !antennas || !still || !combs || (antennas > 1 && still > 1)) refuse("a channel of no antennas");
        constexpr int widest = 16;
        padded = (rows + widest - 1) / widest * widest;
        const int axes = still > 1 ? 6 : 3;
        blob.read("middle", middle, 3);
        blob.read("moving", moving, int64_t(antennas) * 3);
        blob.read("sources", sources, int64_t(count) * 3);
        blob.read("images", images, int64_t(still) * count * 3);
        blob.read("combs", comb, int64_t(combs) * 3);
        blob.read("by_angle", by_angle, count);
        blob.read("by_length", by_length, count);
        blob.read("places", places, int64_t(axes) * padded);
        blob.read("towards", towards, int64_t(count) * 3 * padded);
        blob.read("level", level, int64_t(count) * 2 * outputs);
        blob.read("weights", weights, int64_t(count) * 2 * outputs * padded);
        blob.read("offsets", offsets, still > 1 ? int64_t(still) * 3 : 0);
        const int64_t entries = int64_t(antennas) * still * outputs;
        blob.read("factors", factors, 2 * entries);
        if (entries > INT32_MAX) refuse("%lld entries of a channel", (long long)entries);
        facts.axes = 3, facts.shape[0] = int(entries), facts.shape[1] = 0;
        int most = 0;
        for (int i = 0; i < combs; ++i) {
            const double tones = comb[3 * i + 2];
            if (!(tones >= 1 && tones <= 1 << 20) || facts.shape[1] > 1 << 20) refuse("a comb of %g tones", tones);
            facts.shape[1] += int(tones), most = tones > most ? int(tones) : most;
        }
        facts.values = 2 * int64_t(facts.shape[0]) * facts.shape[1];
        Scratch counted{0};
        Memory(*this, most, counted);
        facts.scratch = int64_t(counted.next);
    }

    int answer(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const override {
        for (int i = 0, at = 0; i < combs; at += int(comb[3 * i + 2]), ++i)
            sum(place, comb[3 * i], comb[3 * i + 1], int(comb[3 * i + 2]), facts.shape[1], at, values, scratch);
        if (variance) *variance = NAN;
        if (unknown) *unknown = NAN;
        return GSPARC_DONE;
    }

private:
    // Tones of one comb, written from number `at` on of `width`.
    void sum(const float* place, double first, double step, int tones_wanted, int width, int at, float* values, Scratch scratch) const {
        const Memory own(*this, tones_wanted, scratch);
        const Comb tuned{tones_wanted, first, step};
        const int wide = padded_tones<float>(tones_wanted), places_each = antennas * still;
        for (int e = 0; e < places_each; ++e) {
            const double* shift = moving + 3 * (antennas > 1 ? e : 0);
            double where[3];
            for (int axis = 0; axis < 3; ++axis) where[axis] = double(place[axis]) + shift[axis] - middle[axis];
            gains_at(where, e, own);
            memset(own.sums, 0, 2 * int64_t(outputs) * wide * sizeof(float));
            for (int k = 0; k < count; k += kSourcesAtOnce) {
                const int some = count - k < kSourcesAtOnce ? count - k : kSourcesAtOnce;
                if (some < kSourcesAtOnce) {
                    memset(own.phases, 0, kSourcesAtOnce * 2 * int64_t(wide) * sizeof(float));
                    memset(own.scaled, 0, kSourcesAtOnce * 2 * int64_t(outputs) * sizeof(float));
                }
                for (int i = 0; i < some; ++i) {
                    tones(tuned, own.delay[k + i], own.phases + 2 * int64_t(i) * wide);
                    for (int o = 0; o < 2 * outputs; ++o)
                        own.scaled[2 * i * outputs + o] = float(own.gains[int64_t(k + i) * 2 * outputs + o] * own.nearness[k + i]);
                }
                add_sources(outputs, wide, own.phases, own.scaled, own.sums);
            }
            for (int o = 0; o < outputs; ++o) {
                const float *re = own.sums + 2 * int64_t(o) * wide, *im = re + wide, *factor = factors + 2 * (int64_t(e) * outputs + o);
                float* to = values + 2 * ((int64_t(e) * outputs + o) * width + at);
                for (int t = 0; t < tones_wanted; ++t) {
                    const float scale = float(carrier / (first + t * step)), x = scale * re[t], y = scale * im[t];
                    to[2 * t] = x * factor[0] - y * factor[1], to[2 * t + 1] = x * factor[1] + y * factor[0];
                }
            }
        }
    }

    // Gains (K, 2 R), delays and 1 / range of all sources at antenna `e`, `where` in the frame of the fit.
    void gains_at(const double* where, int e, const Memory& own) const {
        constexpr int n = Lanes<float>::n;
        const Vec<float> one = splat(1.0f), least = splat(1e-9f);
        const int axes = still > 1 ? 6 : 3;
        for (int j = 0; j < padded; j += n) {
            Vec<float> squared = {};
            for (int axis = 0; axis < axes; ++axis) {
                const float own_axis = float(axis < 3 ? where[axis] : offsets[3 * e + axis - 3]);
                const Vec<float> apart = splat(own_axis) - load(places + int64_t(axis) * padded + j);
                squared = fma(apart, apart, squared);
            }
            store(own.squared + j, squared);
        }
        for (int k = 0; k < count; ++k) {
            const double* image = images + 3 * ((still > 1 ? int64_t(e) * count : 0) + k);
            double unit[3], range = 0, away = 0;
            for (int axis = 0; axis < 3; ++axis) {
                const double offset = where[axis] - image[axis];
                unit[axis] = where[axis] - sources[3 * k + axis];  // as the rows' are
                range += offset * offset, away += unit[axis] * unit[axis];
            }
            range = sqrt(range + kNear * kNear), away = sqrt(away) > 1e-6 ? sqrt(away) : 1e-6;
            own.delay[k] = range / kLight, own.nearness[k] = 1 / range;
            const Vec<float> x = splat(float(unit[0] / away)), y = splat(float(unit[1] / away)), z = splat(float(unit[2] / away));
            const float* to = towards + int64_t(k) * 3 * padded;
            const Vec<float> angle = splat(by_angle[k]), length = splat(by_length[k]);
            for (int j = 0; j < padded; j += n) {
                Vec<float> scaled = fma(load(own.squared + j), length, angle);
                scaled = fma(x, load(to + j), fma(y, load(to + padded + j), fma(z, load(to + 2 * int64_t(padded) + j), scaled)));
                const Vec<float> root = square_root<float>(greater<float>(scaled, least));
                store(own.varying + j, (one + root) * exponential(-root));
            }
            for (int o = 0; o < 2 * outputs; ++o) {
                const int64_t at = int64_t(k) * 2 * outputs + o;
                own.gains[at] = level[at] + dot(own.varying, weights + at * padded, padded);
            }
        }
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

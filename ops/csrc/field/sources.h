// Channels as sums of sources, each a spherical wave whose gain is a process of places; several searches are averaged.
#pragma once
#include "../channels.h"
#include "../query.h"
#include "clutter.h"
#include "form.h"

namespace gsparc {
namespace GSPARC_ISA {

struct SourcesForm final : Form {
    static constexpr double kLight = 299792458.0, kNear = 0.001;  // of physics/waves.py
    static constexpr int kWidest = 16;                            // lanes that arrays are padded for
    int count, rows, outputs, antennas, still, padded;  // K, n, R; places of either end's antennas; n in whole lanes
    int combs, searches;                                // of evenly spaced tones; that are averaged
    int tellers, wide, rank;                            // rows of the variance, in whole lanes; combinations of these
    int watchers, watching, blurred;                    // rows that tell who sees what, in whole lanes; sources of uncertain places
    int most = 0;                                       // tones of a comb
    bool angular;                                       // whether gains vary with directions, too
    // Constant share of gains; variances along and across their phases; of the noise; in the unit of answers. [Hz]
    double carrier, hertz, constant, lengthwise, across, noise, unit;
    Clutter clutter;
    const double *middle, *moving;            // (3,), (antennas, 3) [m]: origin of the fit, antennas of the moving end
    const double *sources, *images;           // (K, 3), (still, K, 3) [m]: of the still end's middle, and of its antennas
    const double* offsets;                    // (still, 3) [m] of the still end's antennas, which gains depend on; none of one
    const double* comb;                       // (combs, 3): first [Hz], step [Hz], tones
    const int32_t *counts, *teller, *blur;    // (searches,) sources of each; places of rows; numbers of uncertain sources
    const double* blur_by;                    // (K', 3, 3) [rad], what directions times are phases in units of their errors
    const float *shares, *by_angle, *by_length;        // (searches,), (K,), (K,)
    const float *places, *towards, *blur_rows;         // (D, padded), (K, 3, padded), (K', 3, padded)
    const float *level, *weights;                      // (K, 2 R), (K, 2 R, padded)
    const float *watch, *watch_by, *watch_level, *watch_weights;  // (3, watching), (K,), (K,), (K, watching)
    const float *phasor, *power, *there, *root;        // (K0, 2), (K0,), (K0, 2, wide), (rank, 2, wide) of the first search
    const float* factors;                              // (A, 2), of the normalised channel

    struct Memory {
        double *delay, *nearness;
        float *squared, *varying, *watched, *gains, *phases, *scaled, *sums, *total, *shared, *cross;
        Memory(const SourcesForm& f, Scratch& in) {
            const int64_t sum = 2 * int64_t(f.outputs) * padded_tones<float>(f.most);
            delay = in.take<double>(f.count), nearness = in.take<double>(f.count);
            squared = in.take<float>(f.padded), varying = in.take<float>(f.padded > f.watching ? f.padded : f.watching);
            watched = in.take<float>(f.watching), gains = in.take<float>(2 * int64_t(f.outputs) * f.count);
            phases = in.take<float>(kSourcesAtOnce * 2 * int64_t(padded_tones<float>(f.most)));
            scaled = in.take<float>(kSourcesAtOnce * 2 * int64_t(f.outputs));
            sums = in.take<float>(sum), total = in.take<float>(sum);
            shared = in.take<float>(f.wide), cross = in.take<float>(4 * int64_t(f.wide));
        }
    };
    struct Doubt {
        double left = 0, whole = 0;  // variance, and power expected without any rows
    };

    SourcesForm(const Blob& blob, Numbers& in) {
        facts.kind = GSPARC_CHANNEL;
        in.sizes(count, rows, outputs, antennas, still, combs, searches, tellers, rank, watchers, blurred);
        in.sizes(clutter.variants, clutter.steps, clutter.boxes, clutter.patches);
        angular = in.flag();
        in.values(carrier, hertz, constant, lengthwise, across, noise, unit);
        if (!count || !outputs || !antennas || !still || !combs || (antennas > 1 && still > 1)) refuse("a channel of no antennas");
        if (!(constant >= 0 && constant <= 1) || (blurred && constant == 1)) refuse("a constant share of %g", constant);
        padded = whole(rows), wide = whole(tellers), watching = whole(watchers);
        const int axes = still > 1 ? 6 : 3;
        blob.read("counts", counts, searches), blob.read("shares", shares, searches);
        int64_t sum = 0;
        for (int i = 0; i < searches; sum += counts[i++])
            if (counts[i] < 0) refuse("a search of %d sources", counts[i]);
        if (sum != count) refuse("%lld sources of searches, %d in all", (long long)sum, count);
        blob.read("middle", middle, 3);
        blob.read("moving", moving, int64_t(antennas) * 3);
        blob.read("sources", sources, int64_t(count) * 3);
        blob.read("images", images, int64_t(still) * count * 3);
        blob.read("combs", comb, int64_t(combs) * 3);
        blob.read("by_angle", by_angle, count);
        blob.read("by_length", by_length, count);
        blob.read("places", places, int64_t(axes) * padded);
        blob.read("towards", towards, angular ? int64_t(count) * 3 * padded : 0);
        blob.read("level", level, int64_t(count) * 2 * outputs);
        blob.read("weights", weights, int64_t(count) * 2 * outputs * padded);
        blob.read("offsets", offsets, still > 1 ? int64_t(still) * 3 : 0);
        blob.read("watch", watch, 3 * int64_t(watching));
        blob.read("watch_by", watch_by, watchers ? count : 0), blob.read("watch_level", watch_level, watchers ? count : 0);
        blob.read("watch_weights", watch_weights, int64_t(count) * watching);
        blob.read("blur", blur, blurred), blob.read("blur_by", blur_by, int64_t(blurred) * 9);
        blob.read("blur_rows", blur_rows, int64_t(blurred) * 3 * padded);
        const int64_t told = tellers ? counts[0] : 0;
        blob.read("teller", teller, tellers);
        for (int i = 0; i < tellers; ++i)
            if (teller[i] < 0 || teller[i] >= rows) refuse("row %d of %d", teller[i], rows);
        blob.read("phasor", phasor, 2 * told), blob.read("power", power, told);
        blob.read("there", there, told * 2 * wide), blob.read("root", root, int64_t(rank) * 2 * wide);
        if (clutter.boxes || clutter.patches) clutter.read(blob, count);
        const int64_t entries = int64_t(antennas) * still * outputs;
        blob.read("factors", factors, 2 * entries);
        if (entries > INT32_MAX) refuse("%lld entries of a channel", (long long)entries);
        facts.axes = 3, facts.shape[0] = int(entries), facts.shape[1] = 0;
        for (int i = 0; i < combs; ++i) {
            const double tones = comb[3 * i + 2];
            if (!(tones >= 1 && tones <= 1 << 20) || facts.shape[1] > 1 << 20) refuse("a comb of %g tones", tones);
            facts.shape[1] += int(tones), most = tones > most ? int(tones) : most;
        }
        facts.values = 2 * int64_t(facts.shape[0]) * facts.shape[1];
        facts.scratch = bytes_of<Memory>(*this);
    }

    int answer(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const override {
        const Memory own(*this, scratch);
        const bool doubts = tellers && (variance || unknown);
        const int each = antennas * still;
        Doubt all;
        for (int e = 0; e < each; ++e) {
            const double* shift = moving + 3 * (antennas > 1 ? e : 0);
            double where[3], apart = 0;
            for (int axis = 0; axis < 3; ++axis) where[axis] = double(place[axis]) + shift[axis] - middle[axis];
            const Doubt doubt = gains_at(where, e, doubts, own);
            for (int i = 0, at = 0; i < combs; at += int(comb[3 * i + 2]), ++i)
                apart += sum({int(comb[3 * i + 2]), comb[3 * i], comb[3 * i + 1]}, e, at, values, own);
            // What searches disagree about, mean over entries.
            apart /= double(outputs) * facts.shape[1];
            all.left += doubt.left + (apart > 0 ? apart : 0), all.whole += doubt.whole;
        }
        const double share = all.left / all.whole;
        if (variance) *variance = float(doubts ? unit * all.left / each : NAN);
        if (unknown) *unknown = float(!doubts ? NAN : share > 1 ? 1 : share);
        return GSPARC_DONE;
    }

private:
    static int whole(int size) { return (size + kWidest - 1) / kWidest * kWidest; }

    // Tones of one comb at antenna `e`, from number `at` on; returns what searches disagree about, summed over entries.
    double sum(const Comb& tuned, int e, int at, float* values, const Memory& own) const {
        const int padding = padded_tones<float>(tuned.tones);
        double apart = 0;
        memset(own.total, 0, 2 * int64_t(outputs) * padding * sizeof(float));
        for (int s = 0, k = 0, end; s < searches; ++s, k = end) {
            end = k + counts[s];
            memset(own.sums, 0, 2 * int64_t(outputs) * padding * sizeof(float));
            for (; k < end; k += kSourcesAtOnce) {
                const int some = end - k < kSourcesAtOnce ? end - k : kSourcesAtOnce;
                if (some < kSourcesAtOnce) {
                    memset(own.phases, 0, kSourcesAtOnce * 2 * int64_t(padding) * sizeof(float));
                    memset(own.scaled, 0, kSourcesAtOnce * 2 * int64_t(outputs) * sizeof(float));
                }
                for (int i = 0; i < some; ++i) {
                    tones(tuned, own.delay[k + i], own.phases + 2 * int64_t(i) * padding);
                    for (int o = 0; o < 2 * outputs; ++o)
                        own.scaled[2 * i * outputs + o] = float(own.gains[int64_t(k + i) * 2 * outputs + o] * own.nearness[k + i]);
                }
                add_sources(outputs, padding, own.phases, own.scaled, own.sums);
            }
            for (int o = 0; o < 2 * outputs; ++o)
                for (int64_t t = int64_t(o) * padding; t < int64_t(o) * padding + tuned.tones; ++t)
                    own.total[t] += shares[s] * own.sums[t], apart += double(shares[s]) * own.sums[t] * own.sums[t];
        }
        for (int o = 0; o < outputs; ++o) {
            const float *re = own.total + 2 * int64_t(o) * padding, *im = re + padding, *factor = factors + 2 * (int64_t(e) * outputs + o);
            float* to = values + 2 * ((int64_t(e) * outputs + o) * facts.shape[1] + at);
            for (int t = 0; t < tuned.tones; ++t) {
                const float scale = float(carrier / (tuned.first + t * tuned.step)), x = scale * re[t], y = scale * im[t];
                to[2 * t] = x * factor[0] - y * factor[1], to[2 * t + 1] = x * factor[1] + y * factor[0];
                apart -= double(re[t]) * re[t] + double(im[t]) * im[t];
            }
        }
        return searches > 1 ? apart : 0;
    }

    // Matern-3/2 of `squared` by length, and of what `more` adds, to `out`.
    template <class More> static void correlate(const float* squared, int padded, float by_length, More more, float* out) {
        constexpr int n = Lanes<float>::n;
        const Vec<float> one = splat(1.0f), least = splat(1e-9f), length = splat(by_length);
        for (int j = 0; j < padded; j += n) {
            const Vec<float> root = square_root<float>(greater<float>(more(j, load(squared + j) * length), least));
            store(out + j, (one + root) * exponential(-root));
        }
    }

    // Squared distances (padded,) of a place to places (axes, padded).
    static void squares(const double* where, const double* offset, int axes, const float* places, int padded, float* out) {
        constexpr int n = Lanes<float>::n;
        for (int j = 0; j < padded; j += n) {
            Vec<float> squared = {};
            for (int axis = 0; axis < axes; ++axis) {
                const Vec<float> apart = splat(float(axis < 3 ? where[axis] : offset[axis - 3])) - load(places + int64_t(axis) * padded + j);
                squared = fma(apart, apart, squared);
            }
            store(out + j, squared);
        }
    }

    // Gains (K, 2 R), delays and 1 / range of all sources at antenna `e`, `where` in the frame of the fit.
    Doubt gains_at(const double* where, int e, bool doubts, const Memory& own) const {
        squares(where, offsets + 3 * e, still > 1 ? 6 : 3, places, padded, own.squared);
        squares(where, nullptr, 3, watch, watching, own.watched);
        if (doubts) memset(own.cross, 0, 4 * int64_t(wide) * sizeof(float));
        const float place[3] = {float(where[0]), float(where[1]), float(where[2])};
        double prior = 0, unsure = noise;
        for (int k = 0, search = 0, first = 0, u = 0; k < count; ++k) {
            while (k - first >= counts[search]) first += counts[search++];
            const double* image = images + 3 * ((still > 1 ? int64_t(e) * count : 0) + k);
            double unit_vector[3], range = 0, away = 0;
            for (int axis = 0; axis < 3; ++axis) {
                const double offset = where[axis] - image[axis];
                unit_vector[axis] = where[axis] - sources[3 * k + axis];  // as the rows' are
                range += offset * offset, away += unit_vector[axis] * unit_vector[axis];
            }
            range = sqrt(range + kNear * kNear), away = sqrt(away) > 1e-6 ? sqrt(away) : 1e-6;
            own.delay[k] = range / kLight, own.nearness[k] = 1 / range;
            for (double& axis : unit_vector) axis /= away;
            const double share = share_at(k, search, place, own);
            const float* to = towards + int64_t(k) * 3 * padded;
            const Vec<float> x = splat(float(unit_vector[0])), y = splat(float(unit_vector[1])), z = splat(float(unit_vector[2]));
            const Vec<float> angle = splat(by_angle[k]);
            const auto by_direction = [&](int j, Vec<float> scaled) {
                return fma(x, load(to + j), fma(y, load(to + padded + j), fma(z, load(to + 2 * int64_t(padded) + j), scaled + angle)));
            };
            if (angular) correlate(own.squared, padded, by_length[k], by_direction, own.varying);
            else correlate(own.squared, padded, by_length[k], [](int, Vec<float> scaled) { return scaled; }, own.varying);
            const bool is_blurred = u < blurred && blur[u] == k;
            if (is_blurred) lose_coherence(u++, unit_vector, own.varying);
            for (int o = 0; o < 2 * outputs; ++o) {
                const int64_t at = int64_t(k) * 2 * outputs + o;
                own.gains[at] = float(share * (level[at] + dot(own.varying, weights + at * padded, padded)));
            }
            if (!doubts || search) continue;
            const Turned wave = turned(hertz * own.delay[k]) * Turned{phasor[2 * k], phasor[2 * k + 1]};
            const double most_power = power[k] * own.nearness[k] * own.nearness[k], by = share * own.nearness[k];
            add_cross(k, float(by * wave.re), float(by * wave.im), is_blurred ? 0 : float(constant), own);
            // Whether a source is seen has the variance p (1 - p); clutter hides for sure.
            prior += most_power * share * share, unsure += watchers ? most_power * share * (1 - share) : 0;
        }
        const double left = doubts ? prior - told(own) : 0;
        return {(left > 0 ? left : 0) + unsure, prior + unsure};
    }

    double share_at(int k, int search, const float* place, const Memory& own) const {
        if (clutter.boxes || clutter.patches) return clutter.share(k, search, place);
        if (!watchers) return 1;
        correlate(own.watched, watching, watch_by[k], [](int, Vec<float> scaled) { return scaled; }, own.varying);
        const float share = watch_level[k] + dot(own.varying, watch_weights + int64_t(k) * watching, watching);
        return share > 0 ? (share < 1 ? share : 1) : 0;
    }

    // What is uncertain of a source's place: its gain is alike only where its phase is.
    void lose_coherence(int u, const double* unit_vector, float* varying) const {
        constexpr int n = Lanes<float>::n;
        const Vec<float> ratio = splat(float(constant / (1 - constant))), half = splat(-0.5f);
        Vec<float> turns[3];
        for (int b = 0; b < 3; ++b) {
            double turn = 0;
            for (int a = 0; a < 3; ++a) turn -= unit_vector[a] * blur_by[9 * u + 3 * a + b];
            turns[b] = splat(float(turn));
        }
        for (int j = 0; j < padded; j += n) {
            Vec<float> squared = {};
            for (int b = 0; b < 3; ++b) {
                const Vec<float> apart = turns[b] - load(blur_rows + (int64_t(u) * 3 + b) * padded + j);
                squared = fma(apart, apart, squared);
            }
            store(varying + j, exponential(half * squared) * (ratio + load(varying + j)));
        }
    }

    // Real and imaginary part of a wave with those of rows, (2, 2, wide).
    void add_cross(int k, float re, float im, float base, const Memory& own) const {
        constexpr int n = Lanes<float>::n;
        for (int i = 0; i < tellers; ++i) own.shared[i] = base + float(1 - constant) * own.varying[teller[i]];
        for (int i = tellers; i < wide; ++i) own.shared[i] = 0;
        const float* row = there + int64_t(k) * 2 * wide;
        for (int j = 0; j < wide; j += n) {
            const Vec<float> by = load(own.shared + j), x = load(row + j) * by, y = load(row + wide + j) * by;
            const Vec<float> parts[4] = {splat(re) * x, splat(re) * y, splat(im) * x, splat(im) * y};
            for (int part = 0; part < 4; ++part) store(own.cross + int64_t(part) * wide + j, load(own.cross + int64_t(part) * wide + j) + parts[part]);
        }
    }

    // Power that the rows explain, of covariances along and across phases.
    double told(const Memory& own) const {
        for (int j = 0; j < wide; ++j) {
            float *first = own.cross + j, along = float(lengthwise), beside = float(across);
            const float a = first[0], b = first[wide], c = first[2 * int64_t(wide)], d = first[3 * int64_t(wide)];
            first[0] = along * a + beside * d, first[wide] = along * b - beside * c;
            first[2 * int64_t(wide)] = along * c - beside * b, first[3 * int64_t(wide)] = along * d + beside * a;
        }
        double explained = 0;
        for (int r = 0; r < rank; ++r)
            for (int part = 0; part < 2; ++part) {
                const double along = dot(root + int64_t(r) * 2 * wide, own.cross + int64_t(part) * 2 * wide, 2 * wide);
                explained += along * along;
            }
        return explained;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

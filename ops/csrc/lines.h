// What the walks over strips read: numbers of each row, and one line of memory for each Gaussian in depth order.
#pragma once
#include "spans.h"

namespace gsparc {
namespace GSPARC_ISA {

// What depends on the row alone. Directions are divided by the cosine of the elevation, so that an offset is a number
// of the column plus a number of the row: `rise` is the tangent of the elevation, `level` the horizon so divided.
// A projection may take another `rise`. A lane below the last row is NaN and passes no test.
template <class S> struct Rises {
    static constexpr int n = Lanes<S>::n;
    const int tiles, strips;
    Buffer<S> plain, rise, level, middle, half;  // (strips, n) twice; a strip's rises are middle +- half, and a little: rounding may not cut a pixel off
    Buffer<S> tile_cos, tile_sin;                // (tiles + n): of the middle of a tile; NaN beyond the last
    const S across;                              // [rad] from there to its outermost columns
    const Tables<S> tables;
    const KernelSettings<Pack<S>> settings;

    template <class P> Rises(P, const KernelSettings<S>& settings)
        : tiles(tiles_across<S>(settings.width)), strips((settings.height + kStripRows - 1) / kStripRows), plain(table_size(settings)),
          rise(int64_t(strips) * n), level(int64_t(strips) * n), middle(strips), half(strips), tile_cos(tiles + n), tile_sin(tiles + n),
          across(S(kTileColumns<S> - 1) / 2 * settings.azimuth_step), tables(tables_at(settings, plain.data)), settings(in_precision<Pack<S>>(settings)) {
        fill_tables(settings, plain.data);
        const double columns = kTileColumns<S>, step = settings.azimuth_step;
        fill_circle(settings.first_azimuth + (columns - 1) / 2 * step, columns * step, tiles, tile_cos.data, tile_sin.data);
        for (int k = tiles; k < tiles + n; ++k) tile_cos[k] = tile_sin[k] = S(NAN);
        const S least = sizeof(S) == 4 ? S(1e-7) : S(1e-12);  // a row through the pole, seen from that close to it
        for (int strip = 0; strip < strips; ++strip) {
            S low = INFINITY, high = -INFINITY;
            for (int k = 0; k < n; ++k) {
                const int row = strip * kStripRows + k / kTileColumns<S>;
                const bool real = row < settings.height;
                const S cosine = real && tables.cos_row[row] > least ? tables.cos_row[row] : least;
                const S here = real ? P::rise(tables.sin_row[row], cosine, row) : S(NAN);
                rise[strip * n + k] = here, level[strip * n + k] = settings.horizon_cosine / cosine;
                if (here < low) low = here;
                if (here > high) high = here;
            }
            const S large = low < -high ? -low : high;
            middle[strip] = (low + high) / 2, half[strip] = (high - low) / 2 * S(1.0001) + (sizeof(S) == 4 ? S(2e-6) : S(1e-14)) * large;
        }
    }
};

// One Gaussian's line, side by side in depth order: its record up to the reach, then these. Offsets are in units of
// kOffset, so that their square is the number of halvings of the footprint, which `bell` takes.
constexpr double kOffset = 1.1774100225154747, kHalvings = 1 / (kOffset * kOffset);  // sqrt(2 log 2)
constexpr int kOpacity = 10, kFeatures = 12;

// Of all ranks: lines (P, N, width), K channels per pose, whole cache lines; and outlines (P, N, kOutline).
template <class S> struct Lines {
    static constexpr int n = Lanes<S>::n;
    const int width;
    Buffer<S> rows, outlines;

    template <class P> Lines(P, const PlanView<S>& plan, const Model<S>& model, const Rises<S>& stage, const S* features, int samples, int channels, int threads)
        : width(padded(kFeatures + per_pose(plan, samples, channels))), rows(int64_t(plan.poses) * plan.count * width, false),
          outlines(int64_t(plan.poses) * plan.count * kOutline, false) {
        constexpr int chunk = 512;
        const int chunks = (plan.count + chunk - 1) / chunk;
        auto fill = [&](int task, int) {
            const int pose = task / chunks, begin = task % chunks * chunk;
            const int end = begin + chunk < plan.shown[pose] ? begin + chunk : plan.shown[pose];
            const int first = plan.poses == 1 ? 0 : pose, count = plan.poses == 1 ? samples : 1;
            for (int rank = begin; rank < end; rank += n) {
                const int some = end - rank < n ? end - rank : n;
                const int64_t at = int64_t(pose) * plan.count + rank;
                for (int k = n; k < 2 * n && rank + k < end; ++k) {
                    const int64_t later = plan.order[at + k];
                    const S* soon = plan.records + (int64_t(pose) * plan.count + later) * kRecord;
                    __builtin_prefetch(soon), __builtin_prefetch(soon + kReach), __builtin_prefetch(model.opacities + later);
                    if (features) __builtin_prefetch(features + (int64_t(first) * plan.count + later) * channels);
                }
                fill_some<P>(plan, model, stage, pose, rank, some);
                for (int b = 0; b < count; ++b) {
                    S* to = rows.data + at * width + kFeatures + b * channels;
                    const S* from = features + int64_t(first + b) * plan.count * channels;
                    for (int k = 0; k < some; ++k, to += width) {
                        const S* mine = from + int64_t(plan.order[at + k]) * channels;
                        if (channels == 2) to[0] = mine[0], to[1] = mine[1];  // most often: a loop for two numbers costs more than they do
                        else for (int c = 0; c < channels; ++c) to[c] = mine[c];
                    }
                }
            }
        };
        parallel_for(plan.poses * chunks, threads, fill);
    }
    static int per_pose(const PlanView<S>& plan, int samples, int channels) {
        return plan.poses == 1 ? samples * channels : channels;
    }
    static int padded(int size) {
        constexpr int line = 64 / sizeof(S);
        return (size + line - 1) / line * line;
    }
    const S* of(const PlanView<S>& plan, int pose, int rank) const {
        return rows.data + (int64_t(pose) * plan.count + rank) * width;
    }

private:
    // Ranks [rank, rank + some): everything but their features.
    template <class P> void fill_some(const PlanView<S>& plan, const Model<S>& model, const Rises<S>& stage, int pose, int rank, int some) {
        const int64_t at = int64_t(pose) * plan.count + rank;
        int32_t who[n];
        S opacities[n];
        for (int k = 0; k < n; ++k) {
            who[k] = plan.order[at + (k < some ? k : some - 1)];
            opacities[k] = model.opacities[who[k]];
        }
        Pack<S> record[kRecord];
        gather_at(plan.records + int64_t(pose) * plan.count * kRecord, kRecord, who, kRecord, record);
        const Outline<Pack<S>> outline = P::outline(record, root(record[kReach]) * S(1.001), stage.settings);  // a little larger than life
        const Pack<S> numbers[kOutline] = {outline.column, outline.middle, outline.height, outline.lean, outline.width, outline.left, outline.right, outline.stretch};
        for (int c = 0; c < kOutline; c += 4) scatter_fours(numbers + c, kOutline, some, outlines.data + at * kOutline + c);
        record[kOpacity] = record[kGain] * Pack<S>(load(opacities));
        record[kReach] = record[kReach] * S(kHalvings);
        P::line(record, stage.tables.turn);
        for (int c = 0; c < kFeatures; c += 4) scatter_fours(record + c, width, some, rows.data + at * width + c);
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

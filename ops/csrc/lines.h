// What the walks over strips read: numbers of each row, and one line of memory for each Gaussian in depth order.
#pragma once
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kAhead = 16;  // lines of memory asked for that long before they are needed

// What depends on the row alone. Directions are divided by the cosine of the elevation, so that an offset is a number
// of the column plus a number of the row: `rise` is the tangent of the elevation, `level` the horizon so divided.
// For `equirect` rise is the row. A lane below the last row is NaN and passes no test.
template <class S> struct Rises {
    static constexpr int n = Lanes<S>::n;
    const int tiles, strips;
    Buffer<S> plain, rise, level, middle, half;  // (strips, n) twice; a strip's rises are middle +- half, and a little: rounding may not cut a pixel off
    const Tables<S> tables;

    explicit Rises(const Lens<S>& lens)
        : tiles(tiles_across<S>(lens.width)), strips((lens.height + kStripRows - 1) / kStripRows), plain(table_size(lens)),
          rise(int64_t(strips) * n), level(int64_t(strips) * n), middle(strips), half(strips), tables(tables_at(lens, plain.data)) {
        fill_tables(lens, plain.data);
        const S least = sizeof(S) == 4 ? S(1e-7) : S(1e-12);  // a row through the pole, seen from that close to it
        for (int strip = 0; strip < strips; ++strip) {
            S low = INFINITY, high = -INFINITY;
            for (int k = 0; k < n; ++k) {
                const int row = strip * kStripRows + k / kTileColumns<S>;
                const bool real = row < lens.height;
                const S cosine = real && tables.cos_row[row] > least ? tables.cos_row[row] : least;
                const S here = real ? (lens.tangent ? tables.sin_row[row] / cosine : S(row)) : S(NAN);
                rise[strip * n + k] = here, level[strip * n + k] = lens.horizon_cosine / cosine;
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
constexpr int kOpacity = 10, kExtinction = 11, kTiles = 12, kFeatures = 14;

// The tiles of a footprint: [first, last] and, where it goes on past the last column, [0, wrapped].
struct Range {
    int16_t first, last, wrapped, unused;
};
static_assert(sizeof(Range) <= 2 * sizeof(float), "it takes the place of two numbers of a line");

// Lines of all ranks: (P, N, width), K channels per pose; whole cache lines.
template <class S> struct Lines {
    const int width;
    Buffer<S> rows;

    Lines(const PlanView<S>& plan, const Model<S>& model, const Lens<S>& lens, const S* features, int samples, int channels, int threads)
        : width(padded(kFeatures + per_pose(plan, samples, channels))), rows(int64_t(plan.poses) * plan.count * width, false) {
        constexpr int chunk = 512;
        const int chunks = (plan.count + chunk - 1) / chunk;
        S units[kRecord];  // of a record's numbers
        for (int k = 0; k < kRecord; ++k) units[k] = k == kReach ? S(kHalvings) : k < 6 && (lens.tangent || k > 1) ? S(1 / kOffset) : S(1);
        auto fill = [&](int task, int) {
            const int pose = task / chunks, begin = task % chunks * chunk;
            const int end = begin + chunk < plan.shown[pose] ? begin + chunk : plan.shown[pose];
            const int first = plan.poses == 1 ? 0 : pose, count = plan.poses == 1 ? samples : 1;
            for (int rank = begin; rank < end; ++rank) {
                const int64_t at = int64_t(pose) * plan.count + rank, i = plan.order[at];
                S* row = rows.data + at * width;
                if (rank + kAhead < end) {
                    const int64_t later = plan.order[at + kAhead];
                    const S* soon = plan.records + (int64_t(pose) * plan.count + later) * kRecord;
                    __builtin_prefetch(soon), __builtin_prefetch(soon + kReach), __builtin_prefetch(model.opacities + later);
                    if (features) __builtin_prefetch(features + (int64_t(first) * plan.count + later) * channels);
                }
                const S* record = plan.records + (int64_t(pose) * plan.count + i) * kRecord;
                for (int k = 0; k < kRecord; ++k) row[k] = units[k] * record[k];
                if (!lens.tangent) row[3] = -row[2] * record[3];
                row[kOpacity] = record[kGain] * model.opacities[i];
                row[kExtinction] = model.extinctions ? record[kGain] * model.extinctions[i] : row[kOpacity];
                const Range range = range_of(plan.boxes[at], lens.width);
                memcpy(row + kTiles, &range, sizeof range);
                for (int b = 0; b < count; ++b)
                    for (int c = 0; c < channels; ++c)
                        row[kFeatures + b * channels + c] = features[(int64_t(first + b) * plan.count + i) * channels + c];
            }
        };
        parallel_for(plan.poses * chunks, threads, fill);
    }
    static int per_pose(const PlanView<S>& plan, int samples, int channels) {
        return plan.poses == 1 ? samples * channels : channels;
    }
    static Range range_of(const Box& box, int width) {
        constexpr int columns = kTileColumns<S>;
        const int end = box.column0 + box.columns;
        return {int16_t(box.column0 / columns), int16_t(((end < width ? end : width) - 1) / columns), int16_t(end > width ? (end - width - 1) / columns : -1), 0};
    }
    static int padded(int size) {
        constexpr int line = 64 / sizeof(S);
        return (size + line - 1) / line * line;
    }
    const S* of(const PlanView<S>& plan, int pose, int rank) const {
        return rows.data + (int64_t(pose) * plan.count + rank) * width;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

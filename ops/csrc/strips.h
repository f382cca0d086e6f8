// Walking a strip of rows: which blocks of pixels each footprint touches, front to back.
#pragma once
#include <math.h>
#include <string.h>

#include "kernels.h"
#include "pixels.h"
#include "pool.h"
#include "workspace.h"

namespace gsparc {
namespace GSPARC_ISA {

// A scope's memory, of zeros unless told; not std::vector, which would be compiled per instruction set under one name.
// It starts on a cache line: a vector across two of them costs twice, and more when read back.
template <class T> struct Buffer : Workspace<T> {
    explicit Buffer(int64_t size, bool zeros = true) : Workspace<T>(size) {
        if (zeros) memset(this->data, 0, size * sizeof(T));
    }
};

// A tile is a block of lanes: kStripRows rows of a strip by as many columns as there are lanes for.
template <class S> constexpr int kTileColumns = Lanes<S>::n / kStripRows;
template <class S> inline int tiles_across(int width) { return (width + kTileColumns<S> - 1) / kTileColumns<S>; }

// Where every tile's lanes lie; a lane beyond the grid is NaN and passes no test.
template <class S> struct TileTables {
    static constexpr int n = Lanes<S>::n, columns = kTileColumns<S>;
    const int tiles, strips;
    Buffer<S> plain, across, along;  // across: cos, sin, column of (tiles, n); along: cos, sin, row of (strips, n)
    const Tables<S> tables;

    explicit TileTables(const KernelSettings<S>& settings)
        : tiles(tiles_across<S>(settings.width)), strips((settings.height + kStripRows - 1) / kStripRows), plain(table_size(settings)),
          across(int64_t(3) * tiles * n), along(int64_t(3) * strips * n), tables(tables_at(settings, plain.data)) {
        fill_tables(settings, plain.data);
        for (int at = 0; at < tiles * n; ++at) {
            const int column = at / n * columns + at % columns;
            across[at] = tables.cos_column[column], across[tiles * n + at] = tables.sin_column[column];
            across[2 * tiles * n + at] = tables.column[column];
        }
        for (int at = 0; at < strips * n; ++at) {
            const int row = at / n * kStripRows + at % n / columns;
            const bool real = row < settings.height;
            along[at] = real ? tables.cos_row[row] : S(NAN), along[strips * n + at] = real ? tables.sin_row[row] : S(NAN);
            along[2 * strips * n + at] = real ? S(row) : S(NAN);
        }
    }
    GSPARC_INLINE void strip(int index, Place<S>& at) const {
        const S* from = along.data + index * n;
        at.cos_row = load(from), at.sin_row = load(from + strips * n), at.row = load(from + 2 * strips * n);
    }
    GSPARC_INLINE void tile(int index, Place<S>& at) const {
        const S* from = across.data + index * n;
        at.cos_column = load(from), at.sin_column = load(from + tiles * n), at.column = load(from + 2 * tiles * n);
    }
};

// What one strip needs to know of the plan.
template <class S> struct Strip {
    int pose, row0, row1, index;
    const int32_t *first, *last;
    const Box* boxes;
    const S* records;
    const int32_t* order;
    const int64_t* slots;

    Strip() = default;
    Strip(const PlanView<S>& plan, int height, int task) {
        pose = task / plan.strips, index = task % plan.strips;
        row0 = index * kStripRows;
        row1 = row0 + kStripRows < height ? row0 + kStripRows : height;
        first = plan.entries + plan.strip_starts[task], last = plan.entries + plan.strip_starts[task + 1];
        boxes = plan.boxes + int64_t(pose) * plan.count, records = plan.records + int64_t(pose) * plan.count * kRecord;
        order = plan.order + int64_t(pose) * plan.count;
        slots = plan.slots + int64_t(pose) * (plan.count + 1);
    }
    int64_t slot(int rank) const { return slots[rank] + index - boxes[rank].row0 / kStripRows; }
};

// Calls visit(tile, tau1, tau2, form, counts) for each tile of the strip where a footprint counts in some lane:
// inside it, and wanted(tile). Without kSlopes tau1 and tau2 mean nothing. Tiles are first found without a branch,
// then visited: an unpredictable branch per tile costs as much as the visit.
template <class S, bool kTangent, bool kSlopes, class Wanted, class Visit>
GSPARC_INLINE void each_tile(const Strip<S>& strip, int rank, const TileTables<S>& grid, const KernelSettings<S>& settings, Wanted&& wanted, Visit&& visit) {
    constexpr int most = 16, n = Lanes<S>::n, kept = 3 * n;
    using View = RowView<S, kTangent>;
    const Runs runs = runs_of(strip.boxes[rank], settings.width);
    Place<S> at;
    grid.strip(strip.index, at);
    const View view(strip.records + int64_t(strip.order[rank]) * kRecord, at, grid.tables, settings);
    int hits[most];
    Mask<S> counts[most];
    alignas(64) S memory[most * kept];
    typename View::Seen seen;
    for (int run = 0; run < runs.count; ++run) {
        const int last = (runs.to[run] - 1) / kTileColumns<S>;
        for (int first = runs.from[run] / kTileColumns<S>; first <= last; first += most) {
            const int end = last < first + most ? last + 1 : first + most;
            int count = 0;
            for (int tile = first; tile < end; ++tile) {
                grid.tile(tile, at);
                const Mask<S> found = view.look(at, seen) & wanted(tile);
                view.keep(seen, kSlopes, memory + count * kept);
                hits[count] = tile, counts[count] = found;
                count += any(found);
            }
            for (int hit = 0; hit < count; ++hit) {
                view.recall(memory + hit * kept, kSlopes, seen);
                Vec<S> tau1, tau2;
                if (kSlopes) view.slopes(seen, tau1, tau2);
                visit(hits[hit], tau1, tau2, view.form(seen), counts[hit]);
            }
        }
    }
}

// For `wanted`: every tile.
template <class S> struct Always {
    GSPARC_INLINE Mask<S> operator()(int) const { return at_most(splat(S(0)), splat(S(0))); }
};

// Calls visit(tile, lane, pixel, count) for each row of each tile: `count` neighbours from lane and pixel on.
template <class S, class Visit> inline void each_stretch(const Strip<S>& strip, int width, Visit&& visit) {
    constexpr int columns = kTileColumns<S>;
    const int full = width / columns, rest = width % columns;
    for (int row = strip.row0; row < strip.row1; ++row) {
        const int lane = (row - strip.row0) * columns;
        const int64_t pixel = int64_t(row) * width;
        for (int tile = 0; tile < full; ++tile) visit(tile, lane, pixel + tile * columns, columns);
        if (rest) visit(full, lane, pixel + full * columns, rest);
    }
}

// A stretch of pixels, mostly as many as a tile has columns: a size that the compiler knows.
template <class S> GSPARC_INLINE void copy_stretch(S* to, const S* from, int count) {
    if (count == kTileColumns<S>) memcpy(to, from, kTileColumns<S> * sizeof(S));
    else memcpy(to, from, count * sizeof(S));
}

template <class S> inline void fill(S* to, int64_t size, S value) {
    for (int64_t i = 0; i < size; ++i) to[i] = value;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// What every kernel sees of a call: the grid, the Gaussians, and the plan as lists of Gaussians per tile.
#pragma once
#include "cuda/device.h"

#include "boxes.h"
#include "layer.h"

namespace gsparc {
namespace GSPARC_ISA {

// A tile is what one warp looks at at a time: a pixel a lane. A block of kWarps warps shares a tile.
constexpr int kTileWidth = 8, kTileHeight = 4, kWarps = 4, kBlock = kWarps * kWarp;
static_assert(kTileWidth * kTileHeight == kWarp, "a lane is a pixel");

// One call from Python (cuda.py holds the same structure). Addresses of 0 are absent tensors.
struct Call {
    int32_t twice, poses, count, samples, channels, capacity, device;
    int32_t whole[6];
    double real[10];
    uint64_t tensors[32];
    uint64_t scratch, stream;
};

template <class S> Lens<S> lens_of(const Call& c) {
    const int32_t* w = c.whole;
    const double* r = c.real;
    return {w[0], w[1], w[2] != 0, w[3] != 0, w[4] != 0, w[5] != 0, S(r[0]), S(r[1]), S(r[2]), S(r[3]),
            S(r[4]), S(r[5]), S(r[6]), S(r[7]), S(r[8]), S(r[9])};
}

// Reads addresses one after the other.
struct Reader {
    const Call& call;
    int at = 0;
    template <class T> T* next() { return reinterpret_cast<T*>(uintptr_t(call.tensors[at++])); }
};

// The plan's buffers. Slots are entries in the order of the ranks: the slots of one Gaussian lie together.
template <class S> struct View {
    int poses, count, tiles_x, tiles;  // tiles of one pose
    Lens<S> lens;
    Tables<S> tables;
    S* records;            // (P, N, kRecord), by Gaussian
    Box* boxes;            // (P, N), by Gaussian
    int32_t *order, *shown;  // (P, N) rank -> Gaussian, (P,) how many ranks are visible
    int64_t *slots, *total;  // (P, N + 1) first slot of each rank; how many there are in all
    int32_t *starts, *gaussians, *slot_of;  // (P tiles + 1) first entry of each tile; per entry (capacity)
    int capacity;

    // A plan made inside a captured graph may need more entries than were set aside: then nothing can be right.
    GSPARC_HD bool overflows() const { return *total > capacity; }
    GSPARC_HD int64_t first_slot(int pose, int rank) const {
        const int64_t slot = slots[int64_t(pose) * (count + 1) + rank];
        return slot < capacity ? slot : capacity;
    }
};

template <class S> View<S> read_view(Reader& in) {
    View<S> v;
    v.poses = in.call.poses, v.count = in.call.count, v.capacity = in.call.capacity;
    v.lens = lens_of<S>(in.call);
    v.tiles_x = (v.lens.width + kTileWidth - 1) / kTileWidth;
    v.tiles = v.tiles_x * ((v.lens.height + kTileHeight - 1) / kTileHeight);
    v.tables = tables_at(v.lens, static_cast<const S*>(in.next<S>()));
    v.records = in.next<S>(), v.boxes = in.next<Box>();
    v.order = in.next<int32_t>(), v.shown = in.next<int32_t>();
    v.slots = in.next<int64_t>(), v.total = in.next<int64_t>();
    v.starts = in.next<int32_t>();
    v.gaussians = v.starts ? v.starts + int64_t(v.poses) * v.tiles + 1 : nullptr;
    v.slot_of = v.starts ? v.gaussians + v.capacity : nullptr;
    return v;
}

template <class S> Model<S> read_model(Reader& in) {
    Model<S> m;
    m.means = in.next<const S>(), m.quats = in.next<const S>(), m.scales = in.next<const S>();
    m.opacities = in.next<const S>(), m.extinctions = in.next<const S>();
    m.positions = in.next<const S>(), m.rotations = in.next<const S>();
    return m;
}

// One lane's pixel of a tile.
template <class S, bool kTangent> struct Pixel {
    int row, column;
    bool real;               // false beyond the edge of the grid
    S east, north, up;       // its direction
    S number, turn, per_turn;

    GSPARC_HD Pixel(const View<S>& v, int tile_row, int tile_column, int lane) {
        row = tile_row * kTileHeight + lane / kTileWidth;
        column = tile_column * kTileWidth + lane % kTileWidth;
        real = row < v.lens.height && column < v.lens.width;
        const int in_row = row < v.lens.height ? row : v.lens.height - 1;
        number = v.tables.column[column];  // the tables are padded: NaN past the last column passes no test
        east = v.tables.cos_row[in_row] * v.tables.cos_column[column], north = v.tables.cos_row[in_row] * v.tables.sin_column[column];
        up = v.tables.sin_row[in_row];
        turn = v.tables.turn, per_turn = v.tables.per_turn;
    }
    // Standardised offsets of this pixel from the footprint of a record, and whether it lies inside.
    GSPARC_HD bool offsets(const S* record, const Lens<S>& lens, S& tau1, S& tau2, S& form) const {
        const Tables<S> circle = {nullptr, nullptr, nullptr, nullptr, nullptr, turn, per_turn};
        const Place<S> here = {S(1), up, S(row), east, north, number};  // the row's cosine is in the columns already
        const RowView<S, kTangent> view(record, here, circle, lens);
        typename RowView<S, kTangent>::Seen seen;
        const bool inside = view.look(here, seen);
        form = view.form(seen);
        view.slopes(seen, tau1, tau2);
        return inside && real;
    }
    GSPARC_HD int64_t place(const Lens<S>& lens) const { return int64_t(row) * lens.width + column; }
};

// Calls run(S()) with S double or float, on the call's device.
template <class F> int64_t with_scalar(const Call& call, F run) {
    if (const int64_t error = use_device(call.device)) return -error;
    return call.twice ? run(double()) : run(float());
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// What every kernel sees of a call: the grid, the Gaussians, and the plan as lists of Gaussians per tile.
#pragma once
#include "cuda/device.h"

#include "layer.h"
#include "projection.h"

namespace gsparc {
namespace GSPARC_ISA {

// A lane is a pixel of a tile. A block of kWarps warps shares a tile.
constexpr int kWarps = 4, kBlock = kWarps * kWarp;
static_assert(kTileWidth * kTileHeight == kWarp, "a lane is a pixel");

// The plan's buffers. Slots are entries in the order of the ranks: the slots of one Gaussian lie together.
template <class S> struct View {
    int poses, count, tiles_x, tiles;  // tiles of one pose
    KernelSettings<S> settings;
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

template <class S> View<S> read_view(const Call& call, Reader& in) {
    View<S> v;
    in.sizes(v.poses, v.count, v.capacity);
    v.settings = in_precision<S>(call.settings);
    v.tiles_x = (v.settings.width + kTileWidth - 1) / kTileWidth;
    v.tiles = v.tiles_x * ((v.settings.height + kTileHeight - 1) / kTileHeight);
    v.tables = tables_at(v.settings, static_cast<const S*>(in.next<S>()));
    in.read(v.records, v.boxes, v.order, v.shown, v.slots, v.total, v.starts);
    v.gaussians = v.starts ? v.starts + int64_t(v.poses) * v.tiles + 1 : nullptr;
    v.slot_of = v.starts ? v.gaussians + v.capacity : nullptr;
    return v;
}

// One lane's pixel of a tile.
template <class S, class P> struct Pixel {
    int row, column;
    bool real;               // false beyond the edge of the grid
    S east, north, up;       // its direction
    S number, turn, per_turn;

    GSPARC_HD Pixel(const View<S>& v, int tile_row, int tile_column, int lane) {
        row = tile_row * kTileHeight + lane / kTileWidth;
        column = tile_column * kTileWidth + lane % kTileWidth;
        real = row < v.settings.height && column < v.settings.width;
        const int in_row = row < v.settings.height ? row : v.settings.height - 1;
        number = v.tables.column[column];  // the tables are padded: NaN past the last column passes no test
        east = v.tables.cos_row[in_row] * v.tables.cos_column[column], north = v.tables.cos_row[in_row] * v.tables.sin_column[column];
        up = v.tables.sin_row[in_row];
        turn = v.tables.turn, per_turn = v.tables.per_turn;
    }
    // Standardised offsets of this pixel from the footprint of a record, and whether it lies inside.
    GSPARC_HD bool offsets(const S* record, const KernelSettings<S>& settings, S& tau1, S& tau2, S& form) const {
        const Tables<S> circle = {nullptr, nullptr, nullptr, nullptr, nullptr, turn, per_turn};
        const Place<S> here = {S(1), up, S(row), east, north, number};  // the row's cosine is in the columns already
        return P::offsets(record, here, circle, settings, tau1, tau2, form) && real;
    }
    GSPARC_HD int64_t place(const KernelSettings<S>& settings) const { return int64_t(row) * settings.width + column; }
};

// Calls run(S()) with S double or float, on the call's device.
template <class F> int64_t with_scalar(const Call& call, F run) {
    if (const int64_t error = use_device(call.device)) return -error;
    return call.twice ? run(double()) : run(float());
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// `gsparc_NAME`, called by Python: `result` of a `call` of scalars S.
#define GSPARC_ENTRY(name, result)                               \
    extern "C" int64_t gsparc_##name(const gsparc::Call* at) {   \
        using namespace gsparc::GSPARC_ISA;                      \
        const gsparc::Call& call = *at;                          \
        return with_scalar(call, [&](auto zero) -> int64_t {     \
            using S = decltype(zero);                            \
            return result;                                       \
        });                                                      \
    }

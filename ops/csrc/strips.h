// A strip of rows and its tiles of pixels.
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

// kTileColumns numbers, repeated for each row of a tile.
template <class S> GSPARC_INLINE Vec<S> spread(const S* p) {
    S lanes[Lanes<S>::n];
    for (int k = 0; k < Lanes<S>::n; ++k) lanes[k] = p[k % kTileColumns<S>];
    return load(lanes);
}
#if defined(__AVX512F__)
template <> GSPARC_INLINE Vec<float> spread<float>(const float* p) { return (Vec<float>)_mm512_broadcast_f32x4(_mm_loadu_ps(p)); }
template <> GSPARC_INLINE Vec<double> spread<double>(const double* p) { return (Vec<double>)_mm512_broadcast_f64x2(_mm_loadu_pd(p)); }
#elif defined(__AVX2__)
template <> GSPARC_INLINE Vec<float> spread<float>(const float* p) {
    double two;
    memcpy(&two, p, sizeof two);
    return (Vec<float>)_mm256_set1_pd(two);
}
template <> GSPARC_INLINE Vec<double> spread<double>(const double* p) { return (Vec<double>)_mm256_set1_pd(*p); }
#endif

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
        slots = plan.slots ? plan.slots + int64_t(pose) * (plan.count + 1) : nullptr;  // absent where only an image is made
    }
    int64_t slot(int rank) const { return slots[rank] + index - boxes[rank].row0 / kStripRows; }
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

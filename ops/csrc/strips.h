// Walking a strip of rows: which blocks of pixels each footprint touches, front to back.
#pragma once
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "kernels.h"
#include "pixels.h"
#include "pool.h"

namespace gsparc {
namespace GSPARC_ISA {

// Plain memory, freed at the end of the scope; std::vector would be compiled per instruction set under one name.
template <class T> struct Buffer {
    T* data;
    explicit Buffer(int64_t size) : data(static_cast<T*>(calloc(size > 0 ? size : 1, sizeof(T)))) {}
    ~Buffer() { free(data); }
    Buffer(const Buffer&) = delete;
    T& operator[](int64_t i) { return data[i]; }
};

template <class S> struct GridTables {
    Buffer<S> numbers;
    Tables<S> tables;

    explicit GridTables(const Lens<S>& lens) : numbers(table_size(lens)), tables(tables_at(lens, numbers.data)) {
        fill_tables(lens, numbers.data);
    }
};

// What one strip needs to know of the plan.
template <class S> struct Strip {
    int pose, row0, row1, index;
    const int32_t *first, *last;
    const Box* boxes;
    const S* records;
    const int64_t* slots;

    Strip(const PlanView<S>& plan, int height, int task) {
        pose = task / plan.strips, index = task % plan.strips;
        row0 = index * kStripRows;
        row1 = row0 + kStripRows < height ? row0 + kStripRows : height;
        first = plan.entries + plan.strip_starts[task], last = plan.entries + plan.strip_starts[task + 1];
        boxes = plan.boxes + int64_t(pose) * plan.count, records = plan.records + int64_t(pose) * plan.count * kRecord;
        slots = plan.slots + int64_t(pose) * (plan.count + 1);
    }
    int64_t slot(int rank) const { return slots[rank] + index - boxes[rank].row0 / kStripRows; }
};

// Calls visit(offset into the strip's padded rows, tau1, tau2, form, inside) for each block a footprint touches.
template <class S, bool kTangent, class Visit>
GSPARC_INLINE void each_block(const Strip<S>& strip, int rank, const Tables<S>& tables, const Lens<S>& lens, int stride, Visit&& visit) {
    const Box box = strip.boxes[rank];
    const S* record = strip.records + int64_t(rank) * kRecord;
    const Runs runs = runs_of(box, lens.width);
    const int begin = box.row0 > strip.row0 ? box.row0 : strip.row0, end = box.row1 < strip.row1 ? box.row1 : strip.row1;
    for (int row = begin; row < end; ++row) {
        const RowView<S, kTangent> view(record, row, tables, lens);
        for (int run = 0; run < runs.count; ++run)
            for (int column = runs.from[run]; column < runs.to[run]; column += Lanes<S>::n) {
                Vec<S> tau1, tau2, form;
                Mask<S> inside;
                if (view.offsets(column, tau1, tau2, form, inside)) visit((row - strip.row0) * stride + column, tau1, tau2, form, inside);
            }
    }
}

// Opacity, extinction and features of each rank side by side: (P, N, 2 + K), K channels per pose.
template <class S> struct Ranked {
    int width;
    Buffer<S> rows;

    Ranked(const PlanView<S>& plan, const Model<S>& model, const S* features, int samples, int channels, int threads)
        : width(2 + per_pose(plan, samples, channels)), rows(int64_t(plan.poses) * plan.count * width) {
        constexpr int chunk = 512;
        const int chunks = (plan.count + chunk - 1) / chunk;
        auto fill = [&](int task, int) {
            const int pose = task / chunks, begin = task % chunks * chunk;
            const int end = begin + chunk < plan.shown[pose] ? begin + chunk : plan.shown[pose];
            const int first = plan.poses == 1 ? 0 : pose, count = plan.poses == 1 ? samples : 1;
            for (int rank = begin; rank < end; ++rank) {
                const int64_t at = int64_t(pose) * plan.count + rank, i = plan.order[at];
                S* row = rows.data + at * width;
                const S gain = plan.records[at * kRecord + kGain];
                row[0] = gain * model.opacities[i];
                row[1] = model.extinctions ? gain * model.extinctions[i] : row[0];
                for (int b = 0; b < count; ++b)
                    for (int c = 0; c < channels; ++c)
                        row[2 + b * channels + c] = features[(int64_t(first + b) * plan.count + i) * channels + c];
            }
        };
        parallel_for(plan.poses * chunks, threads, fill);
    }
    static int per_pose(const PlanView<S>& plan, int samples, int channels) {
        return plan.poses == 1 ? samples * channels : channels;
    }
    const S* of(const PlanView<S>& plan, int pose, int rank) const {
        return rows.data + (int64_t(pose) * plan.count + rank) * width;
    }
};

// Whether any pixel of the strip still sees through.
template <class S> inline bool any_lit(const S* before, int size, S floor) {
    for (int i = 0; i < size; i += Lanes<S>::n)
        if (any(at_most(splat(floor), load(before + i)))) return true;
    return false;
}

inline int padded(int width) { return (width + 2 * kLanes - 1) / kLanes * kLanes; }

template <class S> inline void fill(S* to, int64_t size, S value) {
    for (int64_t i = 0; i < size; ++i) to[i] = value;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

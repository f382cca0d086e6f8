// The pixels of a grid, in lanes. A record is what a projection keeps of a footprint (9), then reach^2 and gain.
#pragma once
#include "footprint.h"

#ifndef GSPARC_LANES
#define GSPARC_LANES "simd.h"  // the CPU's vectors; a GPU thread is a vector of one lane
#endif
#include GSPARC_LANES

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kReach = 9, kGain = 10;

// Per-column and per-row numbers of a grid. Columns are padded with NaN: a lane past the edge passes no test.
template <class S> struct Tables {
    const S *cos_column, *sin_column, *column;  // (width + kLanes)
    const S *cos_row, *sin_row;                 // (height)
    S turn, per_turn;                           // columns in a full circle and its inverse
};

template <class S> GSPARC_HD int64_t table_size(const KernelSettings<S>& settings) { return 3 * int64_t(settings.width + kLanes) + 2 * settings.height; }

// Tables over numbers (table_size) that `fill_tables` has filled.
template <class S> inline Tables<S> tables_at(const KernelSettings<S>& settings, const S* numbers) {
    const int padded = settings.width + kLanes;
    const S turn = settings.periodic ? S(settings.width) : S(6.283185307179586) / settings.azimuth_step;
    return {numbers, numbers + padded, numbers + 2 * padded, numbers + 3 * padded, numbers + 3 * padded + settings.height, turn, 1 / turn};
}

// cos and sin of first + k step for k < count, to 1e-15: some by the library, those between by turning.
template <class S> inline void fill_circle(double first, double step, int count, S* cosines, S* sines) {
    const double c = cos(step), s = sin(step);
    double x = 0, y = 0;
    for (int k = 0; k < count; ++k) {
        const double turned = x * c - y * s;
        y = x * s + y * c, x = turned;
        if (k % 8 == 0) x = cos(first + k * step), y = sin(first + k * step);
        cosines[k] = S(x), sines[k] = S(y);
    }
}

template <class S> inline void fill_tables(const KernelSettings<S>& settings, S* numbers) {
    const int padded = settings.width + kLanes;
    fill_circle(double(settings.first_azimuth), double(settings.azimuth_step), settings.width, numbers, numbers + padded);
    for (int j = 0; j < padded; ++j) {
        if (j >= settings.width) numbers[j] = S(NAN), numbers[padded + j] = S(NAN);
        numbers[2 * padded + j] = j < settings.width ? S(j) : S(NAN);
    }
    fill_circle(double(settings.first_elevation), double(settings.elevation_step), settings.height, numbers + 3 * padded, numbers + 3 * padded + settings.height);
}

// Where a block of pixels lies: a lane each. NaN in a lane beyond the grid.
template <class S> struct Place {
    Vec<S> cos_row, sin_row, row, cos_column, sin_column, column;
};

// A footprint's columns as at most two runs [from, to) of the row; each pixel occurs once, also when blocks of
// columns overhang, because a box within kLanes of the full circle was widened to it.
struct Runs {
    int from[2], to[2], count;
};
GSPARC_INLINE Runs runs_of(const Box& box, int width) {
    const int end = box.column0 + box.columns;
    if (end <= width) return {{box.column0, 0}, {end, 0}, 1};
    return {{box.column0, 0}, {width, end - width}, 2};
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

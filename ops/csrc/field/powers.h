// Powers: a process of decibels about a law, given all rows or the nearest.
#pragma once
#include <math.h>

#include "../query.h"
#include "form.h"

namespace gsparc {
namespace GSPARC_ISA {

// The nearest so far, in order.
struct Found {
    double* squared;
    int64_t* row;
    int size, most;
    double limit() const { return size < most ? INFINITY : squared[most - 1]; }
    void offer(double far, int64_t number) {
        if (far >= limit()) return;
        int at = size < most ? size++ : most - 1;
        for (; at > 0 && squared[at - 1] > far; --at) squared[at] = squared[at - 1], row[at] = row[at - 1];
        squared[at] = far, row[at] = number;
    }
};

// Rows [first, first + count) in 2^depth leaves, and the boxes of all nodes, the root first: node i has 2 i + 1 and 2 i + 2.
struct Tree {
    int64_t first, count, near, depth;
    const double* boxes;  // (nodes, 2, D)

    int64_t end_of(int64_t leaf) const { return first + count * (leaf + 1) / (int64_t(1) << depth); }
    static double beyond(const double* box, const double* at, int axes) {
        double squared = 0;
        for (int axis = 0; axis < axes; ++axis) {
            const double low = box[axis] - at[axis], high = at[axis] - box[axes + axis], out = low > high ? low : high;
            squared += out > 0 ? out * out : 0;
        }
        return squared;
    }
    void search(const double* places, const double* at, int axes, int64_t node, int64_t level, Found& found) const {
        if (level == depth) {
            const int64_t leaf = node - ((int64_t(1) << depth) - 1);
            for (int64_t row = leaf ? end_of(leaf - 1) : first; row < end_of(leaf); ++row) {
                double squared = 0;
                for (int axis = 0; axis < axes; ++axis) squared += (places[row * axes + axis] - at[axis]) * (places[row * axes + axis] - at[axis]);
                found.offer(squared, row);
            }
            return;
        }
        const int64_t left = 2 * node + 1;
        const double far[2] = {beyond(boxes + left * 2 * axes, at, axes), beyond(boxes + (left + 1) * 2 * axes, at, axes)};
        const int nearer = far[1] < far[0];
        for (int turn = 0; turn < 2; ++turn) {
            const int side = turn ? 1 - nearer : nearer;
            if (far[side] < found.limit()) search(places, at, axes, left + side, level + 1, found);
        }
    }
};

struct PowersForm final : Form {
    static constexpr int kMostTerms = 2, kMostSets = 24;
    int rows, near, sets, terms;
    bool all, whole, bounded, law;  // means of all rows; variances by all; these at most the prior's; a distance law
    Correlation<double> kernel;
    double noise, amplitude, heard, reach, level, exponent, floor, middle, spread, scale, doubted;  // the last: the level's column
    const double *places, *columns, *extra;   // (n, D), (D, padded) [m], (n,) noise
    const double *values, *slopes;            // (n,) by which weights or correlations count, (n, Q) terms of the rows
    const double *weighed, *unsure;           // (Q,), (Q, Q): weights of the law's terms, and their covariance
    const double* still;                      // (D,) [m]; none where both ends move
    const double* root;                       // rows of the inverse factor, (n (n + 1) / 2,)
    Tree trees[kMostSets];

    int padded() const { return whole_lanes<double>(rows); }

    struct Memory {
        double *far, *correlated, *squared, *weights;
        int64_t* row;
        Memory(const PowersForm& f, Scratch& in) {
            const int all = f.all || f.whole ? (f.rows + 7) / 8 * 8 : 0;
            far = in.take<double>(all), correlated = in.take<double>(all);
            squared = in.take<double>(f.near), weights = in.take<double>(f.near), row = in.take<int64_t>(f.near);
        }
    };

    PowersForm(const Blob& blob, Numbers& in) {
        facts.kind = GSPARC_POWER, facts.shape[0] = facts.shape[1] = 1, facts.values = 1;
        facts.axes = in.size(6);
        rows = in.size(1 << 26);
        in.sizes(near, sets, terms);
        all = in.flag(), whole = in.flag(), bounded = in.flag(), law = in.flag();
        kernel.smooth = 0, kernel.smooth_length = 1, kernel.parts = in.size(2);
        for (int i = 0; i < 2; ++i) in.values(kernel.shares[i], kernel.lengths[i]);
        in.values(noise, amplitude, heard, reach, level, exponent, floor, middle, spread, scale, doubted);
        const int64_t n = rows, axes = facts.axes;
        if (!rows || !axes || sets > kMostSets || terms > kMostTerms || terms < 1 || (near && !sets)) refuse("a process of no rows");
        constexpr int widest = 8;
        blob.read("places", places, n * axes);
        blob.read("columns", columns, all || whole ? axes * ((n + widest - 1) / widest * widest) : 0);
        blob.read("extra", extra, n);
        blob.read("values", values, n);
        blob.read("slopes", slopes, n * terms);
        blob.read("weighed", weighed, terms);
        blob.read("unsure", unsure, int64_t(terms) * terms);
        blob.read("still", still, law && axes == 3 ? 3 : 0);
        blob.read("root", root, whole ? n * (n + 1) / 2 : 0);
        const int64_t* numbers;
        const double* boxes;
        int64_t first = 0, nodes = 0, found = 0;
        blob.read("sets", numbers, 3 * int64_t(sets));
        for (int i = 0; i < sets; ++i) {
            Tree& tree = trees[i];
            tree.first = first, tree.count = numbers[3 * i], tree.near = numbers[3 * i + 1], tree.depth = numbers[3 * i + 2];
            if (tree.count < 1 || tree.count > n - first || tree.near < 0 || tree.near > tree.count || tree.depth < 0 || tree.depth > 26)
                refuse("a set of rows beyond them");
            first += tree.count, found += tree.near, nodes += (int64_t(2) << tree.depth) - 1;
        }
        if (sets && (first != n || found != near)) refuse("sets of rows that are not all");
        blob.read("boxes", boxes, nodes * 2 * axes);
        for (int i = 0; i < sets; ++i) trees[i].boxes = boxes, boxes += ((int64_t(2) << trees[i].depth) - 1) * 2 * axes;
        facts.scratch = bytes_of<Memory>(*this) + bytes_of<NearestMemory<double>>(nearest_args());
    }

    int answer(const float* place, float* values_out, float* variance, float* unknown, Scratch scratch) const override {
        double at[6] = {}, terms_here[kMostTerms] = {doubted};
        for (int axis = 0; axis < facts.axes; ++axis) at[axis] = double(place[axis]);
        double mean = level;
        if (law) {
            double squared = 0;
            for (int axis = 0; axis < 3; ++axis) {
                const double offset = at[axis] - (still ? still[axis] : at[3 + axis]);
                squared += offset * offset;
            }
            const double decades = 0.5 * log10(squared > floor * floor ? squared : floor * floor);
            mean -= 10 * exponent * decades;
            if (terms > 1) terms_here[1] = (decades - middle) / spread;
        }
        for (int q = 0; q < terms; ++q) mean += terms_here[q] * weighed[q];
        const Memory own(*this, scratch);
        double nearest = INFINITY;
        if (all || whole) nearest = correlate(at, own);
        if (all) mean += dot(values, own.correlated, rows);
        const bool doubt = (variance || unknown) && facts.error == 0;  // a process given a model's answers is surer than the model
        if (variance) *variance = NAN;
        if (unknown) *unknown = NAN;
        double left = 0;
        if (!all || (doubt && !whole)) {
            double gained = 0;
            const double closest = given_nearest(at, terms_here, own, scratch, gained, left);
            if (closest < 0) return GSPARC_UNSOLVED;
            nearest = closest < nearest ? closest : nearest;
            if (!all) mean += gained;
        }
        const double power = scale * pow(10.0, 0.1 * mean);
        *values_out = float(power);
        if (!doubt) return GSPARC_DONE;
        double prior = 1 + noise;
        for (int q = 0; q < terms; ++q) prior += terms_here[q] * terms_here[q];
        if (whole) left = prior - told_by_all(terms_here, own);
        left = left < 0 ? 0 : left;
        if (bounded && left > prior) left = prior;
        const double slope = 0.23025850929940457 * power, most = heard > 1 + noise ? heard : 1 + noise, far = nearest / reach;
        const double lost = left / most + (1 - (1 + noise) / most) * (1 - exp(-far * far));
        if (variance) *variance = float(amplitude * left * slope * slope);
        if (unknown) *unknown = float(lost > 1 ? 1 : lost);
        return GSPARC_DONE;
    }

private:
    NearestArgs<double> nearest_args() const {
        NearestArgs<double> args;
        args.axes = facts.axes, args.near = near, args.kernel = kernel, args.places = places, args.noise = extra;
        return args;
    }

    // Correlations with all rows into `own.correlated`; returns the least distance.
    double correlate(const double* at, const Memory& own) const {
        constexpr int n = Lanes<double>::n;
        const int64_t stride = (rows + 7) / 8 * 8;
        Vec<double> least = splat(1e300);
        for (int64_t j = 0; j < stride; j += n) {
            Vec<double> squared = {};
            for (int axis = 0; axis < facts.axes; ++axis) {
                const Vec<double> apart = splat(at[axis]) - load(columns + axis * stride + j);
                squared = fma(apart, apart, squared);
            }
            least = lesser<double>(least, squared);
            store(own.correlated + j, square_root<double>(squared));
        }
        double lanes[n], smallest = 1e300;
        store(lanes, least);
        for (double one : lanes) smallest = one < smallest ? one : smallest;
        kernel.apply(own.correlated, rows, own.far);
        return sqrt(smallest);
    }

    // The nearest rows' part of the mean, and the variance that they leave; returns the least distance, -1 where unsolved.
    double given_nearest(const double* at, const double* terms_here, const Memory& own, Scratch scratch, double& mean, double& left) const {
        int used = 0;
        double nearest = INFINITY, known = 0;
        for (int i = 0; i < sets; ++i) {
            Found found{own.squared + used, own.row + used, 0, int(trees[i].near)};
            if (found.most) trees[i].search(places, at, facts.axes, 0, 0, found);
            used += found.size;
            if (found.size && found.squared[0] < nearest) nearest = found.squared[0];
        }
        NearestArgs<double> args = nearest_args();
        args.queries = at, args.rows = own.row, args.weights = own.weights, args.known = &known;
        if (used != near || !nearest_weights_of(args, 0, scratch)) return -1;
        double unsure_here[kMostTerms];
        for (int q = 0; q < terms; ++q) unsure_here[q] = terms_here[q];
        for (int i = 0; i < near; ++i) {
            mean += own.weights[i] * values[own.row[i]];
            for (int q = 0; q < terms; ++q) unsure_here[q] -= own.weights[i] * slopes[own.row[i] * terms + q];
        }
        left = 1 + noise - known;
        for (int p = 0; p < terms; ++p)
            for (int q = 0; q < terms; ++q) left += unsure_here[p] * unsure[p * terms + q] * unsure_here[q];
        left = left < 0 ? 0 : left;
        return sqrt(nearest);
    }

    double told_by_all(const double* terms_here, const Memory& own) const {
        for (int j = 0; j < rows; ++j)
            for (int q = 0; q < terms; ++q) own.correlated[j] += terms_here[q] * slopes[int64_t(j) * terms + q];
        double known = 0;
        const double* at = root;
        for (int i = 0; i < rows; at += ++i) {
            const double one = dot(at, own.correlated, i + 1);
            known += one * one;
        }
        return known;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

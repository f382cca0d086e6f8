// Spectra of a static array, from lag tables.
#pragma once
#include <string.h>

#include "../query.h"
#include "form.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> inline void read_features(const Blob& blob, Numbers& in, Features<S>& to) {
    in.sizes(to.axes, to.anchors, to.count);
    to.kernel.parts = 1;
    in.values(to.kernel.smooth, to.kernel.smooth_length, to.kernel.shares[0], to.kernel.lengths[0]);
    blob.read("at", to.at, int64_t(to.anchors) * to.axes);
    blob.read("whitening", to.whitening, int64_t(to.anchors) * to.count);
}

struct SpectrumForm final : Form {
    ArraySpectrumArgs<float> args;

    SpectrumForm(const Blob& blob, Numbers& in) {
        read_features(blob, in, args.process);
        args.elements = in.size(4096);
        in.sizes(args.height, args.columns, args.lags[0], args.waves[0], args.lags[1], args.waves[1]);
        const int64_t parts = 2 * int64_t(args.elements) + 2, lags = int64_t(args.lags[0]) + args.lags[1], height = args.height;
        blob.read("weights", args.weights, args.process.count * parts);
        blob.read("offset", args.offset, parts);
        blob.read("pairs", args.pairs, 2 * int64_t(args.elements) * args.elements * lags);
        for (int i = 0; i < 2; ++i) {
            blob.read(i ? "table1" : "table0", args.table[i], args.lags[i] * height * args.waves[i]);
            blob.read(i ? "wave1" : "wave0", args.wave[i], int64_t(args.waves[i]) * args.columns);
        }
        const int width = args.wave[1] ? 2 * args.columns : args.columns;
        blob.read("square", args.square, height * width);
        facts.kind = GSPARC_SPECTRUM, facts.axes = args.process.axes;
        facts.shape[0] = args.height, facts.shape[1] = width, facts.values = height * width;
        facts.scratch = bytes_of<ArraySpectrumMemory<float>>(args);
    }

    int answer(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const override {
        ArraySpectrumArgs<float> own = args;
        float share;
        own.places = place, own.image = values, own.unknown = &share;
        array_spectrum_of(own, 0, scratch);
        if (variance) *variance = NAN;
        if (unknown) *unknown = share;
        return GSPARC_DONE;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

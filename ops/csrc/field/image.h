// Images of a static receiver: features of a process, emissions linear in them, frozen weights of pixels.
#pragma once
#include <math.h>
#include <string.h>

#include "../thaw.h"
#include "spectrum.h"

namespace gsparc {
namespace GSPARC_ISA {

struct ImageForm final : Form {
    static constexpr int kColumns = 4, kBlock = kStripRows * kColumns;  // pixels of a block in the file
    Features<double> process;  // correlations cancel
    ThawArgs<float> view;
    int activation;           // 0 linear, 1 sigmoid, 2 softplus
    bool log_distance, inverse_distance, tells_unknown;
    float gain, least_squared, per_reference_squared;  // of attenuation; see GaussianModel.distances
    const float *weights, *offset, *means;             // (F, V), (V,), (V, 3) [m], of none where distances are not needed
    char* memory = nullptr;  // of blocks as wide as the machine's, where the file's are wider

    struct Memory {
        double *encoded, *known;
        float *features, *emitted, *cells;
        Memory(const ImageForm& f, Scratch& in) {
            encoded = in.take<double>(2 * whole_lanes<double>(f.process.anchors)), known = in.take<double>(f.process.count);
            features = in.take<float>(f.process.count);
            emitted = in.take<float>(f.view.seen), cells = in.take<float>(int64_t(tiles_across<float>(f.view.width)) * Lanes<float>::n);
        }
    };

    ImageForm(const Blob& blob, Numbers& in) {
        read_features(blob, in, process);
        in.sizes(view.seen, view.height, view.width, activation);
        log_distance = in.flag(), inverse_distance = in.flag(), tells_unknown = in.flag();
        in.values(gain, least_squared, per_reference_squared);
        blob.read("weights", weights, int64_t(process.count) * view.seen);
        blob.read("offset", offset, view.seen);
        blob.read("means", means, log_distance || inverse_distance ? 3 * int64_t(view.seen) : 0);
        view.channels = view.samples = view.threads = 1, view.given = view.seen, view.rows = nullptr;
        const int64_t across = (view.width + kColumns - 1) / kColumns, tiles = strips_of(view.height) * across;
        const int64_t blocks = blob.count("ranks");
        blob.read("starts", view.starts, tiles + 1);
        blob.read("ranks", view.ranks, blocks);
        blob.read("blocks", view.weights, blocks * kBlock);
        for (int64_t i = 0; i < tiles; ++i)
            if (view.starts[i] > view.starts[i + 1]) refuse("blocks of a tile end before they begin");
        if (view.starts[0] || view.starts[tiles] != blocks) refuse("blocks beyond the tiles");
        for (int64_t i = 0; i < blocks; ++i)
            if (view.ranks[i] < 0 || view.ranks[i] >= view.seen) refuse("a block of no Gaussian");
        if (Lanes<float>::n < kBlock) split(across, blocks);
        facts.kind = GSPARC_SPECTRUM, facts.axes = process.axes;
        facts.shape[0] = view.height, facts.shape[1] = view.width, facts.values = int64_t(view.height) * view.width;
        facts.scratch = bytes_of<Memory>(*this);
    }
    ~ImageForm() override { delete[] memory; }

    int answer(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const override {
        const Memory own(*this, scratch);
        double at[6] = {};
        for (int axis = 0; axis < process.axes; ++axis) at[axis] = double(place[axis]);
        const float share = float(process.of(at, own.known, own.encoded));
        for (int i = 0; i < process.count; ++i) own.features[i] = float(own.known[i]);
        combined<float>(own.features, weights, process.count, view.seen, offset, own.emitted);
        for (int i = 0; i < view.seen; ++i) own.emitted[i] = emission(own.emitted[i], place, i);
        ThawArgs<float> mine = view;
        mine.image = values;
        for (int strip = 0; strip < strips_of(view.height); ++strip) thaw_strip<float>(mine, own.emitted, 1, strip, own.cells);
        for (int64_t i = 0; i < facts.values; ++i) values[i] = values[i] < 0 ? 0.0f : values[i] > 1 ? 1.0f : values[i];
        if (variance) *variance = NAN;
        if (unknown) *unknown = tells_unknown ? share : NAN;
        return GSPARC_DONE;
    }

private:
    float emission(float x, const float* place, int i) const {
        float distance = 1;
        if (means) {
            const float* m = means + 3 * i;
            const float a = place[0] - m[0], b = place[1] - m[1], c = place[2] - m[2];
            distance = sqrtf((a * a + b * b + c * c + least_squared) * per_reference_squared);
        }
        if (log_distance) x -= logf(distance);
        if (activation == 1) x = 1 / (1 + expf(-x));
        if (activation == 2) x = x > 20 ? x : log1pf(expf(x));
        return inverse_distance ? x * gain / distance : x;
    }

    // Blocks of 4 x 4 pixels as two of 4 x 2 each.
    void split(int64_t across, int64_t blocks) {
        constexpr int n = Lanes<float>::n, columns = kTileColumns<float>, parts = kColumns / columns;
        const int64_t mine = tiles_across<float>(view.width), all = strips_of(view.height) * mine, most = blocks * parts;
        memory = new char[(all + 1) * sizeof(int64_t) + most * (n * sizeof(float) + sizeof(int32_t))];
        int64_t* starts = reinterpret_cast<int64_t*>(memory);
        float* weights = reinterpret_cast<float*>(starts + all + 1);
        int32_t* ranks = reinterpret_cast<int32_t*>(weights + most * n);
        int64_t written = 0;
        for (int64_t tile = 0; tile < all; ++tile) {
            const int64_t strip = tile / mine, column = tile % mine, whole = strip * across + column / parts;
            const int part = int(column % parts);
            starts[tile] = written;
            for (int64_t block = view.starts[whole]; block < view.starts[whole + 1]; ++block, ++written) {
                ranks[written] = view.ranks[block];
                for (int row = 0; row < kStripRows; ++row)
                    memcpy(weights + written * n + row * columns, view.weights + block * kBlock + row * kColumns + part * columns,
                           columns * sizeof(float));
            }
        }
        starts[all] = written;
        view.starts = starts, view.weights = weights, view.ranks = ranks;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

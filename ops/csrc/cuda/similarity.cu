// Mean structural similarity of images and its gradient: two passes over tiles, each with its border, by a separable window.
#include "cuda/view.h"

#include "similar.h"

namespace gsparc {
namespace GSPARC_ISA {
namespace {

constexpr int kWide = kSimilarityWidth, kHigh = kSimilarityHeight;
constexpr int kColumns = kWide + 2 * kRadius, kRows = kHigh + 2 * kRadius;
constexpr int kWindowed = 5, kDerivatives = 3;

struct Images {
    int height, width, tiles_x, tiles;  // tiles of one image
    float taps[kTaps], c1, c2;
    const float *prediction, *target, *shift;  // (B, H, W) twice, (B,): the targets' means
    float *sums;                               // (B, tiles), of the similarity
    float *by;                                 // (3, B, H - 2 kRadius, W - 2 kRadius), its derivatives, or null
    float *slope;                              // (B, H, W), or null

    GSPARC_HD int rows() const { return height - 2 * kRadius; }
    GSPARC_HD int columns() const { return width - 2 * kRadius; }
    GSPARC_HD int64_t pixels() const { return int64_t(height) * width; }
    GSPARC_HD int64_t places() const { return int64_t(rows()) * columns(); }
};

// Into shared memory: parameters that are indexed would be copied to each thread's stack.
__device__ void read_window(const Images& a, float (&weights)[kTaps]) {
    GSPARC_UNROLL
    for (int k = 0; k < kTaps; ++k)
        if (threadIdx.x == unsigned(k)) weights[k] = a.taps[k];
}

// The window over kMaps maps in shared memory: down the columns, then along a row for each output of this thread.
// value(map, y, x) is what lies there; use(y, x, windowed) takes outputs, (y, x) within the tile.
template <int kMaps, class Value, class Use>
__device__ void window(const float* weights, float (&half)[kMaps][kHigh][kColumns], Value value, Use use) {
    for (int at = threadIdx.x; at < kHigh * kColumns; at += kBlock) {
        const int y = at / kColumns, x = at % kColumns;
        float sums[kMaps] = {};
        for (int k = 0; k < kTaps; ++k)
            GSPARC_UNROLL
            for (int c = 0; c < kMaps; ++c) sums[c] = fma(weights[k], value(c, y + k, x), sums[c]);
        for (int c = 0; c < kMaps; ++c) half[c][y][x] = sums[c];
    }
    block_sync();
    for (int at = threadIdx.x; at < kHigh * kWide; at += kBlock) {
        const int y = at / kWide, x = at % kWide;
        float sums[kMaps] = {};
        for (int k = 0; k < kTaps; ++k)
            GSPARC_UNROLL
            for (int c = 0; c < kMaps; ++c) sums[c] = fma(weights[k], half[c][y][x + k], sums[c]);
        use(y, x, sums);
    }
}

// Similarity at the places of a tile, its sum, and its derivatives by the windowed moments.
__global__ void __launch_bounds__(kBlock) similarity_places(Images a) {
    __shared__ float p[kRows][kColumns], t[kRows][kColumns], half[kWindowed][kHigh][kColumns], parts[kWarps], weights[kTaps];
    const int64_t image = blockIdx.x / a.tiles;
    const int tile = blockIdx.x % a.tiles, row0 = tile / a.tiles_x * kHigh, column0 = tile % a.tiles_x * kWide;
    const float shift = a.shift[image], share = 1.0f / float(a.places());
    for (int at = threadIdx.x; at < kRows * kColumns; at += kBlock) {
        const int y = at / kColumns, x = at % kColumns;
        const bool there = row0 + y < a.height && column0 + x < a.width;
        const int64_t from = image * a.pixels() + int64_t(row0 + y) * a.width + column0 + x;
        p[y][x] = there ? a.prediction[from] - shift : 0.0f, t[y][x] = there ? a.target[from] - shift : 0.0f;
    }
    read_window(a, weights);
    block_sync();
    const auto moment = [&](int c, int y, int x) {
        const float first = c == 1 || c == 3 ? t[y][x] : p[y][x], second = c == 2 ? p[y][x] : t[y][x];
        return c < 2 ? first : first * second;
    };
    float total = 0;
    window(weights, half, moment, [&](int y, int x, const float (&m)[kWindowed]) {
        if (row0 + y >= a.rows() || column0 + x >= a.columns()) return;
        float by[kDerivatives];
        total += similar_at(m, shift, a.c1, a.c2, share, a.by != nullptr, by);
        if (!a.by) return;
        float* to = a.by + image * a.places() + int64_t(row0 + y) * a.columns() + column0 + x;
        const int64_t map = int64_t(gridDim.x / a.tiles) * a.places();
        for (int c = 0; c < kDerivatives; ++c) to[c * map] = by[c];
    });
    float one[1] = {total};
    total = warp_sums(one);
    if (threadIdx.x % kWarp == 0) parts[threadIdx.x / kWarp] = total;
    block_sync();
    if (threadIdx.x > 0) return;
    total = 0;
    for (int w = 0; w < kWarps; ++w) total += parts[w];
    a.sums[blockIdx.x] = total;
}

// The gradient: the transposed window, which for a symmetric one is the window over a border of zeros.
__global__ void __launch_bounds__(kBlock) similarity_slopes(Images a) {
    __shared__ float by[kDerivatives][kRows][kColumns], half[kDerivatives][kHigh][kColumns], weights[kTaps];
    const int64_t image = blockIdx.x / a.tiles, map = int64_t(gridDim.x / a.tiles) * a.places();
    const int tile = blockIdx.x % a.tiles, row0 = tile / a.tiles_x * kHigh, column0 = tile % a.tiles_x * kWide;
    for (int at = threadIdx.x; at < kRows * kColumns; at += kBlock) {
        const int y = row0 + at / kColumns - 2 * kRadius, x = column0 + at % kColumns - 2 * kRadius;
        const bool there = y >= 0 && y < a.rows() && x >= 0 && x < a.columns();
        const float* from = a.by + image * a.places() + int64_t(y) * a.columns() + x;
        for (int c = 0; c < kDerivatives; ++c) by[c][at / kColumns][at % kColumns] = there ? from[c * map] : 0.0f;
    }
    read_window(a, weights);
    block_sync();
    const float shift = a.shift[image];
    window(weights, half, [&](int c, int y, int x) { return by[c][y][x]; }, [&](int y, int x, const float (&m)[kDerivatives]) {
        if (row0 + y >= a.height || column0 + x >= a.width) return;
        const int64_t at = image * a.pixels() + int64_t(row0 + y) * a.width + column0 + x;
        a.slope[at] = m[0] + 2.0f * (a.prediction[at] - shift) * m[1] + (a.target[at] - shift) * m[2];
    });
}

int tiles_of(int height, int width) { return (height + kHigh - 1) / kHigh * ((width + kWide - 1) / kWide); }

}  // namespace
}  // namespace GSPARC_ISA
}  // namespace gsparc

extern "C" int64_t gsparc_similarity(const gsparc::Call* call) {
    using namespace gsparc::GSPARC_ISA;
    Images a;
    gsparc::Reader in(*call);
    int64_t samples;
    in.sizes(samples, a.height, a.width);
    a.c1 = float(call->numbers[0]), a.c2 = float(call->numbers[1]);
    for (int k = 0; k < gsparc::kTaps; ++k) a.taps[k] = float(call->numbers[2 + (k <= gsparc::kRadius ? k : 2 * gsparc::kRadius - k)]);
    in.read(a.prediction, a.target, a.shift, a.sums, a.slope);
    Arena arena(reinterpret_cast<void*>(uintptr_t(call->scratch)));
    a.by = a.slope ? arena.take<float>(kDerivatives * samples * a.places()) : nullptr;
    if (arena.measuring()) return arena.bytes();

    if (const int64_t error = use_device(call->device)) return -error;
    void* stream = reinterpret_cast<void*>(uintptr_t(call->stream));
    Steps steps;
    auto tiled = [&](void (*kernel)(Images), int height, int width) {
        a.tiles_x = (width + kWide - 1) / kWide, a.tiles = tiles_of(height, width);
        return launch(kernel, samples * a.tiles, 1, kBlock, stream, a);
    };
    steps.then([&] { return tiled(similarity_places, a.rows(), a.columns()); });
    if (a.slope) steps.then([&] { return tiled(similarity_slopes, a.height, a.width); });
    return steps.result();
}

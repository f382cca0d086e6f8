// A static receiver: its weights are frozen as blocks (an entry: one Gaussian, the 32 pixels of a tile), and a
// batch of queries is a product of features and blocks, tile by tile.
#include "cuda/view.h"

namespace gsparc {
namespace GSPARC_ISA {
namespace {

template <class S> struct Frozen {
    int width, height, tiles_x, columns;  // columns: how many images
    const int32_t *starts, *ends;         // (tiles + 1), (tiles,): entries of each tile, and where light ends
    const int32_t* ranks;                 // (E,) rows of the features
    const S *blocks, *features;           // (E, kWarp), (V, columns)
    S* image;                             // (columns, H, W)

    // Address of a pixel of the first image, or null beyond the edge.
    GSPARC_HD S* pixel(int tile, int lane) const {
        const int row = tile / tiles_x * kTileHeight + lane / kTileWidth, column = tile % tiles_x * kTileWidth + lane % kTileWidth;
        return row < height && column < width ? image + int64_t(row) * width + column : nullptr;
    }
};

// Few images: a lane is a pixel, the warps share the list, their sums are added in order.
constexpr int kFew = 4;
template <class S> __global__ void __launch_bounds__(kBlock) thaw_few(Frozen<S> f) {
    __shared__ S parts[kWarps][kFew][kWarp];
    const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp, tile = blockIdx.x, from = blockIdx.y * kFew;
    const int used = f.columns - from < kFew ? f.columns - from : kFew;
    S sums[kFew] = {};
    GSPARC_UNROLL_BY(4)
    for (int e = f.starts[tile] + warp; e < f.ends[tile]; e += kWarps) {
        const S weight = f.blocks[int64_t(e) * kWarp + lane];
        const S* feature = f.features + int64_t(f.ranks[e]) * f.columns + from;
        GSPARC_UNROLL
        for (int k = 0; k < kFew; ++k) sums[k] = fma(k < used ? feature[k] : S(0), weight, sums[k]);
    }
    for (int k = 0; k < kFew; ++k) parts[warp][k][lane] = sums[k];
    block_sync();
    S* to = f.pixel(tile, lane);
    for (int k = warp; to && k < used; k += kWarps) {
        S total = 0;
        for (int w = 0; w < kWarps; ++w) total += parts[w][k][lane];
        to[int64_t(from + k) * f.width * f.height] = total;
    }
}

// Many images: a product of a (kImages x entries) and an (entries x 32) matrix, 4 x 4 outputs a thread.
constexpr int kImages = 64, kDepth = 16, kSide = 4;
template <class S> struct alignas(16) Side {
    S pixels[kSide];
};
template <class S> __global__ void __launch_bounds__(kBlock, 8) thaw_many(Frozen<S> f) {
    alignas(16) __shared__ S features[kDepth][kImages];
    alignas(16) __shared__ S weights[kDepth][kWarp];
    const int tile = blockIdx.x, from = blockIdx.y * kImages, end = f.ends[tile];
    const int group = threadIdx.x % (kWarp / kSide), part = threadIdx.x / (kWarp / kSide);
    S sums[kSide][kSide] = {};
    for (int base = f.starts[tile]; base < end; base += kDepth) {
        for (int at = threadIdx.x; at < kDepth * kImages; at += kBlock) {
            const int e = at / kImages, k = at % kImages;
            const bool there = base + e < end && from + k < f.columns;
            features[e][k] = there ? f.features[int64_t(f.ranks[base + e]) * f.columns + from + k] : S(0);
        }
        for (int at = threadIdx.x; at < kDepth * kWarp; at += kBlock)
            weights[at / kWarp][at % kWarp] = base + at / kWarp < end ? f.blocks[int64_t(base) * kWarp + at] : S(0);
        block_sync();
        GSPARC_UNROLL
        for (int e = 0; e < kDepth; ++e) {
            S left[kSide], right[kSide];
            GSPARC_UNROLL
            for (int a = 0; a < kSide; ++a) left[a] = features[e][part * kSide + a], right[a] = weights[e][group * kSide + a];
            GSPARC_UNROLL
            for (int a = 0; a < kSide; ++a)
                GSPARC_UNROLL
                for (int b = 0; b < kSide; ++b) sums[a][b] = fma(left[a], right[b], sums[a][b]);
        }
        block_sync();
    }
    const int64_t plane = int64_t(f.width) * f.height;
    const int first = from + part * kSide, left = f.columns - first;
    if (f.width % kSide == 0) {  // then its four pixels lie in the image or none does, and their address is even
        S* to = f.pixel(tile, group * kSide);
        if (!to) return;
        GSPARC_UNROLL
        for (int a = 0; a < kSide; ++a)
            if (a < left) *reinterpret_cast<Side<S>*>(to + (first + a) * plane) = {{sums[a][0], sums[a][1], sums[a][2], sums[a][3]}};
        return;
    }
    GSPARC_UNROLL
    for (int b = 0; b < kSide; ++b) {
        S* to = f.pixel(tile, group * kSide + b);
        GSPARC_UNROLL
        for (int a = 0; a < kSide; ++a)
            if (to && a < left) to[(first + a) * plane] = sums[a][b];
    }
}

template <class S> int64_t thaw(const Call& call) {
    Reader in(call);
    Frozen<S> f;
    in.sizes(f.columns, f.height, f.width);
    f.tiles_x = (f.width + kTileWidth - 1) / kTileWidth;
    in.read(f.starts, f.ends, f.ranks, f.blocks, f.features, f.image);
    if (!call.scratch) return 1;
    const int tiles = f.tiles_x * ((f.height + kTileHeight - 1) / kTileHeight);
    void* stream = reinterpret_cast<void*>(uintptr_t(call.stream));
    if (f.columns <= 2 * kFew) return -launch(thaw_few<S>, tiles, (f.columns + kFew - 1) / kFew, kBlock, stream, f);
    return -launch(thaw_many<S>, tiles, (f.columns + kImages - 1) / kImages, kBlock, stream, f);
}

}  // namespace
}  // namespace GSPARC_ISA
}  // namespace gsparc

GSPARC_ENTRY(thaw, thaw<S>(call))

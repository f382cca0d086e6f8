// Walking a strip in batches of footprints: first which tiles each may reach, and what depends on the column alone;
// then those tiles, in a loop whose lengths have long been known. A branch that waits for the arithmetic before it
// costs more than a tile.
#pragma once
#include <new>

#include "shapes.h"

namespace gsparc {
namespace GSPARC_ISA {

constexpr int kQuad = kStripRows;  // tiles whose columns are a vector

// The bits of x where mask has one, side by side.
GSPARC_INLINE unsigned pick_bits(unsigned x, unsigned mask) {
#if defined(__BMI2__)
    return _pext_u32(x, mask);
#else
    unsigned picked = 0;
    for (unsigned to = 1; mask; mask &= mask - 1, to <<= 1) picked |= x & mask & -mask ? to : 0;
    return picked;
#endif
}

// Which of the tiles whose columns are a vector have a set lane, a bit each.
template <class S> GSPARC_INLINE unsigned tile_bits(Mask<S> columns) {
    unsigned set = bits_of<S>(columns);
    if (kTileColumns<S> == 4) {
        set |= set >> 1, set |= set >> 2;
        return pick_bits(set, 0x1111);
    }
    if (kTileColumns<S> == 2) {
        set |= set >> 1;
        return pick_bits(set, 0x55);
    }
    return set;
}

// Which tiles of a strip still let light through, a bit each; all of them at first.
struct Bits {
    uint64_t* const words;
    const int count;
    GSPARC_INLINE static int64_t size(int tiles) { return tiles / 64 + 2; }
    GSPARC_INLINE void set_all() const {
        for (int k = 0; k < count / 64 + 2; ++k) words[k] = ~uint64_t(0);
    }
    GSPARC_INLINE uint32_t from(int tile) const {  // the bits of 32 tiles
        uint64_t near;
        __builtin_memcpy(&near, reinterpret_cast<const char*>(words) + (tile >> 3), sizeof near);
        return uint32_t(near >> (tile & 7));
    }
};

// A vector of columns that a footprint may reach; a tile of it that it may, and where the numbers of its columns lie.
struct Quad {
    uint16_t tile;
    uint8_t lit, owner;  // lit: bits of tiles
    int32_t rank;
};
struct Hit {
    int32_t tile, at;
};

constexpr int kBatch = 64;     // footprints found before their tiles are visited
constexpr int kFewQuads = 4;  // most footprints have at most so many: found without a branch

// One worker's memory for batches.
template <class S, bool kTangent> struct Batch {
    static constexpr int n = Lanes<S>::n, kStride = Shape<S, kTangent>::kParts * n;
    const int most;  // quads of one batch
    int owners;      // footprints with a lit quad
    Buffer<Quad> quads;
    Buffer<S> columns;
    Buffer<Hit> hits;
    Buffer<uint64_t> words;
    int32_t ranks[kBatch + 1], ends[kBatch + 1];  // of each owner: its rank, the end of its hits

    explicit Batch(int tiles)
        : most(3 * kBatch + tiles / kQuad + 2 * kFewQuads), quads(most, false), columns(int64_t(most) * kStride, false), hits(int64_t(most + 1) * kQuad, false), words(Bits::size(tiles), false) {}
};

// Appends the tiles of a quad that are set in a mask.
template <class S> GSPARC_INLINE Hit* append(Hit* hit, int tile, int at, unsigned tiles) {
    for (int k = 0; k < kQuad; ++k) {
        *hit = {tile + k, at + k * kTileColumns<S>};
        hit += tiles >> k & 1;
    }
    return hit;
}
#if defined(__AVX512F__)
template <> GSPARC_INLINE Hit* append<float>(Hit* hit, int tile, int at, unsigned tiles) {
    const __m256i all = _mm256_add_epi32(_mm256_set1_epi64x(int64_t(at) << 32 | unsigned(tile)), _mm256_set_epi32(12, 3, 8, 2, 4, 1, 0, 0));
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(hit), _mm256_maskz_compress_epi64(__mmask8(tiles), all));
    return hit + __builtin_popcount(tiles);
}
#endif

// Appends those of the quads of 16 tiles from `first` on that are lit.
GSPARC_INLINE Quad* append_few(Quad* quad, uint32_t lit, int rank, int owner, int first) {
#if defined(__AVX512F__)
    const __m256i parts = _mm256_and_si256(_mm256_srlv_epi64(_mm256_set1_epi64x(lit), _mm256_set_epi64x(12, 8, 4, 0)), _mm256_set1_epi64x(15));
    const __m256i same = _mm256_set1_epi64x(int64_t(uint64_t(uint32_t(rank)) << 32 | uint32_t(owner) << 24 | uint32_t(first)));
    const __m256i all = _mm256_add_epi64(_mm256_add_epi64(same, _mm256_set_epi64x(12, 8, 4, 0)), _mm256_slli_epi64(parts, 16));
    const __mmask8 some = _mm256_test_epi64_mask(parts, parts);
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(quad), _mm256_maskz_compress_epi64(some, all));
    return quad + __builtin_popcount(some);
#else
    for (int k = 0; k < kFewQuads; ++k) {
        const uint32_t part = lit >> (k * kQuad) & 15;
        *quad = {uint16_t(first + k * kQuad), uint8_t(part), uint8_t(owner), rank};
        quad += part != 0;
    }
    return quad;
#endif
}

// Appends the quads of tiles [first, last] that are lit.
GSPARC_INLINE Quad* append(Quad* quad, Bits bits, int rank, int owner, int first, int last) {
    constexpr int many = kFewQuads * kQuad;
    for (; last - first >= many; first += many) quad = append_few(quad, bits.from(first) & 0xffff, rank, owner, first);
    return append_few(quad, bits.from(first) & ((2u << (last - first)) - 1), rank, owner, first);
}

// Finds the tiles of the next footprints of a strip; returns the first that is left over.
template <class S, bool kTangent>
GSPARC_INLINE const int32_t* find(const Strip<S>& strip, const Rises<S>& stage, const Lines<S>& lines, const S* base, const int32_t* entry, Bits bits, Batch<S, kTangent>& batch) {
    Quad *quad = batch.quads.data, *const full = quad + 3 * kBatch;
    int owners = 0;
    for (; entry < strip.last && owners < kBatch && quad < full; ++entry) {
        if (strip.last - entry > kAhead) __builtin_prefetch(base + int64_t(entry[kAhead]) * lines.width);
        Range range;
        memcpy(&range, base + int64_t(*entry) * lines.width + kTiles, sizeof range);
        const Quad* const before = quad;
        batch.ranks[owners] = *entry;
        quad = append(quad, bits, *entry, owners, range.first, range.last);
        if (range.wrapped >= 0) quad = append(quad, bits, *entry, owners, 0, range.wrapped);
        owners += quad > before;
    }
    Hit* hit = batch.hits.data;
    int at = 0;
    for (const Quad* q = batch.quads.data; q < quad; ++q, at += batch.kStride) {
        const S* line = base + int64_t(q->rank) * lines.width;
        const Mask<S> columns = Shape<S, kTangent>::reach(line, stage, strip.index, q->tile * kTileColumns<S>, batch.columns.data + at);
        hit = append<S>(hit, q->tile, at, tile_bits<S>(columns) & q->lit);
        batch.ends[q->owner] = int32_t(hit - batch.hits.data);
    }
    batch.owners = owners;
    return entry;
}

// Calls visit(line, rank, hit, end, shape, columns) for each footprint of the strip that may count somewhere, front to
// back, with its tiles. `relight(bits)` is called between batches: it says where light still arrives, and false ends
// the walk.
template <class S, bool kTangent, class Relight, class Visit>
GSPARC_INLINE void sweep(const Strip<S>& strip, const PlanView<S>& plan, const Rises<S>& stage, const Lines<S>& lines,
                         Batch<S, kTangent>& batch, const Relight& relight, const Visit& visit) {
    const S* base = lines.of(plan, strip.pose, 0);
    const Bits bits = {batch.words.data, stage.tiles};
    bits.set_all();
    for (const int32_t* entry = strip.first; entry < strip.last;) {
        entry = find<S, kTangent>(strip, stage, lines, base, entry, bits, batch);
        const Hit* hit = batch.hits.data;
        for (int owner = 0; owner < batch.owners; ++owner) {
            const Hit* const end = batch.hits.data + batch.ends[owner];
            const int rank = batch.ranks[owner];
            const S* line = base + int64_t(rank) * lines.width;
            const Shape<S, kTangent> shape(line, stage, strip.index);
            visit(line, rank, hit, end, shape, batch.columns.data);
            hit = end;
        }
        if (!relight(bits)) return;
    }
}

// For `relight`: every tile stays.
struct AllLit {
    GSPARC_INLINE bool operator()(Bits) const { return true; }
};

// One T for each worker.
template <class T> struct Workers {
    Buffer<char> memory;
    const int count;
    explicit Workers(int threads, int tiles) : memory(int64_t(threads) * sizeof(T), false), count(threads) {
        for (int k = 0; k < count; ++k) new (&(*this)[k]) T(tiles);
    }
    ~Workers() {
        for (int k = 0; k < count; ++k) (*this)[k].~T();
    }
    T& operator[](int k) { return reinterpret_cast<T*>(memory.data)[k]; }
};

// For `relight`: where the first vector of a cell still holds a number of at least `floor`.
template <class S> struct Lights {
    const S* cells;
    int cell;
    Vec<S> floor;
    GSPARC_INLINE bool operator()(Bits bits) const {
        uint64_t all = 0;
        for (int tile = 0; tile < bits.count;) {
            uint64_t word = 0;
            for (int k = 0; k < 64 && tile < bits.count; ++k, ++tile)
                word |= uint64_t(any(at_most(floor, load(cells + int64_t(tile) * cell)))) << k;
            bits.words[(tile - 1) / 64] = word, all |= word;
        }
        return all != 0;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

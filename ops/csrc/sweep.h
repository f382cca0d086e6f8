// Walking a strip in batches of footprints: first which tiles each may reach, sixteen footprints at a time;
// then those tiles, in a loop whose lengths have long been known. A branch that waits for the arithmetic before it
// costs more than a tile.
#pragma once
#include <new>

#include "projection.h"

namespace gsparc {
namespace GSPARC_ISA {

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

constexpr int kBatch = 64;  // footprints whose tiles are found before they are visited
constexpr int kBlock = 16;  // tiles looked at together

// One worker's memory for batches.
struct Batch {
    int owners;            // footprints with a lit tile
    Buffer<int32_t> hits;  // tiles
    Buffer<uint64_t> words;
    int32_t ranks[kBatch + 1], ends[kBatch + 1];  // of each owner: its rank, the end of its hits

    explicit Batch(int tiles) : hits(int64_t(kBatch) * (tiles + 1) + kBlock, false), words(Bits::size(tiles), false) {}
};

// Appends those tiles from `first` on whose bit, of kBlock, is set.
GSPARC_INLINE int32_t* append(int32_t* hit, int first, unsigned tiles) {
#if defined(__AVX512F__)
    const __m512i all = _mm512_add_epi32(_mm512_set1_epi32(first), _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0));
    _mm512_storeu_si512(hit, _mm512_maskz_compress_epi32(__mmask16(tiles), all));
    return hit + __builtin_popcount(tiles);
#else
    for (int k = 0; k < kBlock; ++k) {
        *hit = first + k;
        hit += tiles >> k & 1;
    }
    return hit;
#endif
}

// Appends those of the tiles [first, first + count) that are lit.
GSPARC_INLINE int32_t* append(int32_t* hit, Bits bits, int first, int count) {
    for (; count > kBlock; first += kBlock, count -= kBlock) hit = append(hit, first, bits.from(first) & 0xffff);
    return append(hit, first, bits.from(first) & ((1u << count) - 1));
}

// The same, less those that a footprint without an outline cannot reach.
template <class P, class S> GSPARC_INLINE int32_t* append_near(int32_t* hit, Bits bits, int first, int end, const S* line, const Rises<S>& stage, int strip) {
    constexpr int n = Lanes<S>::n;
    if constexpr (P::kOpen)
        for (; first < end; first += n) {
            const unsigned some = end - first < n ? (1u << (end - first)) - 1 : (1u << n) - 1;
            hit = append(hit, first, bits.from(first) & some & P::near_tiles(line, stage, strip, first));
        }
    return hit;
}

// Finds the tiles of the next footprints of a strip; returns the first that is left over. Spans of all first, then what
// becomes of them: one chain of arithmetic hides behind the next.
template <class P, class S>
GSPARC_INLINE const int32_t* find(const Strip<S>& strip, const Rises<S>& stage, const Lines<S>& lines, const S* base, const S* outlines, const int32_t* entry, Bits bits, Batch& batch) {
    constexpr int n = Lanes<S>::n, columns = kTileColumns<S>;
    static_assert(kBatch % n == 0 && n <= kBlock, "a batch is whole lanes");
    const int some = strip.last - entry < kBatch ? int(strip.last - entry) : kBatch;
    const S middle = stage.middle.data[strip.index], half = stage.half.data[strip.index];
    int32_t ranks[kBatch];
    Spans<S> spans[kBatch / n];
    for (int k = 0; k < some; ++k) ranks[k] = entry[k];
    for (int k = some; k % n; ++k) ranks[k] = ranks[some - 1];
    for (int first = 0; first < some; first += n) {
        Pack<S> numbers[kOutline];
        gather_at(outlines, kOutline, ranks + first, kOutline, numbers);
        const Outline<Pack<S>> outline = {numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6], numbers[7]};
        spans[first / n] = spans_of<P>(outline, middle - half, middle + half, stage.settings);
    }
    int32_t* hit = batch.hits.data;
    int owners = 0;
    for (int k = 0; k < some; ++k) {
        const S* line = base + int64_t(ranks[k]) * lines.width;
        __builtin_prefetch(line);
        if (k + kBatch < strip.last - entry) __builtin_prefetch(outlines + int64_t(entry[k + kBatch]) * kOutline);
        const Spans<S>& span = spans[k / n];
        const int lane = k % n;
        const int32_t* const before = hit;
        if (P::kOpen && span.open >> lane & 1) {
            const Runs runs = runs_of(strip.boxes[ranks[k]], stage.settings.width);
            for (int run = 0; run < runs.count; ++run) hit = append_near<P>(hit, bits, runs.from[run] / columns, (runs.to[run] - 1) / columns + 1, line, stage, strip.index);
        } else {
            hit = append(hit, bits, int(span.first[lane]), int(span.count[lane]));
            if (span.wrapped[lane]) hit = append(hit, bits, 0, int(span.wrapped[lane]));
        }
        batch.ranks[owners] = ranks[k], batch.ends[owners] = int32_t(hit - batch.hits.data);
        owners += hit > before;
    }
    batch.owners = owners;
    return entry + some;
}

// A footprint before the rows of a strip: `look` finds the offsets of a tile's pixels and says which lie inside.
template <class S, class P> using Shape = typename P::template Shape<S>;

// Calls visit(line, rank, hit, end, shape) for each footprint of the strip that may count somewhere, front to
// back, with its tiles. `relight(bits)` is called between batches: it says where light still arrives, and false ends
// the walk.
template <class P, class S, class Relight, class Visit>
GSPARC_INLINE void sweep(const Strip<S>& strip, const PlanView<S>& plan, const Rises<S>& stage, const Lines<S>& lines,
                         Batch& batch, const Relight& relight, const Visit& visit) {
    const S *base = lines.of(plan, strip.pose, 0), *outlines = lines.outlines.data + int64_t(strip.pose) * plan.count * kOutline;
    const Bits bits = {batch.words.data, stage.tiles};
    bits.set_all();
    for (const int32_t* entry = strip.first; entry < strip.last;) {
        entry = find<P>(strip, stage, lines, base, outlines, entry, bits, batch);
        const int32_t* hit = batch.hits.data;
        for (int owner = 0; owner < batch.owners; ++owner) {
            const int32_t* const end = batch.hits.data + batch.ends[owner];
            const int rank = batch.ranks[owner];
            const S* line = base + int64_t(rank) * lines.width;
            const Shape<S, P> shape(line, stage, strip.index);
            visit(line, rank, hit, end, shape);
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

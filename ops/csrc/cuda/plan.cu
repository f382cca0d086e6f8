// Who is seen where: project, order by (depth, id), and list the Gaussians of every tile, front to back.
#include "cuda/sort.h"
#include "cuda/view.h"

namespace gsparc {
namespace GSPARC_ISA {
namespace {

constexpr unsigned long long kSound = ~0ull;
constexpr int kThreads = 128;

// Warps that share the tiles of a Gaussian: with few Gaussians most of the GPU would wait for the widest of them.
constexpr int kMostPieces = 16;
#ifdef __CUDACC__
constexpr int64_t kWarpsWanted = 1 << 16;
#else
constexpr int64_t kWarpsWanted = 1 << 9;  // few, so that tests have every number of pieces
#endif
int pieces_for(int64_t gaussians) {
    int pieces = 1;
    while (pieces < kMostPieces && 2 * pieces * gaussians <= kWarpsWanted) pieces *= 2;
    return pieces;
}

template <class S> uint64_t GSPARC_HD depth_bits(S depth);
template <> uint64_t GSPARC_HD depth_bits(float depth) {
    union { float number; uint32_t bits; } both = {depth};
    return both.bits;
}
template <> uint64_t GSPARC_HD depth_bits(double depth) {
    union { double number; uint64_t bits; } both = {depth};
    return both.bits;
}

// Keys in which hidden Gaussians come last. float32: (pose, depth) in one key; float64: a sort for each pose.
template <class S> GSPARC_HD uint64_t depth_key(int pose, bool visible, S depth) {
    if (sizeof(S) == 8) return visible ? depth_bits(depth) : ~0ull;
    return (uint64_t(pose) << 32) | (visible ? depth_bits(depth) : 0xffffffffull);
}
template <class S> GSPARC_HD bool hidden_key(uint64_t key) { return sizeof(S) == 8 ? key == ~0ull : (key & 0xffffffffull) == 0xffffffffull; }

template <class S> struct Outputs {
    S *means2d, *radii, *depths;
    bool* visible;
    uint64_t* keys;
    int32_t* values;
    unsigned long long* wrong;
};

template <class S, class P> __global__ void project_kernel(View<S> v, Model<S> model, Outputs<S> out) {
    const uint32_t at = blockIdx.x * kThreads + threadIdx.x;
    if (at >= uint32_t(v.poses) * v.count) return;
    const int pose = at / v.count;
    const int64_t i = at % v.count, base = int64_t(pose) * v.count;
    const ProjectArgs<S> one = {model, v.count, v.settings, v.records + base * kRecord, out.depths + base, out.means2d + 2 * base,
                                out.radii + base, v.boxes + base, out.visible + base, pose};
    const int wrong = project_one<P>(one, i);
    if (wrong >= 0) {
        atomicMin(out.wrong, static_cast<unsigned long long>(4 * i + wrong));
        one.visible[i] = false, one.depths[i] = 0;
    }
    if (i == 0) {
        const bool sound = sound_pose(model.positions + 3 * pose, model.rotations + 9 * pose);
        if (!sound) atomicMin(out.wrong, static_cast<unsigned long long>(kUnsoundPose));
    }
    if (!one.visible[i]) v.boxes[at] = {0, 0, 0, 0};
    out.keys[at] = depth_key<S>(pose, one.visible[i], one.depths[i]), out.values[at] = int32_t(i);
}

// Makes `sorted` 0 where an id is no larger than that before it: once a warp, for atomics on one address queue up.
__global__ void look_for_disorder(const int64_t* ids, int count, unsigned long long* sorted) {
    const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
    const bool disorder = i > 0 && i < count && ids[i] <= ids[i - 1];
    if (warp_any(disorder) && threadIdx.x % kWarp == 0) atomicMin(sorted, 0ull);
}

// Heap sort of a run of equal depths by id: rare, so one thread does it, in place.
GSPARC_HD void sort_run(int32_t* run, int64_t length, const int64_t* ids) {
    auto sink = [&](int64_t at, int64_t end) {
        for (;;) {
            int64_t child = 2 * at + 1;
            if (child >= end) return;
            if (child + 1 < end && ids[run[child + 1]] > ids[run[child]]) ++child;
            if (ids[run[child]] <= ids[run[at]]) return;
            const int32_t kept = run[at];
            run[at] = run[child], run[child] = kept, at = child;
        }
    };
    for (int64_t at = length / 2; at-- > 0;) sink(at, length);
    for (int64_t end = length - 1; end > 0; --end) {
        const int32_t kept = run[0];
        run[0] = run[end], run[end] = kept;
        sink(0, end);
    }
}

// The sort was stable by row; where ids are not in the order of the rows, equal depths go by id, and equal ids are `wrong`.
template <class S> __global__ void break_ties(int32_t* order, const uint64_t* keys, const int64_t* ids, const unsigned long long* sorted, unsigned long long* wrong, int poses, int count) {
    const uint32_t at = blockIdx.x * kThreads + threadIdx.x;
    if (at >= uint32_t(poses) * count || *sorted) return;
    const int64_t base = at / count * count, end = base + count;
    if (hidden_key<S>(keys[at]) || (at > base && keys[at - 1] == keys[at])) return;
    int64_t last = int64_t(at) + 1;
    while (last < end && keys[last] == keys[at]) ++last;
    if (last - at > 1) sort_run(order + at, last - at, ids);
    for (int64_t next = int64_t(at) + 1; next < last; ++next)
        if (ids[order[next - 1]] == ids[order[next]]) atomicMin(wrong, static_cast<unsigned long long>(kEqualIds));
}

// Tiles that a box touches, each once: a box that would wrap into its own first tile was widened to the circle.
static_assert(kTileWidth < kLanes, "set_columns widens boxes within kLanes of the full circle");
struct TileRange {
    int row0 = 0, rows = 0, column0 = 0, columns = 0;

    TileRange() = default;
    template <class S> GSPARC_HD TileRange(const Box& box, const View<S>& v) {
        row0 = box.row0 / kTileHeight;
        rows = box.row1 > box.row0 ? (box.row1 - 1) / kTileHeight - row0 + 1 : 0;
        column0 = box.column0 / kTileWidth;
        const int end = box.column0 + box.columns;
        if (end <= v.settings.width)
            columns = (end - 1) / kTileWidth - column0 + 1;
        else
            columns = v.tiles_x - column0 + (end - v.settings.width - 1) / kTileWidth + 1;
    }
};

// A tile counts if at least one of its pixels lies inside the footprint: the test the compositing will make. Calls
// keep(which of those found, tile) for tiles [from, end) of a range; returns how many there are.
template <class S, class P, class Keep>
__device__ int find_tiles(const View<S>& v, const TileRange& range, const S* record, int from, int end, Keep keep) {
    int found = 0, row = from < end ? range.row0 + from / range.columns : 0, k = from < end ? from % range.columns : 0;
    for (int at = from; at < end; ++at, ++k) {
        if (k == range.columns) k = 0, ++row;
        const int column = range.column0 + k < v.tiles_x ? range.column0 + k : range.column0 + k - v.tiles_x;
        const Pixel<S, P> pixel(v, row, column, threadIdx.x % kWarp);
        S tau1, tau2, form;
        if (warp_any(pixel.offsets(record, v.settings, tau1, tau2, form))) keep(found++, row * v.tiles_x + column);
    }
    return found;
}

// `pieces` warps hold one Gaussian, each a run of its tiles. Writing is a second run of counting, which takes who is
// visible from the sorted keys.
template <class S, class P>
__global__ void list_tiles(View<S> v, int pieces, const uint64_t* sorted, int64_t* counts, uint32_t* keys, int32_t* gaussians) {
    __shared__ int found[kMostPieces];
    const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp, piece = warp % pieces, all = v.poses * v.count;
    const int64_t at = int64_t(blockIdx.x) * (blockDim.x / kWarp / pieces) + warp / pieces;
    const int pose = int(at) / v.count, rank = int(at) % v.count;
    S record[kRecord];  // a copy: what is written below might be the records, for all the compiler knows
    TileRange range;
    int32_t i = 0;
    if (at < all && (counts ? !hidden_key<S>(sorted[at]) : rank < v.shown[pose])) {
        i = v.order[at];
        const int64_t row = int64_t(pose) * v.count + i;
        memcpy(record, v.records + row * kRecord, sizeof record);
        range = TileRange(v.boxes[row], v);
    }
    const int tiles = range.rows * range.columns, from = tiles * piece / pieces, end = tiles * (piece + 1) / pieces;
    if (counts || pieces > 1) {
        const int mine = find_tiles<S, P>(v, range, record, from, end, [](int, int) {});
        if (lane == 0) found[warp] = mine;
        block_sync();
    }
    int before = 0;
    for (int k = 0; k < piece; ++k) before += found[warp - piece + k];
    if (counts) {
        if (at < all && lane == 0 && piece == pieces - 1) counts[at] = before + found[warp];
        return;
    }
    if (from >= end) return;
    const int64_t slot = v.slots[int64_t(pose) * (v.count + 1) + rank] + before;
    find_tiles<S, P>(v, range, record, from, end, [&](int nth, int tile) {
        if (lane == 0 && slot + nth < v.capacity) keys[slot + nth] = uint32_t(pose) * v.tiles + tile, gaussians[slot + nth] = i;
    });
}

// slots (P, N + 1) from the running sums, shown (P,) from the sorted keys: the first hidden rank; the total, or more
// than any capacity where something is unsound.
template <class S>
__global__ void write_slots(const int64_t* sums, const uint64_t* sorted, const unsigned long long* wrong, int poses, int count,
                            int64_t* slots, int32_t* shown, int64_t* total, int64_t* verdict) {
    const uint32_t at = blockIdx.x * kThreads + threadIdx.x, all = uint32_t(poses) * count;
    if (at >= all + poses) return;
    const uint32_t pose = at / (count + 1), rank = at % (count + 1), before = pose * count + rank;  // ranks before this one, over all poses
    slots[at] = before ? sums[before - 1] : 0;
    const bool here = rank < uint32_t(count) && !hidden_key<S>(sorted[before]);
    if (!here && (rank == 0 || !hidden_key<S>(sorted[before - 1]))) shown[pose] = rank;
    if (at > 0) return;
    verdict[0] = *wrong == kSound ? -1 : int64_t(*wrong), verdict[1] = sums[all - 1];
    *total = *wrong == kSound ? sums[all - 1] : INT64_MAX;
}

__global__ void number_slots(int32_t* values, uint32_t* keys, const int64_t* total, int capacity, uint32_t beyond) {
    const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x;
    if (at >= capacity) return;
    values[at] = int32_t(at);
    if (at >= *total) keys[at] = beyond;
}

// Entries in the order of the tiles, and where each tile begins.
__global__ void write_entries(const uint32_t* keys, const int32_t* slot_of, const int32_t* by_slot, int capacity, int tiles,
                              int32_t* starts, int32_t* gaussians, int32_t* slots) {
    const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x;
    if (at > capacity) return;
    const int64_t before = at > 0 ? int64_t(keys[at - 1]) : -1, here = at < capacity ? int64_t(keys[at]) : tiles;
    for (int64_t tile = before + 1; tile <= here && tile <= tiles; ++tile) starts[tile] = int32_t(at);
    if (at == capacity || here >= tiles) return;
    gaussians[at] = by_slot[slot_of[at]], slots[at] = slot_of[at];
}

int64_t blocks_for(int64_t threads) { return (threads + kThreads - 1) / kThreads; }

// Counts where `counts` is given, else writes entries.
template <class S>
int64_t list(const View<S>& v, void* stream, const uint64_t* sorted, int64_t* counts, uint32_t* keys, int32_t* gaussians) {
    const int64_t all = int64_t(v.poses) * v.count;
    const int pieces = pieces_for(all), warps = pieces > kWarps ? pieces : kWarps, together = warps / pieces;
    const auto kernel = with_projection(v.settings.projection, [](auto p) { return list_tiles<S, decltype(p)>; });
    return launch(kernel, (all + together - 1) / together, 1, warps * kWarp, stream, v, pieces, sorted, counts, keys, gaussians);
}

template <class S> int64_t plan(const Call& call) {
    Reader in(call);
    View<S> v = read_view<S>(call, in);
    const Model<S> model = read_model<S>(in);
    const auto* ids = in.next<const int64_t>();
    Outputs<S> out;
    in.read(out.means2d, out.radii, out.visible);
    auto* verdict = in.next<int64_t>();

    const int64_t all = int64_t(v.poses) * v.count;
    const bool together = sizeof(S) == 4;
    const int64_t sorted_at_once = together ? all : v.count;
    const int bits = together ? 32 + (v.poses > 1 ? bits_for(v.poses - 1) : 0) : 64, sorts = together ? 1 : v.poses;
    Arena arena(reinterpret_cast<void*>(uintptr_t(call.scratch)));
    out.wrong = arena.take<unsigned long long>(2);
    unsigned long long* sorted = out.wrong + 1;
    out.depths = arena.take<S>(all), out.keys = arena.take<uint64_t>(all), out.values = arena.take<int32_t>(all);
    uint64_t* keys = arena.take<uint64_t>(all);
    int64_t *counts = arena.take<int64_t>(all), *sums = arena.take<int64_t>(all);
    size_t sort_bytes = 0, sum_bytes = 0;
    Steps steps;
    steps.then([&] { return sort_pairs<uint64_t>(nullptr, sort_bytes, out.keys, keys, out.values, v.order, sorted_at_once, bits, nullptr); });
    steps.then([&] { return running_sums(nullptr, sum_bytes, counts, sums, all, nullptr); });
    size_t bytes = sort_bytes > sum_bytes ? sort_bytes : sum_bytes;
    char* temp = arena.take<char>(bytes);
    if (steps.result() || arena.measuring()) return steps.result() ? steps.result() : arena.bytes();

    void* stream = reinterpret_cast<void*>(uintptr_t(call.stream));
    const auto project = with_projection(v.settings.projection, [](auto p) { return project_kernel<S, decltype(p)>; });
    steps.then([&] { return clear(out.wrong, 0xff, 2 * sizeof *out.wrong, stream); });  // sound, and sorted
    steps.then([&] { return launch(project, blocks_for(all), 1, kThreads, stream, v, model, out); });
    for (int pose = 0; pose < sorts; ++pose) {
        const int64_t at = pose * sorted_at_once;
        steps.then([&] { return sort_pairs<uint64_t>(temp, sort_bytes, out.keys + at, keys + at, out.values + at, v.order + at, sorted_at_once, bits, stream); });
    }
    if (ids) {
        steps.then([&] { return launch(look_for_disorder, blocks_for(v.count), 1, kThreads, stream, ids, v.count, sorted); });
        steps.then([&] { return launch(break_ties<S>, blocks_for(all), 1, kThreads, stream, v.order, keys, ids, sorted, out.wrong, v.poses, v.count); });
    }
    steps.then([&] { return list<S>(v, stream, keys, counts, nullptr, nullptr); });
    steps.then([&] { return running_sums(temp, sum_bytes, counts, sums, all, stream); });
    steps.then([&] { return launch(write_slots<S>, blocks_for(all + v.poses), 1, kThreads, stream, sums, keys, out.wrong, v.poses, v.count, v.slots, v.shown,
                      v.total, verdict); });
    return steps.result();
}

template <class S> int64_t bin(const Call& call) {
    Reader in(call);
    const View<S> v = read_view<S>(call, in);
    const int64_t capacity = v.capacity;
    const int tiles = v.poses * v.tiles, bits = bits_for(tiles);
    Arena arena(reinterpret_cast<void*>(uintptr_t(call.scratch)));
    uint32_t *keys = arena.take<uint32_t>(capacity), *sorted_keys = arena.take<uint32_t>(capacity);
    int32_t *numbers = arena.take<int32_t>(capacity), *slots = arena.take<int32_t>(capacity), *gaussians = arena.take<int32_t>(capacity);
    size_t bytes = 0;
    Steps steps;
    steps.then([&] { return sort_pairs<uint32_t>(nullptr, bytes, keys, sorted_keys, numbers, slots, capacity, bits, nullptr); });
    char* temp = arena.take<char>(bytes);
    if (steps.result() || arena.measuring()) return steps.result() ? steps.result() : arena.bytes();

    void* stream = reinterpret_cast<void*>(uintptr_t(call.stream));
    steps.then([&] { return launch(number_slots, blocks_for(capacity), 1, kThreads, stream, numbers, keys, v.total, v.capacity, tiles); });
    steps.then([&] { return list<S>(v, stream, nullptr, nullptr, keys, gaussians); });
    if (capacity > 0) steps.then([&] { return sort_pairs<uint32_t>(temp, bytes, keys, sorted_keys, numbers, slots, capacity, bits, stream); });
    steps.then([&] { return launch(write_entries, blocks_for(capacity + 1), 1, kThreads, stream, sorted_keys, slots, gaussians, v.capacity, tiles,
                      v.starts, v.gaussians, v.slot_of); });
    return steps.result();
}

// Fills the grid's tables (host memory); with none, returns how many numbers they hold.
template <class S> int64_t tables(const Call& call) {
    const auto settings = in_precision<S>(call.settings);
    S* const numbers = Reader(call).next<S>();
    if (!numbers) return table_size(settings);
    fill_tables(settings, numbers);
    return 0;
}

}  // namespace
}  // namespace GSPARC_ISA
}  // namespace gsparc

// Each call first with scratch 0: returns the bytes of scratch it needs. Then 0, or minus a CUDA error.
GSPARC_ENTRY(plan, plan<S>(call))
GSPARC_ENTRY(bin, bin<S>(call))
GSPARC_ENTRY(tables, tables<S>(call))

extern "C" {

// Whether the driver can run these kernels on the call's device; `built_for` and `driver` receive the CUDA versions of
// the build and of the driver.
int64_t gsparc_check(gsparc::Call* call) {
#ifdef __CUDACC__
    using namespace gsparc::GSPARC_ISA;
    cudaFuncAttributes known;
    call->built_for = CUDART_VERSION;
    Steps steps;
    steps.then([&] { return cudaDriverGetVersion(&call->driver); });
    steps.then([&] { return use_device(call->device); });
    steps.then([&] { return cudaFuncGetAttributes(&known, look_for_disorder); });
    return steps.result();
#else
    return call->built_for = call->driver = 0;
#endif
}

const char* gsparc_error(int64_t code) {
    using namespace gsparc;
#ifdef __CUDACC__
    return cudaGetErrorString(cudaError_t(code));
#else
    return shim::message(code);
#endif
}

}  // extern "C"

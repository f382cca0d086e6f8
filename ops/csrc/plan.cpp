// Order and bins: which strip holds which footprints, front to back.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <type_traits>
#include <utility>
#include <vector>

#include "kernels.h"
#include "pool.h"
#include "pose.h"
#include "workspace.h"

namespace gsparc {
namespace {

template <class S> struct PlanArgs {
    Model<S> model;
    const int64_t* ids;                // (N,) or null: the row number
    int poses, count, strips, threads;
    KernelSettings<S> settings;
    S *records, *means2d, *radii;      // (P, N, kRecord) by depth; (P, N, 2) and (P, N) by Gaussian
    bool* visible;                     // (P, N)
    Box* boxes;                        // (P, N) by depth
    int32_t *order, *shown;            // (P, N), (P,)
    int64_t *slots, *strip_starts;     // (P, N + 1) or null, (P strips + 1)
};

template <class S> using Bits = std::conditional_t<sizeof(S) == 4, uint32_t, uint64_t>;

// A visible Gaussian and the bits of its depth: those of non-negative numbers order as the numbers do.
template <class S> struct Item {
    Bits<S> key;
    int32_t value;
};

// [begin, end) of part `k` of `parts` equal parts of `count`.
struct Part {
    int64_t begin, end;
    Part(int64_t count, int k, int parts) : begin(count * k / parts), end(count * (k + 1) / parts) {}
};

// The visible ones by (depth, id), then the others by id; `by_id` is null where ids are row numbers. Returns how many
// are visible. A radix sort in as many passes as the spread of the depths needs; each part of the items counts and
// moves its own, so that the order does not depend on how many parts there are.
template <class S> int arrange(const S* depths, const bool* visible, const int32_t* by_id, int64_t count, int threads, int32_t* order) {
    const Workspace<Item<S>> one(count + 1), two(count + 1);
    Bits<S> base = ~Bits<S>(0), top = 0;
    int64_t total = 0, hidden = 0;
    for (int64_t at = 0; at < count; ++at) {
        const int32_t i = by_id ? by_id[at] : int32_t(at);
        const bool seen = visible[i];
        Bits<S> key;
        std::memcpy(&key, depths + i, sizeof key);
        one[total] = {key, i}, order[hidden] = i;  // without a branch: what is not counted is written over
        const Bits<S> all = Bits<S>(0) - Bits<S>(seen);
        base = std::min(base, Bits<S>(key | ~all)), top = std::max(top, Bits<S>(key & all));
        total += seen, hidden += !seen;
    }
    if (hidden) std::memmove(order + total, order, hidden * sizeof *order);
    if (total == 0) return 0;
    const Bits<S> spread = top - base;
    const int parts = total >= 8192 && threads > 1 ? std::min(threads, 8) : 1;
    int bits = 0;
    while (bits < int(8 * sizeof(S)) && spread >> bits != 0) ++bits;
    const int most = total >= 16384 ? 14 : 12, passes = (bits + most - 1) / most;  // more buckets than items only cost
    const int digit = passes ? (bits + passes - 1) / passes : 1, buckets = 1 << digit;
    Item<S>*from = one.data, *to = two.data;
    std::vector<uint32_t> counts(int64_t(parts) * buckets);
    for (int shift = 0; shift < bits; shift += digit) {
        auto bucket = [&](const Item<S>& item) { return (item.key - base) >> shift & (buckets - 1); };
        auto tally = [&](int k, int) {
            const Part part(total, k, parts);
            uint32_t* mine = counts.data() + int64_t(k) * buckets;
            std::fill_n(mine, buckets, 0);
            for (int64_t at = part.begin; at < part.end; ++at) ++mine[bucket(from[at])];
        };
        parallel_for(parts, threads, tally);
        uint32_t start = 0;
        for (int b = 0; b < buckets; ++b)
            for (int k = 0; k < parts; ++k) start += std::exchange(counts[int64_t(k) * buckets + b], start);
        auto move = [&](int k, int) {
            const Part part(total, k, parts);
            uint32_t* mine = counts.data() + int64_t(k) * buckets;
            for (int64_t at = part.begin; at < part.end; ++at) to[mine[bucket(from[at])]++] = from[at];
        };
        parallel_for(parts, threads, move);
        std::swap(from, to);
    }
    for (int64_t at = 0; at < total; ++at) order[at] = from[at].value;
    return int(total);
}

constexpr int kAhead = 16;    // boxes asked for that long before they are needed
constexpr int kBinned = 1024;  // ranks that one task bins

// Counts of footprints per strip, one row for each chunk of ranks.
struct Bins {
    int poses, chunks, strips;
    Bins(int poses, int count, int strips) : poses(poses), chunks((count + kBinned - 1) / kBinned), strips(strips) {}
    int64_t size() const { return int64_t(poses) * chunks * strips; }
    int64_t of(int task) const { return int64_t(task) * strips; }
};

// Counts per strip of footprints noted by their first and last strip: without a loop, or its branch, for each.
class Ends {
public:
    explicit Ends(int strips) : steps_(strips + 1) {}
    void note(int first, int last) { ++steps_[first], --steps_[last + 1]; }
    void add_to(int32_t* counts) const {
        int32_t open = 0;
        for (size_t strip = 0; strip + 1 < steps_.size(); ++strip) counts[strip] += open += steps_[strip];
    }

private:
    std::vector<int32_t> steps_;
};

template <class S> int64_t make_plan(const PlanArgs<S>& a) {
    const int64_t count = a.count;
    for (int pose = 0; pose < a.poses; ++pose)
        if (!sound_pose(a.model.positions + 3 * pose, a.model.rotations + 9 * pose)) return kUnsoundPose;
    const Workspace<S> depths(a.poses * count);
    const Workspace<Box> boxes(a.poses * count);
    constexpr int chunk = kBinned;
    const int chunks = int((count + chunk - 1) / chunk);
    std::vector<int64_t> wrong(std::max(chunks, 1), -1);
    auto project = [&](int task, int) {
        const int pose = task / chunks;
        const int64_t base = pose * count;
        const ProjectArgs<S> one = {a.model, a.count, a.settings, a.records + base * kRecord, depths.data + base,
                                    a.means2d + 2 * base, a.radii + base, boxes.data + base, a.visible + base, pose};
        const int begin = task % chunks * chunk;
        const int64_t bad = kernels<S>().project(one, begin, std::min(begin + chunk, a.count));
        if (pose == 0) wrong[task] = bad;
    };
    parallel_for(a.poses * chunks, a.threads, project);
    for (int64_t bad : wrong)
        if (bad >= 0) return bad;

    std::vector<int32_t> by_id;
    if (a.ids && !std::is_sorted(a.ids, a.ids + count)) {
        by_id.resize(count);
        for (int64_t i = 0; i < count; ++i) by_id[i] = int32_t(i);
        std::stable_sort(by_id.begin(), by_id.end(), [&](int32_t x, int32_t y) { return a.ids[x] < a.ids[y]; });
    }

    auto order = [&](int pose, int) {
        const int64_t base = pose * count;
        a.shown[pose] = arrange(depths.data + base, a.visible + base, by_id.empty() ? nullptr : by_id.data(), count, a.poses > 1 ? 1 : a.threads, a.order + base);
    };
    if (a.poses == 1) order(0, 0);
    else parallel_for(a.poses, a.threads, order);
    auto alike = [&](int32_t x, int32_t y) { return a.ids[x] == a.ids[y]; };
    const auto at_id = [&](int64_t at) { return by_id.empty() ? int32_t(at) : by_id[at]; };
    bool twice = false;
    for (int64_t at = 1; a.ids && at < count; ++at) twice |= alike(at_id(at - 1), at_id(at));
    for (int pose = 0; twice && pose < a.poses; ++pose) {
        const int32_t* ranks = a.order + pose * count;
        const S* far = depths.data + pose * count;
        for (int rank = 1; rank < a.shown[pose]; ++rank)
            if (far[ranks[rank - 1]] == far[ranks[rank]] && alike(ranks[rank - 1], ranks[rank])) return kEqualIds;
    }
    const Bins bins(a.poses, a.count, a.strips);
    std::vector<int32_t> per_bin(bins.size());
    std::vector<int64_t> per_chunk(a.poses * chunks);
    auto copy = [&](int task, int) {
        const int pose = task / chunks;
        const int64_t base = pose * count, begin = int64_t(task % chunks) * chunk, end = std::min(begin + chunk, count);
        Ends ends(a.strips);
        int64_t* slots = a.slots + pose * (count + 1);
        int64_t total = 0;
        for (int64_t rank = begin; rank < end; ++rank) {
            slots[rank] = total;
            if (rank < a.shown[pose]) {
                if (rank + kAhead < end) __builtin_prefetch(boxes.data + base + a.order[base + rank + kAhead]);
                const Box box = a.boxes[base + rank] = boxes.data[base + a.order[base + rank]];
                const int first = box.row0 / kStripRows, last = (box.row1 - 1) / kStripRows;
                ends.note(first, last);
                total += last - first + 1;
            } else {
                a.boxes[base + rank] = {0, 0, 0, 0};
            }
        }
        per_chunk[task] = total;
        ends.add_to(per_bin.data() + bins.of(task));
    };
    parallel_for(a.poses * chunks, a.threads, copy);
    int64_t before = 0;
    for (int64_t& total : per_chunk) before += std::exchange(total, before);  // where each chunk's slots begin
    auto shift = [&](int task, int) {
        const int64_t pose = task / chunks, begin = int64_t(task % chunks) * chunk, end = std::min(begin + chunk, count);
        int64_t* slots = a.slots + pose * (count + 1);
        for (int64_t rank = begin; rank < end; ++rank) slots[rank] += per_chunk[task];
        if (end == count) slots[count] = task + 1 < a.poses * chunks ? per_chunk[task + 1] : before;
    };
    parallel_for(a.poses * chunks, a.threads, shift);
    if (count == 0) std::fill_n(a.slots, a.poses, 0);
    a.strip_starts[0] = 0;
    for (int64_t pose = 0, at = 0; pose < a.poses; ++pose)
        for (int strip = 0; strip < a.strips; ++strip, ++at) {
            int64_t total = 0;
            for (int k = 0; k < chunks; ++k) total += per_bin[bins.of(int(pose) * chunks + k) + strip];
            a.strip_starts[at + 1] = a.strip_starts[at] + total;
        }
    return -1;
}

// Each chunk of ranks writes its own stretch of every strip, so ranks stay in order whoever writes.
template <class S> void fill_entries(const PlanView<S>& plan, int threads, int32_t* entries) {
    const Bins bins(plan.poses, plan.count, plan.strips);
    std::vector<int32_t> counts(bins.size());
    auto each = [&](int task, auto visit) {
        const int64_t pose = task / bins.chunks, begin = int64_t(task % bins.chunks) * kBinned;
        const int64_t end = std::min<int64_t>(begin + kBinned, plan.shown[pose]);
        const Box* boxes = plan.boxes + pose * plan.count;
        for (int64_t rank = begin; rank < end; ++rank) visit(int32_t(rank), boxes[rank].row0 / kStripRows, (boxes[rank].row1 - 1) / kStripRows);
    };
    auto count = [&](int task, int) {
        Ends ends(plan.strips);
        each(task, [&](int32_t, int first, int last) { ends.note(first, last); });
        ends.add_to(counts.data() + bins.of(task));
    };
    parallel_for(plan.poses * bins.chunks, threads, count);
    for (int pose = 0; pose < plan.poses; ++pose)
        for (int strip = 0; strip < plan.strips; ++strip) {
            int32_t before = 0;
            for (int k = 0; k < bins.chunks; ++k) before += std::exchange(counts[bins.of(pose * bins.chunks + k) + strip], before);
        }
    auto write = [&](int task, int) {
        int32_t* next = counts.data() + bins.of(task);
        const int64_t* starts = plan.strip_starts + int64_t(task / bins.chunks) * plan.strips;
        each(task, [&](int32_t rank, int first, int last) {
            for (int strip = first; strip <= last; ++strip) entries[starts[strip] + next[strip]++] = rank;
        });
    };
    parallel_for(plan.poses * bins.chunks, threads, write);
}

template <class S> int64_t plan_of(const Call& call) {
    Reader in(call);
    PlanArgs<S> a;
    in.sizes(a.poses, a.count);
    a.threads = call.threads, a.settings = in_precision<S>(call.settings), a.strips = strips_of(a.settings.height);
    a.model = read_model<S>(in);
    in.read(a.ids, a.records, a.boxes, a.order, a.shown, a.slots, a.strip_starts, a.means2d, a.radii, a.visible);
    return make_plan(a);
}

template <class S> int64_t entries_of(const Call& call) {
    Reader in(call);
    const ViewArgs<S> a(call, in);
    fill_entries(a.plan, a.threads, const_cast<int32_t*>(a.plan.entries));
    return 0;
}

}  // namespace

int64_t plan(const Call& call) { return call.twice ? plan_of<double>(call) : plan_of<float>(call); }
int64_t entries(const Call& call) { return call.twice ? entries_of<double>(call) : entries_of<float>(call); }

}  // namespace gsparc

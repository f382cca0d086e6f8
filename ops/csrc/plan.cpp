#include "plan.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "pool.h"

namespace gsparc {
namespace {

// Stable radix sort of items by the bits of non-negative numbers, 11 bits at a time.
template <class S> void sort_by_depth(const S* depths, std::vector<int32_t>& items) {
    using Bits = std::conditional_t<sizeof(S) == 4, uint32_t, uint64_t>;
    struct Item {
        Bits key;
        int32_t value;
    };
    constexpr int digit = 11, passes = (8 * sizeof(S) + digit - 1) / digit, buckets = 1 << digit;
    std::vector<Item> from(items.size()), to(items.size());
    std::vector<std::array<uint32_t, buckets>> counts(passes);
    for (auto& count : counts) count.fill(0);
    for (size_t k = 0; k < items.size(); ++k) {
        from[k].value = items[k];
        std::memcpy(&from[k].key, depths + items[k], sizeof(Bits));
        for (int pass = 0; pass < passes; ++pass) ++counts[pass][from[k].key >> (digit * pass) & (buckets - 1)];
    }
    for (int pass = 0; pass < passes; ++pass) {
        auto& count = counts[pass];
        if (std::find(count.begin(), count.end(), items.size()) != count.end()) continue;  // one digit for all
        uint32_t start = 0;
        for (auto& c : count) start += std::exchange(c, start);
        for (const Item& item : from) to[count[item.key >> (digit * pass) & (buckets - 1)]++] = item;
        from.swap(to);
    }
    for (size_t k = 0; k < items.size(); ++k) items[k] = from[k].value;
}

constexpr int kBinned = 1024;  // ranks that one task bins

// Counts of footprints per strip, one row for each chunk of ranks.
struct Bins {
    int poses, chunks, strips;
    Bins(int poses, int count, int strips) : poses(poses), chunks((count + kBinned - 1) / kBinned), strips(strips) {}
    int64_t size() const { return int64_t(poses) * chunks * strips; }
    int64_t of(int task) const { return int64_t(task) * strips; }
};

}  // namespace

template <class S> int64_t make_plan(const PlanArgs<S>& a) {
    const int64_t count = a.count;
    // Not vectors: those would write zeros first.
    const std::unique_ptr<S[]> records(new S[a.poses * count * kRecord]), depths(new S[a.poses * count]);
    const std::unique_ptr<Box[]> boxes(new Box[a.poses * count]);
    constexpr int chunk = kBinned;
    const int chunks = int((count + chunk - 1) / chunk);
    std::vector<int64_t> wrong(std::max(chunks, 1), -1);
    auto project = [&](int task, int) {
        const int pose = task / chunks;
        const int64_t base = pose * count;
        const ProjectArgs<S> one = {a.model, a.count, a.lens, records.get() + base * kRecord, depths.get() + base,
                                    a.means2d + 2 * base, a.radii + base, boxes.get() + base, a.visible + base, pose};
        const int begin = task % chunks * chunk;
        const int64_t bad = kernels<S>().project(one, begin, std::min(begin + chunk, a.count));
        if (pose == 0) wrong[task] = bad;
    };
    parallel_for(a.poses * chunks, a.threads, project);
    for (int64_t bad : wrong)
        if (bad >= 0) return bad;

    std::vector<int32_t> by_id(count);
    for (int64_t i = 0; i < count; ++i) by_id[i] = int32_t(i);
    if (a.ids && !std::is_sorted(a.ids, a.ids + count))
        std::stable_sort(by_id.begin(), by_id.end(), [&](int32_t x, int32_t y) { return a.ids[x] < a.ids[y]; });

    auto arrange = [&](int pose, int) {
        const int64_t base = pose * count;
        std::vector<int32_t> items, hidden;
        items.reserve(count);
        for (int32_t i : by_id) (a.visible[base + i] ? items : hidden).push_back(i);
        a.shown[pose] = int32_t(items.size());
        sort_by_depth(depths.get() + base, items);
        std::copy(items.begin(), items.end(), a.order + base);
        std::copy(hidden.begin(), hidden.end(), a.order + base + items.size());
    };
    parallel_for(a.poses, a.threads, arrange);
    const Bins bins(a.poses, a.count, a.strips);
    std::vector<int32_t> per_bin(bins.size());
    std::vector<int64_t> per_chunk(a.poses * chunks);
    auto copy = [&](int task, int) {
        const int pose = task / chunks;
        const int64_t base = pose * count, begin = int64_t(task % chunks) * chunk, end = std::min(begin + chunk, count);
        int32_t* in_strip = per_bin.data() + bins.of(task);
        int64_t* slots = a.slots + pose * (count + 1);
        int64_t total = 0;
        for (int64_t rank = begin; rank < end; ++rank) {
            slots[rank] = total;
            const int64_t i = base + a.order[base + rank];
            S* record = a.records + (base + rank) * kRecord;
            if (rank < a.shown[pose]) {
                const Box box = a.boxes[base + rank] = boxes[i];
                std::copy_n(records.get() + i * kRecord, kRecord, record);
                const int first = box.row0 / kStripRows, last = (box.row1 - 1) / kStripRows;
                for (int strip = first; strip <= last; ++strip) ++in_strip[strip];
                total += last - first + 1;
            } else {
                a.boxes[base + rank] = {0, 0, 0, 0};
                std::fill_n(record, kRecord, S(0));
            }
        }
        per_chunk[task] = total;
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
        for (int64_t rank = begin; rank < end; ++rank)
            for (int strip = boxes[rank].row0 / kStripRows; strip <= (boxes[rank].row1 - 1) / kStripRows; ++strip) visit(int32_t(rank), strip);
    };
    auto count = [&](int task, int) {
        int32_t* mine = counts.data() + bins.of(task);
        each(task, [&](int32_t, int strip) { ++mine[strip]; });
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
        each(task, [&](int32_t rank, int strip) { entries[starts[strip] + next[strip]++] = rank; });
    };
    parallel_for(plan.poses * bins.chunks, threads, write);
}

template int64_t make_plan(const PlanArgs<float>&);
template int64_t make_plan(const PlanArgs<double>&);
template void fill_entries(const PlanView<float>&, int, int32_t*);
template void fill_entries(const PlanView<double>&, int, int32_t*);

}  // namespace gsparc

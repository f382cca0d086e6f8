#include "plan.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <memory>
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

}  // namespace

template <class S> int64_t make_plan(const PlanArgs<S>& a) {
    const int64_t count = a.count;
    // Not vectors: those would write zeros first.
    const std::unique_ptr<S[]> records(new S[a.poses * count * kRecord]), depths(new S[a.poses * count]);
    const std::unique_ptr<Box[]> boxes(new Box[a.poses * count]);
    constexpr int chunk = 1024;
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

    std::vector<int64_t> per_pose(a.poses);
    auto arrange = [&](int pose, int) {
        const int64_t base = pose * count;
        std::vector<int32_t> items, hidden;
        items.reserve(count);
        for (int32_t i : by_id) (a.visible[base + i] ? items : hidden).push_back(i);
        a.shown[pose] = int32_t(items.size());
        sort_by_depth(depths.get() + base, items);
        std::copy(items.begin(), items.end(), a.order + base);
        std::copy(hidden.begin(), hidden.end(), a.order + base + items.size());
        int64_t* slots = a.slots + pose * (count + 1);
        int64_t* starts = a.strip_starts + int64_t(pose) * a.strips + 1;
        std::fill(starts, starts + a.strips, 0);
        int64_t total = 0;
        for (int64_t rank = 0; rank < count; ++rank) {
            slots[rank] = total;
            if (rank >= a.shown[pose]) continue;
            const Box box = boxes[base + a.order[base + rank]];
            for (int strip = box.row0 / kStripRows; strip <= (box.row1 - 1) / kStripRows; ++strip) ++starts[strip], ++total;
        }
        slots[count] = total;
        per_pose[pose] = total;
    };
    parallel_for(a.poses, a.threads, arrange);
    auto copy = [&](int task, int) {
        const int pose = task / chunks;
        const int64_t base = pose * count, begin = int64_t(task % chunks) * chunk, end = std::min(begin + chunk, count);
        for (int64_t rank = begin; rank < end; ++rank) {
            const int64_t i = base + a.order[base + rank];
            S* record = a.records + (base + rank) * kRecord;
            if (rank < a.shown[pose]) {
                a.boxes[base + rank] = boxes[i];
                std::copy_n(records.get() + i * kRecord, kRecord, record);
            } else {
                a.boxes[base + rank] = {0, 0, 0, 0};
                std::fill_n(record, kRecord, S(0));
            }
        }
    };
    parallel_for(a.poses * chunks, a.threads, copy);
    a.strip_starts[0] = 0;
    for (int64_t k = 0; k < int64_t(a.poses) * a.strips; ++k) a.strip_starts[k + 1] += a.strip_starts[k];
    int64_t before = 0;
    for (int pose = 0; pose < a.poses; ++pose) {
        for (int64_t rank = 0; rank <= count; ++rank) a.slots[pose * (count + 1) + rank] += before;
        before += per_pose[pose];
    }
    return -1;
}

template <class S> void fill_entries(const PlanView<S>& plan, int threads, int32_t* entries) {
    auto fill = [&](int task, int) {
        const int64_t base = int64_t(task / plan.strips) * plan.count;
        const int32_t row0 = task % plan.strips * kStripRows, row1 = row0 + kStripRows;
        int32_t* out = entries + plan.strip_starts[task];
        for (int32_t rank = 0; rank < plan.shown[task / plan.strips]; ++rank) {
            const Box& box = plan.boxes[base + rank];
            if (box.row0 < row1 && box.row1 > row0) *out++ = rank;
        }
    };
    parallel_for(plan.poses * plan.strips, threads, fill);
}

template int64_t make_plan(const PlanArgs<float>&);
template int64_t make_plan(const PlanArgs<double>&);
template void fill_entries(const PlanView<float>&, int, int32_t*);
template void fill_entries(const PlanView<double>&, int, int32_t*);

}  // namespace gsparc

// Sorting and summing on the device: CUB on a GPU, the standard library on the host shim.
#pragma once
#include "cuda/device.h"

#ifdef __CUDACC__
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#else
#include <numeric>
#endif

namespace gsparc {
namespace GSPARC_ISA {

// Stable sort of (key, value) pairs by the lowest `bits` of the keys. With temp null, only sets `bytes`.
template <class Key>
int64_t sort_pairs(void* temp, size_t& bytes, const Key* keys, Key* sorted_keys, const int32_t* values, int32_t* sorted,
                   int64_t count, int bits, void* stream) {
#ifdef __CUDACC__
    return cub::DeviceRadixSort::SortPairs(temp, bytes, keys, sorted_keys, values, sorted, count, 0, bits, static_cast<cudaStream_t>(stream));
#else
    bytes = 1;
    if (!temp) return 0;
    const Key mask = bits >= int(8 * sizeof(Key)) ? ~Key(0) : (Key(1) << bits) - 1;
    std::vector<int64_t> at(count);
    std::iota(at.begin(), at.end(), 0);
    std::stable_sort(at.begin(), at.end(), [&](int64_t a, int64_t b) { return (keys[a] & mask) < (keys[b] & mask); });
    for (int64_t k = 0; k < count; ++k) sorted_keys[k] = keys[at[k]], sorted[k] = values[at[k]];
    return 0;
#endif
}

// sums[k] = counts[0] + ... + counts[k]. With temp null, only sets `bytes`.
inline int64_t running_sums(void* temp, size_t& bytes, const int64_t* counts, int64_t* sums, int64_t count, void* stream) {
#ifdef __CUDACC__
    return cub::DeviceScan::InclusiveSum(temp, bytes, counts, sums, count, static_cast<cudaStream_t>(stream));
#else
    bytes = 1;
    if (temp) std::partial_sum(counts, counts + count, sums);
    return 0;
#endif
}

// Bits that numbers up to `largest` need.
inline int bits_for(uint64_t largest) {
    int bits = 1;
    while (largest >> bits) ++bits;
    return bits;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// Whether numbers are finite, told by their bits: without a branch for each.
#pragma once
#include <stdint.h>
#include <string.h>

namespace gsparc {

// Of internal linkage: compiled once per instruction set under one name it would be anybody's.
static inline bool all_finite(const float* numbers, int64_t count) {
    constexpr uint32_t ones = 0x7f800000;
    uint32_t bad = 0;
    for (int64_t at = 0; at < count; ++at) {
        uint32_t bits;
        memcpy(&bits, numbers + at, sizeof bits);
        bad |= uint32_t((bits & ones) == ones);
    }
    return !bad;
}
static inline bool all_finite(const double* numbers, int64_t count) {
    constexpr uint64_t ones = 0x7ff0000000000000;
    uint64_t bad = 0;
    for (int64_t at = 0; at < count; ++at) {
        uint64_t bits;
        memcpy(&bits, numbers + at, sizeof bits);
        bad |= uint64_t((bits & ones) == ones);
    }
    return !bad;
}

}  // namespace gsparc

// Whether numbers are finite, told by their bits: without a branch for each.
#pragma once
#include <stdint.h>
#include <string.h>

namespace gsparc {

// Of internal linkage: compiled once per instruction set under one name it would be anybody's.
template <class S, class Bits> static inline bool all_finite_bits(const S* numbers, int64_t count, Bits ones) {
    Bits bad = 0;
    for (int64_t at = 0; at < count; ++at) {
        Bits bits;
        memcpy(&bits, numbers + at, sizeof bits);
        bad |= Bits((bits & ones) == ones);
    }
    return !bad;
}
static inline bool all_finite(const float* numbers, int64_t count) { return all_finite_bits<float, uint32_t>(numbers, count, 0x7f800000); }
static inline bool all_finite(const double* numbers, int64_t count) { return all_finite_bits<double, uint64_t>(numbers, count, 0x7ff0000000000000); }

}  // namespace gsparc

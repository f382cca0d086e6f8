// Which footprints a strip holds, sixteen looked at a time.
#pragma once
#include "kernels.h"
#include "simd.h"

namespace gsparc {
namespace GSPARC_ISA {

// Writes the ranks below `count`, in order, whose strips [first, last] hold `strip`. Null where there is no compression:
// then each footprint is handed to its strips.
#if defined(__AVX512F__)
inline void bin_strip(const int16_t* first, const int16_t* last, int count, int strip, int32_t* to) {
    const __m256i here = _mm256_set1_epi16(int16_t(strip));
    __m512i ranks = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    for (int at = 0; at < count; at += 16, ranks = _mm512_add_epi32(ranks, _mm512_set1_epi32(16))) {
        const __m256i from = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(first + at));
        const __m256i till = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(last + at));
        const __mmask16 found = _mm256_cmple_epi16_mask(from, here) & _mm256_cmple_epi16_mask(here, till);
        const int some = __builtin_popcount(found);
        // Only what was found is written: behind it lie another strip's ranks.
        _mm512_mask_storeu_epi32(to, __mmask16((1u << some) - 1), _mm512_maskz_compress_epi32(found, ranks));
        to += some;
    }
}
constexpr auto kBinStrip = &bin_strip;
#else
constexpr void (*kBinStrip)(const int16_t*, const int16_t*, int, int, int32_t*) = nullptr;
#endif

}  // namespace GSPARC_ISA
}  // namespace gsparc

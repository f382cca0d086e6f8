// Instruction sets, and whether this machine runs one.
#pragma once
#ifdef GSPARC_X86
#include <cpuid.h>
#endif
#include <string.h>

namespace gsparc {

// Instruction sets, the fastest first.
#ifdef GSPARC_X86
#define GSPARC_SETS(X) X(avx512) X(avx2) X(baseline)
#else
#define GSPARC_SETS(X) X(baseline)
#endif

#ifdef GSPARC_X86
// Asked of the processor itself: `__builtin_cpu_supports` is never true without the runtime library of gcc or clang.
struct Processor {
    bool avx2 = false, avx512 = false;
    Processor() {
        unsigned a, b, c, d, saved = 0;
        if (!__get_cpuid(1, &a, &b, &c, &d)) return;
        const bool fma = c >> 12 & 1;
        if (c >> 27 & 1) __asm__("xgetbv" : "=a"(saved), "=d"(d) : "c"(0));  // registers that the system keeps for each thread
        if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return;
        constexpr unsigned avx2_bit = 1u << 5, bmi2 = 1u << 8, f = 1u << 16, dq = 1u << 17, bw = 1u << 30, vl = 1u << 31;
        constexpr unsigned wide = f | dq | bw | vl | bmi2;
        avx2 = fma && (b & avx2_bit) && (saved & 0x06) == 0x06;
        avx512 = avx2 && (b & wide) == wide && (saved & 0xe0) == 0xe0;
    }
};
#endif

inline bool runs(const char* name) {
#ifdef GSPARC_X86
    static const Processor processor;
    if (!strcmp(name, "avx512")) return processor.avx512;
    if (!strcmp(name, "avx2")) return processor.avx2;
#endif
    return !strcmp(name, "baseline");
}

}  // namespace gsparc

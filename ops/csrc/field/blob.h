// Named arrays of one file, checked before they are used.
#pragma once
#include <stdint.h>

namespace gsparc {

struct Refused {
    char why[160];
};
[[noreturn]] void refuse(const char* format, ...);  // throws Refused

enum class Type : uint32_t { kSingle, kDouble, kInt32, kInt64 };
// What is inlined always would else be compiled per instruction set under one name.
#define GSPARC_ALWAYS inline __attribute__((always_inline))
GSPARC_ALWAYS Type type_of(const float*) { return Type::kSingle; }
GSPARC_ALWAYS Type type_of(const double*) { return Type::kDouble; }
GSPARC_ALWAYS Type type_of(const int32_t*) { return Type::kInt32; }
GSPARC_ALWAYS Type type_of(const int64_t*) { return Type::kInt64; }

// A copy of a file of `gsparc.apps.export.compiled.blob`: header, table of sections, sections on cache lines.
class Blob {
public:
    Blob(const void* bytes, int64_t size);  // throws Refused
    ~Blob();
    Blob(const Blob&) = delete;
    int64_t count(const char* name) const;  // numbers of an array, 0 where there is none
    const void* find(const char* name, Type type, int64_t count) const;  // throws Refused where it is otherwise
    // Points at arrays of so many numbers, which may be none.
    template <class T> GSPARC_ALWAYS void read(const char* name, const T*& to, int64_t count) const {
        to = static_cast<const T*>(find(name, type_of(to), count));
    }

private:
    char* data_;
    const struct Section* sections_;
    int64_t many_;
};

// A form's numbers, one after the other.
struct Numbers {
    const double *at, *end;
    explicit Numbers(const Blob& blob);
    double next();
    int size(int64_t most = 1 << 20);  // an integer from 0
    GSPARC_ALWAYS bool flag() { return size(1) == 1; }
    template <class... T> GSPARC_ALWAYS void sizes(T&... to) { ((to = size()), ...); }
    template <class... T> GSPARC_ALWAYS void values(T&... to) { ((to = T(next())), ...); }
};

}  // namespace gsparc

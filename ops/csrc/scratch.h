// Memory lent for one call, handed out in pieces that start on cache lines.
#pragma once
#include <stdint.h>

namespace gsparc {

struct Scratch {
    uintptr_t next;  // from 0 on it counts bytes alone
    // Inlined always: compiled per instruction set under one name it would be anybody's.
    template <class T> inline __attribute__((always_inline)) T* take(int64_t count) {
        T* const piece = reinterpret_cast<T*>(next);
        next += (uintptr_t(count) * sizeof(T) + 63) / 64 * 64;
        return piece;
    }
};

// Bytes that a `Memory` of these arguments takes.
template <class Memory, class Args> int64_t bytes_of(const Args& args) {
    Scratch counted{0};
    Memory(args, counted);
    return int64_t(counted.next);
}

}  // namespace gsparc

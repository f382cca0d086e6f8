// Memory that calls borrow and give back: fresh pages of megabytes would cost as much as a kernel.
#pragma once
#include <stdint.h>

namespace gsparc {

void* borrow(int64_t bytes);   // starts on a cache line; aborts as `new` does where there is none
void give_back(void* memory);  // kept for the next to come, up to a bound

// Uninitialised memory for the time of a scope.
template <class T> struct Workspace {
    T* const data;
    explicit Workspace(int64_t size) : data(static_cast<T*>(borrow(size * int64_t(sizeof(T))))) {}
    ~Workspace() { give_back(data); }
    Workspace(const Workspace&) = delete;
    T& operator[](int64_t i) const { return data[i]; }
};

}  // namespace gsparc

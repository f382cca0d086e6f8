// Runs recorded calls of the kernels on the host shim, in a process of its own that a sanitizer watches: each tensor
// in an allocation of exactly its size. A record is a name (32 bytes), a Call, a count, and for each tensor its bytes
// (-1: absent) and its contents.
#include <stdio.h>
#include <stdlib.h>

#include <memory>
#include <string>
#include <vector>

#define GSPARC_ISA device
#include "cuda/view.h"

using gsparc::Call;
extern "C" {
int64_t gsparc_plan(const Call*);
int64_t gsparc_bin(const Call*);
int64_t gsparc_composite(const Call*);
int64_t gsparc_composite_backward(const Call*);
int64_t gsparc_weights(const Call*);
int64_t gsparc_weights_backward(const Call*);
int64_t gsparc_thaw(const Call*);
const char* gsparc_error(int64_t);
}

struct Kernel {
    const char* name;
    int64_t (*run)(const Call*);
};
const Kernel kernels[] = {
    {"plan", gsparc_plan}, {"bin", gsparc_bin}, {"composite", gsparc_composite}, {"composite_backward", gsparc_composite_backward},
    {"weights", gsparc_weights}, {"weights_backward", gsparc_weights_backward}, {"thaw", gsparc_thaw},
};

int main(int, char** arguments) {
    FILE* file = fopen(arguments[1], "rb");
    char name[32];
    int calls = 0;
    while (file && fread(name, sizeof name, 1, file) == 1) {
        Call call;
        int64_t count, bytes;
        if (fread(&call, sizeof call, 1, file) != 1 || fread(&count, sizeof count, 1, file) != 1) return 2;
        std::vector<std::unique_ptr<char, void (*)(void*)>> memory;
        auto take = [&](int64_t size) {
            memory.emplace_back(static_cast<char*>(malloc(size)), free);
            return memory.back().get();
        };
        for (int k = 0; k < count; ++k) {
            if (fread(&bytes, sizeof bytes, 1, file) != 1) return 2;
            char* at = bytes < 0 ? nullptr : take(bytes);
            if (bytes > 0 && fread(at, bytes, 1, file) != 1) return 2;
            call.tensors[k] = reinterpret_cast<uintptr_t>(at);
        }
        const int before = calls;
        for (const Kernel& kernel : kernels) {
            if (std::string(name) != kernel.name) continue;
            call.scratch = 0;
            const int64_t needed = kernel.run(&call);
            call.scratch = needed < 0 ? 0 : reinterpret_cast<uintptr_t>(take(needed));
            const int64_t result = needed < 0 ? needed : kernel.run(&call);
            if (result < 0) return printf("%s: %s\n", name, gsparc_error(-result)), 3;
            ++calls;
        }
        if (calls == before) return printf("%s: a kernel that is not in the list above\n", name), 4;
    }
    printf("%d calls\n", calls);
    return calls ? 0 : 2;
}

// Picks the fastest set of kernels this machine can run.
#include "kernels.h"
#include "processor.h"

namespace gsparc {

#define X(set)                                   \
    namespace set {                              \
    extern const Kernels<float> single_kernels;  \
    extern const Kernels<double> double_kernels; \
    }
GSPARC_SETS(X)
#undef X

namespace {

struct Set {
    const char* name;
    const Kernels<float>& single;
    const Kernels<double>& twice;
};

#define X(set) {#set, set::single_kernels, set::double_kernels},
const Set kSets[] = {GSPARC_SETS(X)};
#undef X
constexpr int kCount = sizeof kSets / sizeof kSets[0];

int fastest() {
    int best = 0;
    while (!runs(kSets[best].name)) ++best;
    return best;
}

int& choice() {
    static int index = fastest();
    return index;
}

}  // namespace

template <> const Kernels<float>& kernels<float>() { return kSets[choice()].single; }
template <> const Kernels<double>& kernels<double>() { return kSets[choice()].twice; }
const char* instruction_set() { return kSets[choice()].name; }

bool use_instruction_set(const char* name) {
    for (int k = 0; k < kCount; ++k)
        if (!strcmp(kSets[k].name, name) && runs(name)) return choice() = k, true;
    return false;
}

}  // namespace gsparc

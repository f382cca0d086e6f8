// What every form of a field is, once it is loaded.
#pragma once
#include "../scratch.h"
#include "blob.h"
#include "gsparc_field.h"

namespace gsparc {

struct Form {
    gsparc_facts facts{};
    virtual ~Form() = default;
    // `place` is finite and on Earth; `variance` and `unknown` may be null.
    virtual int answer(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const = 0;
};

}  // namespace gsparc

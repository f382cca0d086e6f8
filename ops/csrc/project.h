// From Gaussians to records and boxes, a range at a time.
#pragma once
#include "boxes.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> int64_t project_range(const ProjectArgs<S>& a, int begin, int end) {
    for (int64_t i = begin; i < end; ++i) {
        const int wrong = project_one(a, i);
        if (wrong >= 0) return 4 * i + wrong;
    }
    return -1;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

// The projections, each a class with all that is its own: footprints, frames, records, offsets, and on the CPU lines.
#pragma once
#include "boxes.h"
#ifdef GSPARC_PACKS
#include "lines.h"
#endif
#include "projection/equirect.h"
#include "projection/tangent.h"

namespace gsparc {
namespace GSPARC_ISA {

// Calls run(P()) for the projection of the settings.
template <class F> auto with_projection(int which, F run) {
    int index = 0;
#define X(P, name) \
    if (which == index++) return run(P());
    GSPARC_PROJECTIONS(X)
#undef X
    return run(Tangent());
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

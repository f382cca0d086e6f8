// The kernels as Python sees them. calls.py, the only caller, has checked shape, dtype and contiguity of the tensors and
// keeps them alive.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "kernels.h"

namespace nb = nanobind;
using namespace gsparc;

namespace {

// Takes the address of a `Call`; runs without Python's lock.
template <class F> void define(nb::module_& module, const char* name, F kernel) {
    module.def(name, [kernel](uintptr_t at) {
        nb::gil_scoped_release unlocked;
        return kernel(*reinterpret_cast<const Call*>(at));
    });
}

}  // namespace

NB_MODULE(_native, module) {
    module.doc() = "GSpaRC CPU kernels; see calls.py for their arguments";
    module.attr("CALL_BYTES") = sizeof(Call);
#define X(type, name) #name,
    module.attr("PROJECTIONS") = std::vector<std::string>{GSPARC_PROJECTIONS(X)};
#undef X
    module.attr("RECORD") = kRecord;
    module.attr("MOMENTS") = kMoments;
    module.attr("STRIP_ROWS") = kStripRows;
    module.attr("UNSOUND_POSE") = kUnsoundPose;
    module.attr("EQUAL_IDS") = kEqualIds;
    module.attr("TILE_WIDTH") = kTileWidth;
    module.attr("TILE_HEIGHT") = kTileHeight;
    define(module, "plan", plan);
    define(module, "entries", entries);
#define X(name) define(module, #name, [](const Call& call) { return (call.twice ? kernels<double>().name : kernels<float>().name)(call); });
    GSPARC_KERNELS(X)
#undef X
    module.def("instruction_set", &instruction_set);
    module.def("use_instruction_set", &use_instruction_set);
}

// The kernels, compiled once per instruction set (GSPARC_ISA names it); results do not depend on the threads.
#define GSPARC_PACKS
#include "backward.h"
#include "directional.h"
#include "frozen.h"
#include "project.h"
#include "query.h"
#include "similarity.h"
#include "thaw.h"

namespace gsparc {
namespace GSPARC_ISA {

#define X(name) name<S>,
template <class S> constexpr Kernels<S> all_kernels() { return {project_range<S>, GSPARC_KERNELS(X)}; }
#undef X
extern const Kernels<float> single_kernels = all_kernels<float>();
extern const Kernels<double> double_kernels = all_kernels<double>();

}  // namespace GSPARC_ISA
}  // namespace gsparc

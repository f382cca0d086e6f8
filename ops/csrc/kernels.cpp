// The kernels, compiled once per instruction set (GSPARC_ISA names it); results do not depend on the threads.
#define GSPARC_PACKS
#include "backward.h"
#include "bins.h"
#include "channels.h"
#include "frozen.h"
#include "networks.h"
#include "project.h"
#include "similarity.h"
#include "machine_limits.h"

namespace gsparc {
namespace GSPARC_ISA {

extern const Kernels<float> single_kernels;
extern const Kernels<double> double_kernels;
const Kernels<float> single_kernels = {project_range<float>, composite<float>, composite_backward<float>,
                                       weights<float>, weights_backward<float>, freeze<float>, thaw<float>,
                                       networks<float>, networks_backward<float>, similarity, channels<float>, channels_backward<float>,
                                       mark_exponentials, mark_copy, mark_pairs<float>, kBinStrip};
const Kernels<double> double_kernels = {project_range<double>, composite<double>, composite_backward<double>,
                                        weights<double>, weights_backward<double>, freeze<double>, thaw<double>,
                                        networks<double>, networks_backward<double>, similarity, channels<double>, channels_backward<double>,
                                        mark_exponentials, mark_copy, mark_pairs<double>, kBinStrip};

}  // namespace GSPARC_ISA
}  // namespace gsparc

#include <nanobind/nanobind.h>

NB_MODULE(_native, module) { module.doc() = "GSpaRC CPU kernels"; }

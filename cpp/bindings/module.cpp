// The Python module holdfast._kernel: arrays in, arrays out, no logic.
//
// Private: holdfast's typed Python functions check shapes and values before they call in here.

#include <nanobind/nanobind.h>

#include "bindings.hpp"
#include "vector_kernels.hpp"

NB_MODULE(_kernel, module) {
    // A problem that is alive when the interpreter ends, as in any script, is no leak.
    nanobind::set_leak_warnings(false);
    module.def("simd", [] { return holdfast::vector_kernels().name; });
    module.def("sources", [] { return HOLDFAST_SOURCES; });
    holdfast::bind_numerics(module);
    holdfast::bind_entropy(module);
    holdfast::bind_geometry(module);
}

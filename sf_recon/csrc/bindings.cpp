// SPDX-License-Identifier: Apache-2.0
// Python module sf_recon._native.
#include <nanobind/nanobind.h>
#include <omp.h>

NB_MODULE(_native, m) {
    m.doc() = "Compiled kernels of the reconstruction.";
    m.def("max_threads", [] { return omp_get_max_threads(); }, "Threads that OpenMP would use.");
}

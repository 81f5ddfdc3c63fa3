// SPDX-License-Identifier: Apache-2.0
// Improved Point Rasterization on an NVIDIA GPU; the same images as ipr_cpu.hpp. Compiled with -DSF_CUDA=ON only.
#pragma once
#include <cstddef>
#include <memory>
#include <mutex>

#include "ipr_cpu.hpp"

namespace sf {

// Keeps its device memory from frame to frame. Calls from several threads wait for one another.
class CudaRasterizer {
   public:
    explicit CudaRasterizer(int device);
    ~CudaRasterizer();

    // All pointers are on the device. Work is queued on `stream` (a cudaStream_t), which is waited for once, to learn
    // how many fragments there are. Throws std::runtime_error with what the driver says.
    void rasterize(const float* points, const float* normals, size_t n, const RasterSpec& spec,
                   const RasterImages& images, void* stream);

    int device() const { return device_; }

   private:
    struct Workspace;

    int device_;
    std::mutex mutex_;
    std::unique_ptr<Workspace> workspace_;
};

}  // namespace sf

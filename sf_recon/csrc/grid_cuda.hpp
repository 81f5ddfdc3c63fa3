// SPDX-License-Identifier: Apache-2.0
// Nearest points on an NVIDIA GPU; the same answers as point_grid.hpp. Compiled with -DSF_CUDA=ON only.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>

namespace sf {

constexpr int kMaxDeviceNeighbours = 16;

// Points sorted by cell, with a hash table from a cell to its first point. Built anew when the points change.
class CudaGrid {
   public:
    CudaGrid(int device, float cell_size);
    ~CudaGrid();

    // Takes a copy of points [n * 3] on the device. Throws std::runtime_error with what the driver says.
    void build(const float* points, size_t n, void* stream);

    // The k nearest within `radius` (inclusive) of queries [n * 3] on the device, ascending by (distance, id); ids -1
    // and distance2 inf where fewer, and for queries that are not finite.
    void knn(const float* queries, size_t n, int k, float radius, int32_t* ids, float* distance2, void* stream) const;

    int device() const { return device_; }
    size_t size() const { return count_; }

   private:
    struct Memory;

    int device_;
    float inverse_;
    size_t count_ = 0;
    std::unique_ptr<Memory> memory_;
};

}  // namespace sf

// SPDX-License-Identifier: Apache-2.0
// Device memory that grows, the device of a scope, and errors of the driver as exceptions.
#pragma once
#include <cuda_runtime.h>

#include <cstddef>
#include <stdexcept>
#include <string>

namespace sf {

inline void check(cudaError_t error, const char* what) {
    if (error != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(error));
}

class DeviceGuard {
   public:
    explicit DeviceGuard(int device) {
        check(cudaGetDevice(&before_), "cudaGetDevice");
        check(cudaSetDevice(device), "cudaSetDevice");
    }
    ~DeviceGuard() { cudaSetDevice(before_); }
    DeviceGuard(const DeviceGuard&) = delete;
    DeviceGuard& operator=(const DeviceGuard&) = delete;

   private:
    int before_ = 0;
};

class Buffer {
   public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { cudaFree(data_); }

    template <class T>
    T* reserve(size_t count) {
        if (count * sizeof(T) > bytes_) {
            check(cudaFree(data_), "cudaFree");
            data_ = nullptr, bytes_ = 0;
            const size_t wanted = count * sizeof(T) + count * sizeof(T) / 4;
            check(cudaMalloc(&data_, wanted), "cudaMalloc");
            bytes_ = wanted;
        }
        return static_cast<T*>(data_);
    }
    template <class T>
    T* get() const {
        return static_cast<T*>(data_);
    }

   private:
    void* data_ = nullptr;
    size_t bytes_ = 0;
};

}  // namespace sf

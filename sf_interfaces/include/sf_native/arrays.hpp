// SPDX-License-Identifier: Apache-2.0
// What the bindings of all blocks share: arrays of Python as input, arrays that Python will own as output.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <memory>
#include <utility>
#include <vector>

namespace sf {

namespace nb = nanobind;

template <class T, nb::ssize_t... N>
using In = nb::ndarray<const T, nb::shape<N...>, nb::c_contig, nb::device::cpu>;
template <class T, nb::ssize_t... N>
using InOut = nb::ndarray<T, nb::shape<N...>, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<nb::numpy, T>;

// An array to be filled and given to Python; where it is not wanted, none at all.
template <class T>
class Made {
   public:
    explicit Made(std::vector<size_t> shape, bool wanted = true) : shape_(std::move(shape)) {
        size_t size = 1;
        for (const size_t extent : shape_) size *= extent;
        if (wanted) data_.reset(new T[size]);
    }
    T* get() { return data_.get(); }
    Out<T> give() {
        T* raw = data_.release();
        nb::capsule owner(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); });
        return Out<T>(raw, shape_.size(), shape_.data(), owner);
    }
    nb::object give_if_wanted() { return data_ ? nb::cast(give()) : nb::none(); }

   private:
    std::unique_ptr<T[]> data_;
    std::vector<size_t> shape_;
};

// Kernels work on plain memory: other Python threads run meanwhile.
template <class Work>
auto alone(Work work) {
    nb::gil_scoped_release released;
    return work();
}

inline void require(bool good, const char* what) {
    if (!good) throw nb::value_error(what);
}

}  // namespace sf

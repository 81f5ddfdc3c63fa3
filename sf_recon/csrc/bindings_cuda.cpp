// SPDX-License-Identifier: Apache-2.0
// The CUDA sibling in Python: DLPack arrays on one device in, images into arrays that the caller has allocated there.
#ifdef SF_CUDA
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include "ipr_cuda.hpp"

namespace nb = nanobind;

namespace {

using Matrix4 = nb::ndarray<const float, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Points = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cuda>;
template <class T>
using Image = std::optional<nb::ndarray<T, nb::c_contig, nb::device::cuda>>;

template <class T>
T* data_of(const Image<T>& image, size_t pixels, size_t channels, int device) {
    if (!image) return nullptr;
    if (image->size() != pixels * channels) throw nb::value_error("an output image has another size");
    if (image->device_id() != device) throw nb::value_error("an output image lies on another device");
    return image->data();
}

void rasterize(sf::CudaRasterizer& rasterizer, Points points, Matrix4 T_camera_map, float fx, float fy, float cx,
               float cy, int width, int height, float radius, float near, float max_half, int k_ray, float layer_gap,
               float sigma, std::optional<Points> normals, Image<float> depth, Image<float> position,
               Image<int32_t> index, Image<float> weight, Image<float> normal, uintptr_t stream) {
    if (width < 1 || height < 1 || k_ray < 1 || !(near > 0) || !(sigma > 0) || !(max_half >= 0.5f))
        throw nb::value_error("rasterize needs a non-empty image, k_ray >= 1, near > 0, sigma > 0, max_half >= 0.5");
    if (width > 32768 || height > 32768 || max_half > 32768 || points.shape(0) > 2000000000)
        throw nb::value_error("rasterize: at most 32768 pixels a side, 2e9 points");
    if (points.device_id() != rasterizer.device()) throw nb::value_error("the points lie on another device");
    if (normals && (normals->shape(0) != points.shape(0) || normals->device_id() != rasterizer.device()))
        throw nb::value_error("one normal for each point, on the same device");
    if (!depth) throw nb::value_error("the depth image is needed");
    sf::RasterSpec spec{{}, {}, fx, fy, cx, cy, width, height, radius, near, max_half, k_ray, layer_gap, sigma, 0};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) spec.rotation[3 * i + j] = T_camera_map(i, j);
        spec.translation[i] = T_camera_map(i, 3);
    }
    const size_t pixels = static_cast<size_t>(width) * height, k = k_ray;
    const int device = rasterizer.device();
    const sf::RasterImages out{data_of(depth, pixels, 1, device), data_of(position, pixels, 3, device),
                               data_of(index, pixels, k, device), data_of(weight, pixels, k, device),
                               data_of(normal, pixels, 3, device)};
    nb::gil_scoped_release release;
    rasterizer.rasterize(points.data(), normals ? normals->data() : nullptr, points.shape(0), spec, out,
                         reinterpret_cast<void*>(stream));
}

}  // namespace

void bind_cuda(nb::module_& m) {
    nb::class_<sf::CudaRasterizer>(m, "CudaRasterizer")
        .def(nb::init<int>(), nb::arg("device"))
        .def("rasterize", &rasterize, nb::arg("points"), nb::arg("T_camera_map"), nb::arg("fx"), nb::arg("fy"),
             nb::arg("cx"), nb::arg("cy"), nb::arg("width"), nb::arg("height"), nb::arg("radius"), nb::arg("near"),
             nb::arg("max_half"), nb::arg("k_ray"), nb::arg("layer_gap"), nb::arg("sigma"), nb::arg("normals").none(),
             nb::arg("depth"), nb::arg("position").none(), nb::arg("index").none(), nb::arg("weight").none(),
             nb::arg("normal").none(), nb::arg("stream"));
}
#endif

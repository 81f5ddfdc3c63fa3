// SPDX-License-Identifier: Apache-2.0
// The CUDA siblings in Python: DLPack arrays on one device in, results into arrays that the caller has allocated there.
#ifdef SF_CUDA
#include <nanobind/stl/optional.h>
#include <sf_native/arrays.hpp>

#include "grid_cuda.hpp"
#include "ipr_cuda.hpp"

namespace nb = nanobind;

namespace {

using sf::alone, sf::require;
using Matrix4 = sf::In<float, 4, 4>;
using Points = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cuda>;
template <class T>
using Found = nb::ndarray<T, nb::shape<-1, -1>, nb::c_contig, nb::device::cuda>;
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
    alone([&] {
        rasterizer.rasterize(points.data(), normals ? normals->data() : nullptr, points.shape(0), spec, out,
                             reinterpret_cast<void*>(stream));
    });
}

void build(sf::CudaGrid& grid, Points points, uintptr_t stream) {
    require(points.device_id() == grid.device(), "the points lie on another device");
    require(points.shape(0) <= 2000000000, "at most 2e9 points");
    alone([&] { grid.build(points.data(), points.shape(0), reinterpret_cast<void*>(stream)); });
}

void knn(const sf::CudaGrid& grid, Points queries, float radius, Found<int32_t> ids, Found<float> distance2,
         uintptr_t stream) {
    const size_t n = queries.shape(0), k = ids.shape(1);
    require(k >= 1 && k <= sf::kMaxDeviceNeighbours && radius > 0, "knn needs 1 <= k <= 16 and a radius > 0");
    require(ids.shape(0) == n && distance2.shape(0) == n && distance2.shape(1) == k, "one row for each query");
    require(queries.device_id() == grid.device() && ids.device_id() == grid.device() &&
                distance2.device_id() == grid.device(),
            "queries and outputs lie on another device");
    alone([&] {
        grid.knn(queries.data(), n, static_cast<int>(k), radius, ids.data(), distance2.data(),
                 reinterpret_cast<void*>(stream));
    });
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
    nb::class_<sf::CudaGrid>(m, "CudaGrid")
        .def(nb::init<int, float>(), nb::arg("device"), nb::arg("cell_size"))
        .def("__len__", &sf::CudaGrid::size)
        .def("build", &build, nb::arg("points"), nb::arg("stream"))
        .def("knn", &knn, nb::arg("queries"), nb::arg("radius"), nb::arg("ids"), nb::arg("distance2"),
             nb::arg("stream"));
}
#endif

// SPDX-License-Identifier: Apache-2.0
// Python module sf_recon._native: arrays in, arrays out. Bad shapes are a TypeError, bad coordinates an IndexError.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <omp.h>

#include <algorithm>
#include <memory>
#include <vector>

#include "cell_map.hpp"
#include "ipr_cpu.hpp"
#include "point_grid.hpp"

namespace nb = nanobind;

namespace {

using Points = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<nb::numpy, T>;

template <class T>
Out<T> give(std::unique_ptr<T[]> data, std::initializer_list<size_t> shape) {
    T* raw = data.release();
    nb::capsule owner(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return Out<T>(raw, shape, owner);
}

template <class T>
Out<T> give(const std::vector<T>& values, size_t columns = 0) {
    std::unique_ptr<T[]> data(new T[values.size()]);
    std::copy(values.begin(), values.end(), data.get());
    if (columns == 0) return give(std::move(data), {values.size()});
    return give(std::move(data), {values.size() / columns, columns});
}

nb::tuple knn(const sf::PointGrid& grid, Points queries, int k, float radius, int threads) {
    if (k < 1 || !(radius > 0)) throw nb::value_error("knn needs k >= 1 and radius > 0");
    const size_t n = queries.shape(0);
    std::unique_ptr<int32_t[]> ids(new int32_t[n * k]);
    std::unique_ptr<float[]> distance2(new float[n * k]);
    bool outside = false;
    {  // the interpreter lock stays held: another thread must not add points meanwhile
        const int team = threads > 0 ? threads : omp_get_max_threads();
#pragma omp parallel for schedule(dynamic, 256) num_threads(team) reduction(|| : outside)
        for (size_t i = 0; i < n; ++i) {
            try {
                grid.query(queries.data() + 3 * i, k, radius, ids.get() + i * k, distance2.get() + i * k);
            } catch (const std::out_of_range&) {  // an exception must not leave a parallel region
                outside = true;
            }
        }
    }
    if (outside) throw nb::index_error("a query is not finite or lies too far from the origin");
    return nb::make_tuple(give(std::move(ids), {n, static_cast<size_t>(k)}),
                          give(std::move(distance2), {n, static_cast<size_t>(k)}));
}

nb::tuple add_spaced(sf::PointGrid& grid, Points points, float spacing, float copy_radius) {
    std::vector<int32_t> rows, parents;
    grid.add_spaced(points.data(), points.shape(0), spacing, copy_radius, rows, parents);
    return nb::make_tuple(give(rows), give(parents));
}

// Mean of the rows that fall in each cell of the grid (columns 0-2 are the position), in order of first appearance.
Out<float> voxel_means(Rows rows, float cell_size) {
    const size_t n = rows.shape(0), columns = rows.shape(1);
    if (columns < 3) throw nb::value_error("voxel_means needs at least three columns");
    sf::CellMap cells;
    std::vector<double> sums;
    std::vector<double> counts;
    for (size_t i = 0; i < n; ++i) {
        const float* row = rows.data() + i * columns;
        const size_t cell = cells.insert(sf::cell_of(row, 1.0f / cell_size));
        if (cell == counts.size()) {
            counts.push_back(0.0);
            sums.resize(sums.size() + columns);
        }
        counts[cell] += 1.0;
        for (size_t c = 0; c < columns; ++c) sums[cell * columns + c] += row[c];
    }
    std::vector<float> means(sums.size());
    for (size_t i = 0; i < sums.size(); ++i) means[i] = static_cast<float>(sums[i] / counts[i / columns]);
    return give(means, columns);
}

// Transpose of the interpolation: sums[ids[i, j]] += weights[i, j] * gradient[i], in order. Returns the rows that were
// touched, in order of first touch; `marks` (all 0 between calls) tells which.
Out<int64_t> accumulate_rows(nb::ndarray<const int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu> ids, Rows weights,
                             Rows gradient, nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu> sums,
                             nb::ndarray<uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu> marks) {
    const size_t n = ids.shape(0), k = ids.shape(1), columns = gradient.shape(1), rows = sums.shape(0);
    if (weights.shape(0) != n || weights.shape(1) != k || gradient.shape(0) != n || sums.shape(1) != columns ||
        marks.shape(0) != rows)
        throw nb::value_error("accumulate_rows: shapes do not agree");
    std::vector<int64_t> touched;
    for (size_t i = 0; i < n * k; ++i) {
        const float weight = weights.data()[i];
        if (weight == 0.0f) continue;  // no neighbour there
        const size_t row = static_cast<size_t>(ids.data()[i]);
        if (row >= rows) throw nb::index_error("accumulate_rows: id out of range");
        if (!marks.data()[row]) touched.push_back(static_cast<int64_t>(row));
        marks.data()[row] = 1;
        float* sum = sums.data() + row * columns;
        const float* g = gradient.data() + i / k * columns;
        for (size_t c = 0; c < columns; ++c) sum[c] += weight * g[c];
    }
    for (const int64_t row : touched) marks.data()[row] = 0;
    return give(touched);
}

nb::tuple rasterize(Points points, nb::ndarray<const float, nb::shape<4, 4>, nb::c_contig> T_camera_map, float fx,
                    float fy, float cx, float cy, int width, int height, float radius, float near, float max_half,
                    int k_ray, float layer_gap, float sigma, int threads) {
    if (width < 1 || height < 1 || k_ray < 1 || !(near > 0) || !(sigma > 0) || !(max_half >= 0.5f))
        throw nb::value_error("rasterize needs a non-empty image, k_ray >= 1, near > 0, sigma > 0, max_half >= 0.5");
    sf::RasterSpec spec{{}, {}, fx, fy, cx, cy, width, height, radius, near, max_half, k_ray, layer_gap, sigma, threads};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) spec.rotation[3 * i + j] = T_camera_map(i, j);
        spec.translation[i] = T_camera_map(i, 3);
    }
    const size_t w = width, h = height;
    std::unique_ptr<float[]> depth(new float[w * h]), position(new float[w * h * 3]);
    {
        nb::gil_scoped_release release;
        sf::rasterize(points.data(), points.shape(0), spec, depth.get(), position.get());
    }
    return nb::make_tuple(give(std::move(depth), {h, w}), give(std::move(position), {h, w, 3}));
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Compiled kernels of the reconstruction block.";
    nb::class_<sf::PointGrid>(m, "PointGrid")
        .def(nb::init<float>(), nb::arg("cell_size"))
        .def("__len__", &sf::PointGrid::size)
        .def("add_spaced", &add_spaced, nb::arg("points"), nb::arg("spacing"), nb::arg("copy_radius"))
        .def(
            "add",
            [](sf::PointGrid& grid, Points points) {
                for (size_t i = 0; i < points.shape(0); ++i) grid.add(points.data() + 3 * i);
            },
            nb::arg("points"))
        .def("knn", &knn, nb::arg("queries"), nb::arg("k"), nb::arg("radius"), nb::arg("threads") = 0);
    m.def("voxel_means", &voxel_means, nb::arg("rows"), nb::arg("cell_size"));
    m.def("accumulate_rows", &accumulate_rows, nb::arg("ids"), nb::arg("weights"), nb::arg("gradient"),
          nb::arg("sums").noconvert(), nb::arg("marks").noconvert());
    m.def("rasterize", &rasterize, nb::arg("points"), nb::arg("T_camera_map"), nb::arg("fx"), nb::arg("fy"),
          nb::arg("cx"), nb::arg("cy"), nb::arg("width"), nb::arg("height"), nb::arg("radius"), nb::arg("near"),
          nb::arg("max_half"), nb::arg("k_ray"), nb::arg("layer_gap"), nb::arg("sigma"), nb::arg("threads") = 0);
}

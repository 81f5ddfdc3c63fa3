// SPDX-License-Identifier: Apache-2.0
// Python module sf_recon._native: arrays in, arrays out. Bad shapes are a TypeError, bad coordinates an IndexError.
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <sf_native/arrays.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <mutex>
#include <optional>
#include <shared_mutex>
#include <vector>

#include "color_decoder.hpp"
#include "ipr_cpu.hpp"
#include "point_grid.hpp"
#include "rows.hpp"
#include "view_blend.hpp"

namespace nb = nanobind;

#ifdef SF_CUDA
void bind_cuda(nb::module_& m);
#endif

namespace {

using sf::alone, sf::In, sf::InOut, sf::Made, sf::Out, sf::require;

using Points = In<float, -1, 3>;
using Rows = In<float, -1, -1>;
using Ids = In<int32_t, -1, -1>;
using Values = In<float, -1>;
using Vector = In<float, 3>;
using Matrix4 = In<float, 4, 4>;
using Image = In<float, -1, -1, 3>;
using Halves = InOut<uint16_t, -1, -1>;

template <class T>
Out<T> copied(const std::vector<T>& values, std::vector<size_t> shape) {
    Made<T> made(std::move(shape));
    std::copy(values.begin(), values.end(), made.get());
    return made.give();
}

nb::tuple knn(const sf::PointGrid& grid, Points queries, int k, float radius, int threads) {
    if (k < 1 || k > sf::kMaxNeighbours || !(radius > 0) || !std::isfinite(radius))
        throw nb::value_error("knn needs 1 <= k <= 64 and a finite radius > 0");
    const size_t n = queries.shape(0);
    Made<int32_t> ids({n, static_cast<size_t>(k)});
    Made<float> distance2({n, static_cast<size_t>(k)});
    const bool inside = alone([&] {
        std::shared_lock<std::shared_mutex> reading(grid.mutex());
        return grid.knn(queries.data(), n, k, radius, ids.get(), distance2.get(), threads);
    });
    if (!inside) throw nb::index_error("a query is not finite or lies too far from the origin");
    return nb::make_tuple(ids.give(), distance2.give());
}

void add(sf::PointGrid& grid, Points points) {
    alone([&] {
        std::unique_lock<std::shared_mutex> writing(grid.mutex());
        for (size_t i = 0; i < points.shape(0); ++i) grid.add(points.data() + 3 * i);
    });
}

nb::tuple add_spaced(sf::PointGrid& grid, Points points, float spacing, float copy_radius) {
    std::vector<int32_t> rows, parents;
    alone([&] {
        std::unique_lock<std::shared_mutex> writing(grid.mutex());
        grid.add_spaced(points.data(), points.shape(0), spacing, copy_radius, rows, parents);
    });
    return nb::make_tuple(copied(rows, {rows.size()}), copied(parents, {parents.size()}));
}

Out<float> voxel_means(Rows rows, float cell_size) {
    require(rows.shape(1) >= 3, "voxel_means needs at least three columns");
    const std::vector<float> means = sf::voxel_means(rows.data(), rows.shape(0), rows.shape(1), cell_size);
    return copied(means, {means.size() / rows.shape(1), rows.shape(1)});
}

Out<float> interpolate(Rows table, Ids ids, Rows weights, int threads) {
    const size_t n = ids.shape(0), columns = table.shape(1);
    if (weights.shape(0) != n || weights.shape(1) != ids.shape(1))
        throw nb::value_error("interpolate: ids and weights differ in shape");
    Made<float> out({n, columns});
    const bool good = alone([&] {
        return sf::interpolate(table.data(), table.shape(0), columns, ids.data(), weights.data(), n, ids.shape(1),
                               out.get(), threads);
    });
    if (!good) throw nb::index_error("interpolate: id out of range");
    return out.give();
}

void adam_rows(Ids ids, Rows weights, Rows gradient, InOut<float, -1, -1> table, Halves mean, Halves root, InOut<int16_t, -1> steps,
               float rate, float beta1, float beta2, float epsilon, int threads) {
    const size_t n = ids.shape(0), k = ids.shape(1), rows = table.shape(0), columns = table.shape(1);
    if (weights.shape(0) != n || weights.shape(1) != k || gradient.shape(0) != n || gradient.shape(1) != columns)
        throw nb::value_error("adam_rows: ids, weights and gradient do not fit");
    for (const Halves& moment : {mean, root})
        if (moment.shape(0) != rows || moment.shape(1) != columns)
            throw nb::value_error("adam_rows: table and moments differ in shape");
    if (steps.shape(0) != rows) throw nb::value_error("adam_rows: steps and table differ in length");
    const sf::AdamTable all{table.data(), mean.data(), root.data(), steps.data(), rows, columns};
    if (!sf::adam_rows(ids.data(), weights.data(), n, k, gradient.data(), all, {rate, beta1, beta2, epsilon}, threads))
        throw nb::index_error("adam_rows: id out of range");
}

void blend_view(Rows z, In<uint8_t, -1, -1> surface, In<uint8_t, -1, -1, 3> image, In<uint16_t, -1, -1> depth,
                float step, In<float, 3, 3> A, Vector b, float trust, float weight, const std::array<float, 4>& rules,
                InOut<float, -1, -1, 3> color, InOut<float, -1, -1> total, InOut<float, -1, -1> confidence,
                int threads) {
    const size_t height = z.shape(0), width = z.shape(1);
    const auto fits = [&](const auto& other) { return other.shape(0) == height && other.shape(1) == width; };
    if (!fits(surface) || !fits(color) || !fits(total) || !fits(confidence))
        throw nb::value_error("blend_view: images of the drawn view differ in size");
    if (image.shape(0) != depth.shape(0) || image.shape(1) != depth.shape(1) || image.size() == 0)
        throw nb::value_error("blend_view: image and depth of the keyframe differ in size or are empty");
    sf::SourceView view{image.data(), depth.data(), step, static_cast<int>(image.shape(1)),
                        static_cast<int>(image.shape(0)), {}, {}, trust, weight};
    std::copy(A.data(), A.data() + 9, view.A);
    std::copy(b.data(), b.data() + 3, view.b);
    alone([&] {
        sf::blend_view(z.data(), surface.data(), static_cast<int>(width), static_cast<int>(height), view,
                       {rules[0], rules[1], rules[2], rules[3]}, color.data(), total.data(), confidence.data(),
                       threads);
    });
}

// A network of Python arrays, checked and kept alive.
struct Network {
    sf::ColorNetwork net{};
    std::vector<Rows> tables;
    std::vector<Values> biases;
    size_t width = 0;  // of the network's input

    Network(nb::list levels, nb::list layers, int neighbours, std::optional<Rows> base, int degree) {
        if (neighbours < 1 || neighbours > 16) throw nb::value_error("decoding needs 1 to 16 neighbours");
        if (degree < 0 || degree > 2) throw nb::value_error("the degree of the viewing direction is 0, 1 or 2");
        if (levels.size() == 0 || layers.size() == 0) throw nb::value_error("decoding needs levels and layers");
        net.neighbours = neighbours, net.degree = degree, width = sf::direction_columns(degree);
        for (nb::handle item : levels) add_level(nb::cast<nb::tuple>(item));
        for (nb::handle item : layers) add_layer(nb::cast<nb::tuple>(item));
        if (!base) return;
        if (base->shape(1) != 3) throw nb::value_error("base colours have three columns");
        net.base = tables.emplace_back(*base).data(), net.base_rows = base->shape(0);
    }

    void add_level(const nb::tuple& level) {
        if (level.size() != 4) throw nb::value_error("a level is (grid, features, radius, sigma)");
        const Rows& features = tables.emplace_back(nb::cast<Rows>(level[1]));
        const float radius = nb::cast<float>(level[2]), sigma = nb::cast<float>(level[3]);
        if (!(radius > 0) || !std::isfinite(radius) || !(sigma > 0))
            throw nb::value_error("a level needs a finite radius > 0 and sigma > 0");
        net.levels.push_back({nb::cast<const sf::PointGrid*>(level[0]), features.data(), features.shape(0),
                              features.shape(1), radius, 1 / sigma});
        width += features.shape(1);
    }

    void add_layer(const nb::tuple& layer) {
        if (layer.size() != 2) throw nb::value_error("a layer is (weight, bias)");
        const Rows& weight = tables.emplace_back(nb::cast<Rows>(layer[0]));
        const Values& bias = biases.emplace_back(nb::cast<Values>(layer[1]));
        if (bias.shape(0) != weight.shape(0)) throw nb::value_error("a layer's weight and bias differ in length");
        net.layers.push_back({weight.data(), bias.data(), weight.shape(1), weight.shape(0)});
    }

    void add_extra(const Rows& extra, size_t queries) {
        if (extra.shape(0) != queries) throw nb::value_error("extra inputs: one row for each query");
        net.extra = tables.emplace_back(extra).data(), net.extra_columns = extra.shape(1);
        width += extra.shape(1);
    }

    // Runs decode(net) -> good without the interpreter lock while nobody may add points.
    template <class Decode>
    void run(const Decode& decode) {
        size_t inputs = width;
        for (const sf::Layer& layer : net.layers) {
            if (layer.inputs != inputs) throw nb::value_error("the layers do not fit the features or one another");
            inputs = layer.outputs;
        }
        if (inputs != 3) throw nb::value_error("the last layer must have three outputs");
        const bool good = alone([&] {
            std::vector<std::shared_lock<std::shared_mutex>> reading;
            for (const sf::FieldLevel& level : net.levels) reading.emplace_back(level.grid->mutex());
            return decode(net);
        });
        if (!good) throw nb::index_error("a query is not finite or lies too far from the origin");
    }
};

Out<float> decode_colors(Points queries, nb::list levels, nb::list layers, int neighbours, std::optional<Vector> eye,
                         int degree, std::optional<Rows> base, std::optional<Rows> extra, int threads) {
    if (degree > 0 && !eye) throw nb::value_error("a viewing direction needs the eye");
    Network network(levels, layers, neighbours, base, degree);
    const size_t n = queries.shape(0);
    if (extra) network.add_extra(*extra, n);
    Made<float> colors({n, 3});
    network.run([&](const sf::ColorNetwork& net) {
        return sf::decode_colors(net, queries.data(), n, eye ? eye->data() : nullptr, colors.get(), threads);
    });
    return colors.give();
}

Out<float> decode_image(Image positions, Matrix4 T_map_camera, nb::list levels, nb::list layers, int neighbours,
                        int degree, std::optional<Rows> base, int threads) {
    Network network(levels, layers, neighbours, base, degree);
    const size_t h = positions.shape(0), w = positions.shape(1);
    Made<float> colors({h, w, 3});
    network.run([&](const sf::ColorNetwork& net) {
        return sf::decode_image(net, positions.data(), h, w, T_map_camera.data(), colors.get(), threads);
    });
    return colors.give();
}

nb::tuple rasterize(Points points, Matrix4 T_camera_map, float fx, float fy, float cx, float cy, int width, int height,
                    float radius, float near, float max_half, int k_ray, float layer_gap, float sigma,
                    std::optional<Points> normals, bool position, bool index, bool weight, bool normal, int threads) {
    if (width < 1 || height < 1 || k_ray < 1 || !(near > 0) || !(sigma > 0) || !(max_half >= 0.5f))
        throw nb::value_error("rasterize needs a non-empty image, k_ray >= 1, near > 0, sigma > 0, max_half >= 0.5");
    if (width > 32768 || height > 32768 || k_ray > 1024 || max_half > 32768 || points.shape(0) > 2000000000)
        throw nb::value_error("rasterize: at most 32768 pixels a side, k_ray 1024, 2e9 points");
    if (normals && normals->shape(0) != points.shape(0)) throw nb::value_error("one normal for each point");
    sf::RasterSpec spec{{}, {}, fx, fy, cx, cy, width, height, radius, near, max_half, k_ray, layer_gap, sigma, threads};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) spec.rotation[3 * i + j] = T_camera_map(i, j);
        spec.translation[i] = T_camera_map(i, 3);
    }
    const size_t w = width, h = height, k = k_ray;
    Made<float> z({h, w}), xyz({h, w, 3}, position), weights({h, w, k}, weight), n({h, w, 3}, normal);
    Made<int32_t> ids({h, w, k}, index);
    alone([&] {
        sf::rasterize(points.data(), normals ? normals->data() : nullptr, points.shape(0), spec,
                      {z.get(), xyz.get(), ids.get(), weights.get(), n.get()});
    });
    return nb::make_tuple(z.give(), xyz.give_if_wanted(), ids.give_if_wanted(), weights.give_if_wanted(),
                          n.give_if_wanted());
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Compiled kernels of the reconstruction block.";
    nb::class_<sf::PointGrid>(m, "PointGrid")
        .def(nb::init<float>(), nb::arg("cell_size"))
        .def("__len__", &sf::PointGrid::size)
        .def_prop_ro("nbytes", &sf::PointGrid::nbytes)
        .def("add_spaced", &add_spaced, nb::arg("points"), nb::arg("spacing"), nb::arg("copy_radius"))
        .def("add", &add, nb::arg("points"))
        .def("knn", &knn, nb::arg("queries"), nb::arg("k"), nb::arg("radius"), nb::arg("threads") = 0);
    m.def("voxel_means", &voxel_means, nb::arg("rows"), nb::arg("cell_size"));
    m.def("interpolate", &interpolate, nb::arg("table"), nb::arg("ids"), nb::arg("weights"), nb::arg("threads") = 0);
    m.def("adam_rows", &adam_rows, nb::arg("ids"), nb::arg("weights"), nb::arg("gradient"),
          nb::arg("table").noconvert(), nb::arg("mean").noconvert(), nb::arg("root").noconvert(),
          nb::arg("steps").noconvert(), nb::arg("rate"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"),
          nb::arg("threads") = 0);
    m.def("blend_view", &blend_view, nb::arg("z"), nb::arg("surface"), nb::arg("image"), nb::arg("depth"),
          nb::arg("step"), nb::arg("A"), nb::arg("b"), nb::arg("trust"), nb::arg("weight"), nb::arg("rules"),
          nb::arg("color").noconvert(), nb::arg("total").noconvert(), nb::arg("confidence").noconvert(),
          nb::arg("threads") = 0);
    m.def("decode_colors", &decode_colors, nb::arg("queries"), nb::arg("levels"), nb::arg("layers"),
          nb::arg("neighbours"), nb::arg("eye") = nb::none(), nb::arg("degree") = 0, nb::arg("base") = nb::none(),
          nb::arg("extra") = nb::none(), nb::arg("threads") = 0);
    m.def("decode_image", &decode_image, nb::arg("positions"), nb::arg("T_map_camera"), nb::arg("levels"),
          nb::arg("layers"), nb::arg("neighbours"), nb::arg("degree") = 0, nb::arg("base") = nb::none(),
          nb::arg("threads") = 0);
    m.def("rasterize", &rasterize, nb::arg("points"), nb::arg("T_camera_map"), nb::arg("fx"), nb::arg("fy"),
          nb::arg("cx"), nb::arg("cy"), nb::arg("width"), nb::arg("height"), nb::arg("radius"), nb::arg("near"),
          nb::arg("max_half"), nb::arg("k_ray"), nb::arg("layer_gap"), nb::arg("sigma"),
          nb::arg("normals") = nb::none(), nb::arg("position") = true, nb::arg("index") = false,
          nb::arg("weight") = false, nb::arg("normal") = false, nb::arg("threads") = 0);
#ifdef SF_CUDA
    bind_cuda(m);
#endif
}

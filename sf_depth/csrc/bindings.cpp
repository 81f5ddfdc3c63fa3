// SPDX-License-Identifier: Apache-2.0
// Python module sf_depth._native: arrays in, arrays out. Bad shapes are a TypeError or a ValueError. The interpreter
// is let go of while a kernel runs, so that several threads may.
#include <sf_native/arrays.hpp>

#include <algorithm>

#include "dense_ba.hpp"
#include "diffusion.hpp"
#include "plane_sweep.hpp"

namespace nb = nanobind;

namespace {

using sf::alone, sf::In, sf::Made, sf::Out, sf::require;

sf::Views views_of(const In<double, 5>& theta, const In<double, -1, 4, 4>& T, const In<double, 2, -1>& x,
                   const In<double, -1>& d, const In<double, -1, 2, -1>& target, const In<double, -1, -1>& weight,
                   const In<double, -1, 3>& turn) {
    const size_t sources = T.shape(0), pixels = x.shape(1);
    require(d.shape(0) == pixels && target.shape(0) == sources && target.shape(2) == pixels &&
                weight.shape(0) == sources && weight.shape(1) == pixels && turn.shape(0) == sources,
            "x, d, T, target, weight and turn differ in pixels or sources");
    return {sources, pixels, theta.data(), T.data(), x.data(), d.data(), target.data(), weight.data(),
            turn.data()};
}

Out<float> squared_residuals(In<double, 5> theta, In<double, -1, 4, 4> T, In<double, 2, -1> x, In<double, -1> d,
                             In<double, -1, 2, -1> target, In<double, -1, -1> weight, In<double, -1, 3> turn) {
    const sf::Views views = views_of(theta, T, x, d, target, weight, turn);
    Made<float> squares({views.sources, views.pixels});
    alone([&] { sf::squared_residuals(views, squares.get()); });
    return squares.give();
}

nb::tuple robust_cost(In<float, -1, -1> squares, In<double, -1, -1> weight, double c2, double blind) {
    require(squares.shape(0) == weight.shape(0) && squares.shape(1) == weight.shape(1), "one weight per residual");
    double cost = 0, total = 0;
    alone([&] { sf::robust_cost(squares.data(), weight.data(), squares.size(), c2, blind, cost, total); });
    return nb::make_tuple(cost, total);
}

nb::tuple linearise(In<double, 5> theta, In<double, -1, 4, 4> T, In<double, 2, -1> x, In<double, -1> d,
                    In<double, -1, 2, -1> target, In<double, -1, -1> weight, In<double, -1, 3> turn,
                    In<float, 2, -1, -1> dx, In<double, 5, -1> columns, bool poses, bool turns, double c2,
                    bool scores) {
    const sf::Views views = views_of(theta, T, x, d, target, weight, turn);
    const sf::Free own{poses, turns};
    const size_t free_ones = columns.shape(1), N = views.pixels;
    require(free_ones <= 4 && dx.shape(1) == free_ones && (free_ones == 0 || dx.shape(2) == N),
            "dx does not fit the columns, at most 4, and x");
    const size_t P = own.columns() * views.sources + free_ones;
    Made<double> H({P, P}), g({P});
    Made<float> E({P, N}), C({N}), w({N}), each({scores ? P : 0, N});
    alone([&] {
        sf::linearise(views, {free_ones, dx.data(), columns.data()}, own, c2,
                      {H.get(), g.get(), E.get(), C.get(), w.get(), scores ? each.get() : nullptr});
    });
    return nb::make_tuple(H.give(), g.give(), E.give(), C.give(), w.give(), each.give());
}

nb::tuple eliminate(In<float, -1, -1> E, In<float, -1> C, In<float, -1> w, In<double, -1, -1> H, In<double, -1> g) {
    const size_t rows = E.shape(0), pixels = E.shape(1);
    require(C.shape(0) == pixels && w.shape(0) == pixels && H.shape(0) == rows && H.shape(1) == rows &&
                g.shape(0) == rows,
            "H, g, C and w do not fit E");
    Made<double> S({rows, rows}), b({rows});
    alone([&] { sf::eliminate(E.data(), C.data(), w.data(), H.data(), g.data(), rows, pixels, S.get(), b.get()); });
    return nb::make_tuple(S.give(), b.give());
}

Out<double> substitute(In<float, -1, -1> E, In<float, -1> C, In<float, -1> w, In<double, -1> dx) {
    const size_t rows = E.shape(0), pixels = E.shape(1);
    require(C.shape(0) == pixels && w.shape(0) == pixels && dx.shape(0) == rows, "C, w and dx do not fit E");
    Made<double> dd({pixels});
    alone([&] { sf::substitute(E.data(), C.data(), w.data(), dx.data(), rows, pixels, dd.get()); });
    return dd.give();
}

Out<float> dissimilarity(In<float, -1, -1> first, In<float, -1, -1> mean, In<float, -1, -1> scale,
                         In<float, -1, -1, -1> others, In<float, -1, 3, -1> rotated, In<float, -1, 3> t,
                         In<float, 5> theta, In<float, 2> zoom, float least_z, float noise, float unseen, float d) {
    const size_t h = first.shape(0), w = first.shape(1), count = others.shape(0);
    const auto fits = [&](const auto& a, size_t at) { return a.shape(at) == h && a.shape(at + 1) == w; };
    require(h > 1 && w > 1 && fits(mean, 0) && fits(scale, 0) && fits(others, 1), "the images differ in size");
    require(count > 0 && rotated.shape(0) == count && rotated.shape(2) == h * w && t.shape(0) == count,
            "one turned ray for each pixel of each source");
    sf::Compared c{count, h, w, first.data(), mean.data(), scale.data(), others.data(), rotated.data(), t.data(),
                   {}, {zoom(0), zoom(1)}, least_z, noise, unseen};
    std::copy_n(theta.data(), 5, c.theta);
    Made<float> cost({h, w});
    alone([&] { sf::dissimilarity(c, d, cost.get()); });
    return cost.give();
}

Out<float> best_paths(In<float, -1, -1, -1> cost, In<float, -1, -1> image, bool upright, float bend, float jump,
                      float edge) {
    const size_t h = cost.shape(0), w = cost.shape(1), planes = cost.shape(2);
    require(image.shape(0) == h && image.shape(1) == w && planes > 0, "the image does not fit the cost");
    Made<float> total({h, w, planes});
    alone([&] {
        sf::best_paths({h, w, planes, cost.data(), image.data()}, upright, {bend, jump, edge}, total.get());
    });
    return total.give();
}

Out<float> settle(In<float, -1, -1, 4> values, In<float, -1, -1, 4> inflow, In<float, -1, -1> right,
                 In<float, -1, -1> down, In<float, -1, -1> ground, size_t steps) {
    const size_t h = values.shape(0), w = values.shape(1);
    const auto fits = [&](const auto& a) { return a.shape(0) == h && a.shape(1) == w; };
    require(fits(inflow) && fits(right) && fits(down) && fits(ground), "the images differ in size");
    Made<float> settled({h, w, sf::kChannels});
    std::copy_n(values.data(), values.size(), settled.get());
    alone([&] {
        sf::settle({h, w, right.data(), down.data(), ground.data(), inflow.data()}, steps, settled.get());
    });
    return settled.give();
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Compiled kernels of the depth block; the *_reference.py files of its core define them.";
    m.def("squared_residuals", &squared_residuals, nb::arg("theta"), nb::arg("T"), nb::arg("x"), nb::arg("d"),
          nb::arg("target"), nb::arg("weight"), nb::arg("turn"));
    m.def("robust_cost", &robust_cost, nb::arg("squares"), nb::arg("weight"), nb::arg("c2"), nb::arg("blind"));
    m.def("linearise", &linearise, nb::arg("theta"), nb::arg("T"), nb::arg("x"), nb::arg("d"), nb::arg("target"),
          nb::arg("weight"), nb::arg("turn"), nb::arg("dx"), nb::arg("columns"), nb::arg("poses"),
          nb::arg("turns"), nb::arg("c2"), nb::arg("scores"));
    m.def("eliminate", &eliminate, nb::arg("E"), nb::arg("C"), nb::arg("w"), nb::arg("H"), nb::arg("g"));
    m.def("substitute", &substitute, nb::arg("E"), nb::arg("C"), nb::arg("w"), nb::arg("dx"));
    m.def("dissimilarity", &dissimilarity, nb::arg("first"), nb::arg("mean"), nb::arg("scale"), nb::arg("others"),
          nb::arg("rotated"), nb::arg("t"), nb::arg("theta"), nb::arg("zoom"), nb::arg("least_z"), nb::arg("noise"),
          nb::arg("unseen"), nb::arg("d"));
    m.def("best_paths", &best_paths, nb::arg("cost"), nb::arg("image"), nb::arg("upright"), nb::arg("bend"),
          nb::arg("jump"), nb::arg("edge"));
    m.def("settle", &settle, nb::arg("values"), nb::arg("inflow"), nb::arg("right"), nb::arg("down"), nb::arg("ground"),
          nb::arg("steps"));
}

// SPDX-License-Identifier: Apache-2.0
// Python module sf_tracking._native: arrays in, arrays out. Bad shapes are a TypeError or a ValueError.
#include <sf_native/arrays.hpp>

#include <algorithm>

#include "align.hpp"
#include "bundle.hpp"
#include "pose.hpp"
#include "reproject.hpp"
#include "surface.hpp"

namespace nb = nanobind;

namespace {

using sf::alone, sf::In, sf::Made, sf::Out, sf::require;

sf::Image image_of(const In<float, -1, -1>& grey) {
    require(grey.shape(0) > 0 && grey.shape(1) > 0 && grey.shape(0) < 32768 && grey.shape(1) < 32768,
            "the image must have 1 to 32767 pixels a side");
    return {grey.data(), static_cast<int>(grey.shape(1)), static_cast<int>(grey.shape(0))};
}

nb::tuple describe(In<float, -1, -1> grey, In<double, -1, 2> uv, int side) {
    require(side >= 1 && side <= sf::kMaxSide, "a patch has 1 to 41 pixels a side");
    const size_t count = uv.shape(0), pixels = static_cast<size_t>(side) * side;
    Made<float> J({count, 4, pixels});
    Made<double> inverse({count, 4, 4});
    sf::describe(image_of(grey), uv.data(), count, side, J.get(), inverse.get());
    return nb::make_tuple(J.give(), inverse.give());
}

nb::tuple align(In<float, -1, -1> grey, In<float, -1, 4, -1> J, In<double, -1, 4, 4> inverse, In<int64_t, -1> rows,
                In<double, -1, 2> start, In<double, -1, 2, 2> warp, int iterations) {
    int side = 0;
    while (static_cast<size_t>(side) * side < J.shape(2)) ++side;
    require(side >= 3 && side <= sf::kMaxSide && static_cast<size_t>(side) * side == J.shape(2),
            "templates must be square, 3 to 41 pixels a side");
    const size_t edges = rows.shape(0);
    require(J.shape(0) == inverse.shape(0) && edges == start.shape(0) && edges == warp.shape(0),
            "one normal matrix for each template; one start and one warp for each row");
    for (size_t e = 0; e < edges; ++e)
        require(rows(e) >= 0 && static_cast<size_t>(rows(e)) < J.shape(0), "a row is no template");
    Made<double> centre({edges, 2}), covariance({edges, 2, 2}), gain({edges}), residual({edges}), explained({edges});
    const sf::Image image = image_of(grey);
    alone([&] {
        sf::align(image, J.data(), inverse.data(), rows.data(), edges, side, iterations, start.data(), warp.data(),
                  {centre.get(), covariance.get(), gain.get(), residual.get(), explained.get()});
    });
    return nb::make_tuple(centre.give(), covariance.give(), gain.give(), residual.give(), explained.give());
}

nb::tuple judge(In<double, -1, 2> start, In<double, -1, 2> centre, In<double, -1, 2, 2> covariance,
                In<double, -1> gain, In<double, -1> residual, In<double, -1> explained, int width, int height,
                In<double, 7> limits) {
    const size_t edges = start.shape(0);
    require(centre.shape(0) == edges && covariance.shape(0) == edges && gain.shape(0) == edges &&
                residual.shape(0) == edges && explained.shape(0) == edges,
            "one alignment for each start");
    Made<double> information({edges, 2, 2});
    Made<bool> valid({edges});
    const sf::Aligned found = {centre.data(), covariance.data(), gain.data(), residual.data(), explained.data()};
    sf::judge(start.data(), found, edges, width, height,
              {limits(0), limits(1), limits(2), limits(3), limits(4), limits(5), limits(6)}, information.get(),
              valid.get());
    return nb::make_tuple(information.give(), valid.give());
}

sf::Camera camera_of(const In<double, 4>& k) { return {k(0), k(1), k(2), k(3)}; }

nb::tuple reproject(In<double, 4> camera, In<double, 4, 4> T, In<double, -1, 2> uv, In<double, -1> w,
                    In<double, -1, 2> slope, double width, double height, double least, double most) {
    const size_t count = uv.shape(0);
    require(w.shape(0) == count && slope.shape(0) == count, "uv, w and slope differ in length");
    Made<double> there({count, 2}), warp({count, 2, 2}), J_w({count, 2}), w_there({count});
    Made<bool> visible({count});
    sf::reproject(camera_of(camera), T.data(), {uv.data(), w.data(), slope.data(), count}, width, height, least, most,
                  {there.get(), warp.get(), J_w.get(), w_there.get(), visible.get()});
    return nb::make_tuple(there.give(), warp.give(), J_w.give(), w_there.give(), visible.give());
}

nb::tuple solve_pose(In<double, 4> camera, In<double, 4, 4> T_cw, In<double, -1, 3> X, In<double, -1> w,
                     In<double, -1, 2> uv, In<double, -1, 3> root, In<double, -1> scales, In<double, 6> prior,
                     int steps) {
    const size_t count = X.shape(0);
    require(w.shape(0) == count && uv.shape(0) == count && root.shape(0) == count, "X, w, uv and root differ in length");
    sf::PoseSolution solution{};
    std::copy_n(T_cw.data(), 12, solution.T);
    Made<double> error({count}), T({4, 4}), H({6, 6});
    sf::solve_pose(camera_of(camera), {X.data(), w.data(), uv.data(), root.data(), count}, scales.data(),
                   scales.shape(0), prior.data(), steps, solution, error.get());
    std::copy_n(solution.T, 12, T.get());
    std::copy_n(T_cw.data() + 12, 4, T.get() + 12);
    std::copy_n(solution.H, 36, H.get());
    return nb::make_tuple(T.give(), error.give(), H.give(), solution.excess, solution.support);
}

nb::tuple thin(In<float, -1, -1> z, int step) {
    require(step >= 1 && z.shape(0) < 32768 && z.shape(1) < 32768, "step must be at least 1, the image below 32768");
    const size_t rows = z.shape(0) / step, cols = z.shape(1) / step;
    Made<int32_t> known({rows, cols});
    Made<double> centre({rows, cols}), rough({rows, cols});
    alone([&] {
        sf::thin(z.data(), static_cast<int>(z.shape(0)), static_cast<int>(z.shape(1)), step, known.get(), centre.get(),
                 rough.get());
    });
    return nb::make_tuple(known.give(), centre.give(), rough.give());
}

Out<int64_t> partners(In<double, 4> camera, In<double, 4, 4> T, In<double, -1, 3> points, In<int64_t, -1, -1> grid,
                      double to_col, double to_row) {
    Made<int64_t> partner({points.shape(0)});
    sf::partners(T.data(), points.data(), points.shape(0),
                 {grid.data(), static_cast<int>(grid.shape(0)), static_cast<int>(grid.shape(1)), to_col, to_row,
                  camera_of(camera)},
                 partner.get());
    return partner.give();
}

nb::tuple plane_system(In<double, 4, 4> T, In<double, -1, 3> source, In<double, -1> sigma, In<int64_t, -1> partner,
                       In<double, -1, 3> points, In<double, -1, 3> normals, double reach, double scale, double least,
                       double trust) {
    const size_t count = source.shape(0);
    require(sigma.shape(0) == count && partner.shape(0) == count, "one sigma and partner per point");
    require(points.shape(0) == normals.shape(0), "one normal for each point");
    sf::PlaneSystem system;
    alone([&] {
        sf::plane_system(T.data(), source.data(), sigma.data(), partner.data(), count,
                         {points.data(), normals.data(), points.shape(0)}, reach, scale, least, trust, system);
    });
    Made<double> H({6, 6}), g({6});
    std::copy_n(system.H, 36, H.get());
    std::copy_n(system.g, 6, g.get());
    return nb::make_tuple(H.give(), g.give(), system.used, system.met);
}

sf::Bundle bundle_of(const In<double, -1, -1, 4, 4>& T_ts, const In<double, -1, -1, 2>& rays,
                     const In<double, -1, -1>& w, const In<double, -1, -1>& prior,
                     const In<double, -1, -1>& prior_weight, const In<double, -1, -1, -1, 2>& uv,
                     const In<double, -1, -1, -1, 3>& root) {
    const size_t n = rays.shape(0), m = rays.shape(1);
    const auto fits = [&](const auto& a, size_t rows, size_t cols) { return a.shape(0) == rows && a.shape(1) == cols; };
    require(fits(T_ts, n, n) && fits(w, n, m) && fits(prior, n, m) && fits(prior_weight, n, m) && fits(uv, n, n) &&
                fits(root, n, n) && uv.shape(2) == m && root.shape(2) == m && n < 10000 && m < 1000000,
            "the arrays of a bundle differ in shape");
    return {static_cast<int>(n), static_cast<int>(m), T_ts.data(), rays.data(), w.data(),
            prior.data(), prior_weight.data(), uv.data(), root.data()};
}

double bundle_cost(In<double, 4> camera, double scale, In<double, -1, -1, 4, 4> T_ts, In<double, -1, -1, 2> rays,
                   In<double, -1, -1> w, In<double, -1, -1> prior, In<double, -1, -1> prior_weight,
                   In<double, -1, -1, -1, 2> uv, In<double, -1, -1, -1, 3> root) {
    return sf::bundle_cost(camera_of(camera), bundle_of(T_ts, rays, w, prior, prior_weight, uv, root), scale);
}

nb::tuple linearise(In<double, 4> camera, double scale, In<double, -1, -1, 6, 6> motion, In<double, -1, -1, 6> pull,
                    In<double, -1, -1, 4, 4> T_ts, In<double, -1, -1, 2> rays, In<double, -1, -1> w,
                    In<double, -1, -1> prior, In<double, -1, -1> prior_weight, In<double, -1, -1, -1, 2> uv,
                    In<double, -1, -1, -1, 3> root) {
    const sf::Bundle p = bundle_of(T_ts, rays, w, prior, prior_weight, uv, root);
    const size_t n = p.n, m = p.m;
    require(motion.shape(0) == n && motion.shape(1) == n && pull.shape(0) == n && pull.shape(1) == n,
            "one measured motion for each pair of keyframes");
    Made<double> H({6 * n, 6 * n}), b({6 * n}), C({n, m}), c({n, m}), E({6 * n, n * m});
    const sf::Camera pinhole = camera_of(camera);
    alone([&] {
        sf::linearise(pinhole, p, scale, motion.data(), pull.data(), {H.get(), b.get(), C.get(), c.get(), E.get()});
    });
    return nb::make_tuple(H.give(), b.give(), C.give(), c.give(), E.give());
}

nb::tuple eliminate(In<double, -1, -1> E, In<double, -1> C, In<double, -1> c, In<double, -1, -1> H,
                    In<double, -1> b) {
    const size_t rows = E.shape(0), columns = E.shape(1);
    require(C.shape(0) == columns && c.shape(0) == columns && H.shape(0) == rows && H.shape(1) == rows &&
                b.shape(0) == rows,
            "H, b, C and c do not fit E");
    Made<double> S({rows, rows}), reduced({rows});
    std::copy_n(H.data(), rows * rows, S.get());
    std::copy_n(b.data(), rows, reduced.get());
    alone([&] { sf::eliminate(E.data(), C.data(), c.data(), rows, columns, S.get(), reduced.get()); });
    return nb::make_tuple(S.give(), reduced.give());
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Compiled kernels of the tracking block; the *_reference.py files of its core define them.";
    m.def("describe", &describe, nb::arg("image"), nb::arg("uv"), nb::arg("side"));
    m.def("align", &align, nb::arg("image"), nb::arg("J"), nb::arg("inverse"), nb::arg("rows"), nb::arg("start"),
          nb::arg("warp"), nb::arg("iterations"));
    m.def("judge", &judge, nb::arg("start"), nb::arg("centre"), nb::arg("covariance"), nb::arg("gain"),
          nb::arg("residual"), nb::arg("explained"), nb::arg("width"), nb::arg("height"), nb::arg("limits"));
    m.def("reproject", &reproject, nb::arg("camera"), nb::arg("T"), nb::arg("uv"), nb::arg("w"), nb::arg("slope"),
          nb::arg("width"), nb::arg("height"), nb::arg("least"), nb::arg("most"));
    m.def("solve_pose", &solve_pose, nb::arg("camera"), nb::arg("T_cw"), nb::arg("X"), nb::arg("w"), nb::arg("uv"),
          nb::arg("root"), nb::arg("scales"), nb::arg("prior"), nb::arg("steps"));
    m.def("thin", &thin, nb::arg("z"), nb::arg("step"));
    m.def("partners", &partners, nb::arg("camera"), nb::arg("T"), nb::arg("points"), nb::arg("grid"),
          nb::arg("to_col"), nb::arg("to_row"));
    m.def("plane_system", &plane_system, nb::arg("T"), nb::arg("source"), nb::arg("sigma"), nb::arg("partner"),
          nb::arg("points"), nb::arg("normals"), nb::arg("reach"), nb::arg("scale"), nb::arg("least"),
          nb::arg("trust"));
    m.def("bundle_cost", &bundle_cost, nb::arg("camera"), nb::arg("scale"), nb::arg("T_ts"), nb::arg("rays"),
          nb::arg("w"), nb::arg("prior"), nb::arg("prior_weight"), nb::arg("uv"), nb::arg("root"));
    m.def("linearise", &linearise, nb::arg("camera"), nb::arg("scale"), nb::arg("motion"), nb::arg("pull"),
          nb::arg("T_ts"), nb::arg("rays"), nb::arg("w"), nb::arg("prior"), nb::arg("prior_weight"), nb::arg("uv"),
          nb::arg("root"));
    m.def("eliminate", &eliminate, nb::arg("E"), nb::arg("C"), nb::arg("c"), nb::arg("H"), nb::arg("b"));
}

// SPDX-License-Identifier: Apache-2.0
// Drives every kernel of the tracker with hostile input under the sanitizers; see tests/recon/test_sanitizers.py.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <memory>
#include <random>
#include <vector>

#include "align.hpp"
#include "bundle.hpp"
#include "pose.hpp"
#include "reproject.hpp"
#include "surface.hpp"

namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN(), kInf = std::numeric_limits<double>::infinity();
const double kHostile[] = {kNan, kInf, -kInf, 1e300, -1e300, 1e30, -1e9, 5e-324, 0.0, -0.0, 0.5, 7.25, 1e9};
const sf::Camera kCamera{50, 48, 30.5, 20.5};

void expect(bool good, const char* what) {
    if (good) return;
    std::fprintf(stderr, "failed: %s\n", what);
    std::exit(1);
}

// Random numbers, every `each`-th of which is hostile.
std::vector<double> numbers(size_t count, double low, double high, unsigned seed, size_t each) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> any(low, high);
    std::vector<double> out(count);
    for (size_t i = 0; i < count; ++i) out[i] = each && i % each == 0 ? kHostile[random() % 13] : any(random);
    return out;
}

void align_patches(int width, int height, int side, size_t each) {
    const std::vector<double> grey = numbers(static_cast<size_t>(width) * height, 0, 255, 1, each * 50);
    const std::vector<float> image(grey.begin(), grey.end());
    const size_t count = 60, pixels = static_cast<size_t>(side) * side;
    const std::vector<double> uv = numbers(2 * count, -20, 90, 2, each), warp = numbers(4 * count, -1.5, 1.5, 3, each);
    std::vector<float> J(4 * count * pixels);
    std::vector<double> inverse(16 * count), centre(2 * count), covariance(4 * count), gain(count), residual(count),
        explained(count);
    std::vector<int64_t> rows(count);
    for (size_t i = 0; i < count; ++i) rows[i] = static_cast<int64_t>((7 * i) % count);
    sf::describe({image.data(), width, height}, uv.data(), count, side, J.data(), inverse.data());
    sf::align({image.data(), width, height}, J.data(), inverse.data(), rows.data(), count, side, 5, uv.data(),
              warp.data(), {centre.data(), covariance.data(), gain.data(), residual.data(), explained.data()});
    for (size_t i = 0; i < count; ++i)
        expect(std::isfinite(centre[2 * i]) == std::isfinite(centre[2 * i + 1]), "a centre is found or not");
    std::unique_ptr<bool[]> valid(new bool[count]);
    std::vector<double> information(4 * count);
    sf::judge(uv.data(), {centre.data(), covariance.data(), gain.data(), residual.data(), explained.data()}, count, width,
              height, {1, 4, 0.5, 2, 40, 4, 0.05}, information.data(), valid.get());
    for (size_t i = 0; i < count; ++i)
        expect(!valid[i] || std::isfinite(centre[2 * i]), "what was not found is not believed");
}

void see_again(size_t count, size_t each) {
    const std::vector<double> T = numbers(16, -1, 1, 20, each), uv = numbers(2 * count, 0, 60, 21, each),
                              w = numbers(count, 0, 1, 22, each), slope = numbers(2 * count, -0.1, 0.1, 23, each);
    std::vector<double> there(2 * count), warp(4 * count), J_w(2 * count), w_there(count);
    std::unique_ptr<bool[]> visible(new bool[count]);
    sf::reproject(kCamera, T.data(), {uv.data(), w.data(), slope.data(), count}, 61, 41, 0.2, 5,
                  {there.data(), warp.data(), J_w.data(), w_there.data(), visible.get()});
    for (size_t i = 0; i < count; ++i)
        expect(!visible[i] || (there[2 * i] >= 0 && there[2 * i] < 61), "what is visible lies in the image");
}

void find_pose(size_t count, size_t each) {
    const std::vector<double> X = numbers(3 * count, -2, 4, 4, each), w = numbers(count, 0, 1, 5, each),
                              uv = numbers(2 * count, 0, 60, 6, each), root = numbers(3 * count, 0, 2, 7, each);
    const double scales[] = {9, 3}, prior[] = {1e2, 1e2, 1e2, 1e3, 1e3, 1e3};
    sf::PoseSolution solution{{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0}, {}, 0, 0};
    std::vector<double> error(count);
    sf::solve_pose(kCamera, {X.data(), w.data(), uv.data(), root.data(), count}, scales, 2, prior, 6, solution,
                   error.data());
    expect(solution.excess >= 1.0, "errors are never smaller than they claim");
}

void adjust_bundle(int n, int m, size_t each) {
    const size_t patches = static_cast<size_t>(n) * m, pairs = static_cast<size_t>(n) * n, poses = 6 * static_cast<size_t>(n);
    const std::vector<double> T = numbers(16 * pairs, -1, 1, 8, each), rays = numbers(2 * patches, -1, 1, 9, each),
                              w = numbers(patches, 0, 1, 10, each), weight = numbers(patches, 0, 5, 11, each),
                              uv = numbers(2 * pairs * m, 0, 60, 12, each), root = numbers(3 * pairs * m, 0, 2, 13, each),
                              motion = numbers(36 * pairs, 0, 1, 14, each), pull = numbers(6 * pairs, 0, 1, 15, each);
    const sf::Bundle p{n, m, T.data(), rays.data(), w.data(), w.data(), weight.data(), uv.data(), root.data()};
    std::vector<double> H(poses * poses), b(poses), C(patches), c(patches), E(poses * patches);
    sf::bundle_cost(kCamera, p, 3.0);
    sf::linearise(kCamera, p, 3.0, motion.data(), pull.data(), {H.data(), b.data(), C.data(), c.data(), E.data()});
    sf::eliminate(E.data(), C.data(), c.data(), poses, patches, H.data(), b.data());
}

void meet_planes(int step, size_t each) {
    const int height = 47, width = 61;
    const std::vector<double> depth = numbers(static_cast<size_t>(height) * width, 0.1, 5, 16, each);
    const std::vector<float> z(depth.begin(), depth.end());
    const size_t cells = static_cast<size_t>(height / step) * (width / step), count = 300;
    std::vector<int32_t> known(cells);
    std::vector<double> mean(cells), extent(cells);
    sf::thin(z.data(), height, width, step, known.data(), mean.data(), extent.data());
    const std::vector<double> moved = numbers(3 * count, -2, 4, 17, each), normals = numbers(3 * count, -1, 1, 18, each),
                              sigma = numbers(count, 0, 1, 19, each);
    std::vector<int64_t> grid(12 * 9), partner(count);
    for (size_t i = 0; i < grid.size(); ++i) grid[i] = static_cast<int64_t>(i * 3) - 1;  // some beyond the surface
    const double T[] = {1, 0, 0, 0.5, 0, 1, 0, -0.2, 0, 0, 1, 0.1, 0, 0, 0, 1};
    sf::partners(T, moved.data(), count, {grid.data(), 9, 12, 0.2, 0.2, kCamera}, partner.data());
    sf::PlaneSystem system;
    sf::plane_system(T, moved.data(), sigma.data(), partner.data(), count, {moved.data(), normals.data(), count}, 0.5, 2,
                     0.03, 1, system);
    expect(system.used >= 0 && system.used <= system.met, "no more points count than have a partner");
    expect(system.met <= static_cast<int64_t>(count), "no more points than there are");
}

}  // namespace

int main() {
    for (const size_t each : {0, 1, 3, 17}) {
        for (const int side : {3, 8, 11, 41})
            for (const int width : {1, 2, 61}) align_patches(width, width == 61 ? 47 : 3, side, each);
        for (const size_t count : {0, 1, 50}) find_pose(count, each), see_again(count, each);
        for (const int n : {1, 4}) adjust_bundle(n, 13, each);
        for (const int step : {1, 8, 100}) meet_planes(step, each);
    }
    std::puts("all kernels behave");
}

// SPDX-License-Identifier: Apache-2.0
// Drives every kernel of the depth block with hostile input under the sanitizers; see tests/recon/test_sanitizers.py.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <random>
#include <vector>

#include "dense_ba.hpp"
#include "diffusion.hpp"
#include "plane_sweep.hpp"

namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN(), kInf = std::numeric_limits<double>::infinity();
const double kHostile[] = {kNan, kInf, -kInf, 1e30, -1e30, -1e9, 5e-324, 0.0, -0.0, 0.5, 7.25, 1e9};

void expect(bool good, const char* what) {
    if (good) return;
    std::fprintf(stderr, "failed: %s\n", what);
    std::exit(1);
}

// Random numbers, every `each`-th of which is hostile.
template <class T>
std::vector<T> numbers(size_t count, double low, double high, unsigned seed, size_t each) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> any(low, high);
    std::vector<T> out(count);
    for (size_t i = 0; i < count; ++i) out[i] = static_cast<T>(each && i % each == 0 ? kHostile[random() % 12] : any(random));
    return out;
}

void adjust(size_t sources, size_t pixels, size_t free_count, sf::Free own, size_t each) {
    const double theta[] = {50, 48, 30, 20, 0.1};
    const auto T = numbers<double>(16 * sources, -1, 1, 1, each), x = numbers<double>(2 * pixels, -1, 1, 2, each),
               d = numbers<double>(pixels, 0.1, 2, 3, each), target = numbers<double>(2 * sources * pixels, 0, 60, 4, each),
               weight = numbers<double>(sources * pixels, 0, 1, 5, each),
               turn = numbers<double>(3 * sources, -0.1, 0.1, 8, each), columns = numbers<double>(5 * free_count, 0, 1, 6, 0);
    const auto dx = numbers<float>(2 * free_count * pixels, -1, 1, 7, each);
    const sf::Views views{sources, pixels, theta, T.data(), x.data(), d.data(), target.data(), weight.data(), turn.data()};
    const size_t rows = own.columns() * sources + free_count;
    std::vector<float> squares(sources * pixels), E(rows * pixels), C(pixels), w(pixels), scores(rows * pixels);
    std::vector<double> H(rows * rows), g(rows), S(rows * rows), b(rows), step(rows, 0.01), dd(pixels);
    sf::squared_residuals(views, squares.data());
    double cost = -1, total = -1;
    sf::robust_cost(squares.data(), weight.data(), squares.size(), 6.25, 1e4, cost, total);
    expect(each != 0 || (cost >= 0 && total >= 0), "costs are not negative");
    for (float* wanted : {scores.data(), static_cast<float*>(nullptr)}) {
        sf::linearise(views, {free_count, dx.data(), columns.data()}, own, 6.25,
                      {H.data(), g.data(), E.data(), C.data(), w.data(), wanted});
        for (size_t i = 0; each == 0 && i < rows; ++i) expect(H[i * rows + i] >= 0, "diagonals are not negative");
    }
    for (float& c : C) c += 1.0f;
    sf::eliminate(E.data(), C.data(), w.data(), H.data(), g.data(), rows, pixels, S.data(), b.data());
    sf::substitute(E.data(), C.data(), w.data(), step.data(), rows, pixels, dd.data());
}

void sweep(size_t sources, size_t rows, size_t columns, size_t planes, size_t each) {
    const size_t area = rows * columns;
    const auto first = numbers<float>(area, 0, 255, 11, 0), mean = numbers<float>(area, 0, 255, 12, 0),
               scale = numbers<float>(area, 0, 1, 13, 0), others = numbers<float>(sources * area, 0, 255, 14, 0),
               rotated = numbers<float>(3 * sources * area, -1, 2, 15, each), t = numbers<float>(3 * sources, -1, 1, 16, each);
    const sf::Compared compared{sources, rows, columns, first.data(), mean.data(), scale.data(), others.data(),
                                rotated.data(), t.data(), {50, 48, 30, 20, 0.1f}, {4, 4}, 0.05f, 4, 1};
    std::vector<float> out(area);
    for (const float d : {0.0f, 0.5f, 100.0f}) sf::dissimilarity(compared, d, out.data());
    const auto cost = numbers<float>(area * planes, 0, 2, 17, each);
    std::vector<float> total(area * planes);
    for (const bool upright : {false, true})
        sf::best_paths({rows, columns, planes, cost.data(), first.data()}, upright, {0.1f, 1, 8}, total.data());
}

void diffuse(size_t rows, size_t columns, size_t each) {
    const size_t area = rows * columns;
    const auto right = numbers<float>(area, 0, 1, 21, each), down = numbers<float>(area, 0, 1, 22, each),
               ground = numbers<float>(area, 0, 1, 23, each),
               inflow = numbers<float>(sf::kChannels * area, -1, 1, 24, each);
    auto values = numbers<float>(sf::kChannels * area, -1, 1, 25, 0);
    sf::settle({rows, columns, right.data(), down.data(), ground.data(), inflow.data()}, 20, values.data());
    for (size_t i = 0; each == 0 && i < values.size(); ++i) expect(std::isfinite(values[i]), "values are finite");
}

}  // namespace

int main() {
    for (const size_t each : {0, 1, 3, 17}) {
        for (const size_t pixels : {1, 8, 13, 1030})
            for (const sf::Free own : {sf::Free{false, false}, sf::Free{true, false}, sf::Free{true, true}})
                for (const size_t free_count : {0, 1, 4}) adjust(3, pixels, free_count, own, each);
        for (const size_t rows : {2, 5})
            for (const size_t columns : {2, 8, 19}) sweep(2, rows, columns, 9, each), sweep(1, rows, columns, 1, each);
        for (const size_t rows : {1, 2, 7})
            for (const size_t columns : {1, 3, 20}) diffuse(rows, columns, each);
    }
    std::puts("all kernels behave");
}

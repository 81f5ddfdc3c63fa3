// SPDX-License-Identifier: Apache-2.0
// Drives every kernel with hostile input. Built with sanitizers by test_sanitizers.py: what it must not do is read or
// write out of bounds, overflow, or convert a float that fits no int. It also checks a few results.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <random>
#include <stdexcept>
#include <vector>

#include "color_decoder.hpp"
#include "ipr_cpu.hpp"
#include "point_grid.hpp"
#include "rows.hpp"
#include "view_blend.hpp"

namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN(), kInf = std::numeric_limits<float>::infinity();
constexpr float kMax = std::numeric_limits<float>::max(), kTiny = std::numeric_limits<float>::denorm_min();

void expect(bool good, const char* what) {
    if (good) return;
    std::fprintf(stderr, "failed: %s\n", what);
    std::exit(1);
}

std::vector<float> cloud(size_t n, float low_z, float high_z, unsigned seed) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<float> side(-1.0f, 1.0f), depth(low_z, high_z);
    std::vector<float> points;
    for (size_t i = 0; i < n; ++i) points.insert(points.end(), {side(random), side(random), depth(random)});
    return points;
}

std::vector<std::vector<float>> clouds() {
    std::vector<std::vector<float>> all{{},
                                        {0.1f, 0.2f, 1.5f},
                                        cloud(5000, 0.5f, 4.0f, 1),
                                        cloud(5000, -2.0f, 0.3f, 2),
                                        cloud(3000, 1.0f, 1.0f, 3),
                                        cloud(20000, 0.05f, 0.06f, 4)};
    std::vector<float> hostile;
    const float values[] = {kNan, kInf, -kInf, kMax, -kMax, kTiny, 0.0f, -0.0f, 1.0f, 1e20f, -1e9f};
    for (float x : values)
        for (float y : values)
            for (float z : values) hostile.insert(hostile.end(), {x, y, z});
    all.push_back(hostile);
    return all;
}

void draw(const std::vector<float>& points, int width, int height, int k, float radius, float max_half, float gap) {
    const size_t n = points.size() / 3, pixels = static_cast<size_t>(width) * height;
    sf::RasterSpec spec{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}, 61, 47, 25.7f, 19.1f, width, height, radius, 0.05f,
                        max_half, k, gap, 0.5f, 3};
    std::vector<float> depth(pixels), position(3 * pixels), weight(k * pixels), normal(3 * pixels);
    std::vector<int32_t> index(k * pixels);
    for (const float* normals : {static_cast<const float*>(nullptr), points.data()}) {
        sf::rasterize(points.data(), normals, n, spec,
                      {depth.data(), position.data(), index.data(), weight.data(), normal.data()});
        for (size_t p = 0; p < pixels; ++p) {
            expect(std::isfinite(depth[p]) == (index[p * k] >= 0), "a pixel has a depth and a point, or neither");
            for (int c = 0; c < k; ++c) expect(index[p * k + c] < static_cast<int64_t>(n), "an index is a row");
        }
    }
    sf::rasterize(points.data(), nullptr, n, spec, {depth.data(), nullptr, nullptr, nullptr, normal.data()});
    sf::rasterize(points.data(), nullptr, n, spec, {depth.data(), nullptr, nullptr, nullptr, nullptr});
}

void rasterizer() {
    const int sizes[][2] = {{1, 1}, {53, 37}, {16, 16}, {1, 33}, {130, 2}};
    for (const auto& points : clouds())
        for (const auto& size : sizes)
            for (const float max_half : {0.5f, 1.5f, 64.0f, 1024.0f}) {
                draw(points, size[0], size[1], 1, 0.02f, max_half, 0.05f);
                draw(points, size[0], size[1], 8, 1e30f, max_half, 0.0f);
                draw(points, size[0], size[1], 5, 0.0f, max_half, kInf);
            }
}

void grid() {
    for (const float cell : {0.01f, 0.1f, 3.0f}) {
        sf::PointGrid grid(cell);
        std::vector<int32_t> ids(64 * 500), rows, parents;
        std::vector<float> d2(64 * 500);
        const std::vector<float> queries = cloud(500, -1.0f, 1.0f, 9);
        expect(grid.knn(queries.data(), 500, 3, cell, ids.data(), d2.data(), 2) && ids[0] == -1, "an empty grid");
        const std::vector<float> points = cloud(3000, -1.0f, 1.0f, 8);
        for (size_t i = 0; i < 1500; ++i) grid.add(&points[3 * i]);
        grid.add_spaced(&points[4500], 1500, 0.5f * cell, 2 * cell, rows, parents);
        for (const int k : {1, 4, 64}) {
            expect(grid.knn(queries.data(), 500, k, 2.5f * cell, ids.data(), d2.data(), 3), "knn");
            for (int i = 0; i < 500 * k; ++i) expect(ids[i] < grid.size(), "an id is a point");
        }
        for (const float bad : {kNan, kInf, -kInf, kMax, 1e12f}) {
            const float point[3] = {0.0f, bad, 0.0f};
            expect(!grid.knn(point, 1, 1, cell, ids.data(), d2.data(), 1), "a query that is out of range");
            try {
                grid.add(point);
                expect(false, "a point that is out of range");
            } catch (const std::out_of_range&) {
            }
        }
    }
}

void tables() {
    const std::vector<float> table = cloud(100, 0.0f, 1.0f, 5);
    const std::vector<int32_t> ids{0, 99, 5, 5, -1, 100};
    const std::vector<float> weights{0.5f, 0.5f, 1.0f, kNan, 0.0f, 0.0f};
    std::vector<float> out(9);
    expect(sf::interpolate(table.data(), 100, 3, ids.data(), weights.data(), 3, 2, out.data(), 2), "interpolate");
    const float ones[2] = {1.0f, 1.0f};
    expect(!sf::interpolate(table.data(), 100, 3, &ids[4], ones, 1, 2, out.data(), 1), "an id below the table");
    std::vector<float> values = table;
    std::vector<uint16_t> mean(300), root(300);
    std::vector<int16_t> steps(100);
    const sf::AdamTable all{values.data(), mean.data(), root.data(), steps.data(), 100, 3};
    const sf::AdamRates rates{0.01f, 0.9f, 0.99f, 1e-3f};
    expect(!sf::adam_rows(&ids[4], ones, 1, 2, out.data(), all, rates, 1) && values == table, "an id below the table");
    steps[99] = 32767;
    const float gradient[3] = {1.0f, -1.0f, 1e30f};
    expect(sf::adam_rows(ids.data(), ones, 1, 2, gradient, all, rates, 2), "a step");
    expect(steps[0] == 1 && steps[5] == 0 && values[0] != table[0] && values[15] == table[15], "rows that rest");
    expect(sf::voxel_means(table.data(), 100, 3, 0.5f).size() % 3 == 0, "means");
    try {
        sf::voxel_means(&kNan, 0, 3, 0.5f);
        const float bad[3] = {kNan, 0, 0};
        sf::voxel_means(bad, 1, 3, 0.5f);
        expect(false, "a sample that is not finite");
    } catch (const std::out_of_range&) {
    }
}

void decoder() {
    sf::PointGrid fine(0.15f), coarse(0.6f);
    const std::vector<float> points = cloud(4000, 0.9f, 1.1f, 6);
    for (size_t i = 0; i < 4000; ++i) fine.add(&points[3 * i]);
    for (size_t i = 0; i < 200; ++i) coarse.add(&points[3 * i]);
    const std::vector<float> features(4000 * 11, 0.3f), weights(3 * 29, 0.1f), bias(3, -0.2f);
    sf::ColorNetwork network{};  // the newest 500 points have no row yet
    network.levels = {{&fine, features.data(), 3500, 11, 0.2f, 100.0f}, {&coarse, features.data(), 200, 8, 0.8f, 5.0f}};
    network.neighbours = 16, network.degree = 2;
    network.layers = {{weights.data(), bias.data(), 27, 3}};
    network.base = points.data(), network.base_rows = 3500;
    std::vector<float> queries = cloud(1001, 0.5f, 1.5f, 7), colors(3 * 1001);
    queries[0] = queries[1] = queries[2] = 1e3f;  // no neighbour there
    expect(sf::decode_colors(network, queries.data(), 1001, &queries[3], colors.data(), 3), "colours");
    for (const float c : colors) expect(c >= 0.0f && c <= 1.0f, "a colour in 0..1");
    queries[900] = kNan;
    expect(!sf::decode_colors(network, queries.data(), 1001, &queries[3], colors.data(), 2), "a query that is nan");
    const float T[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    expect(sf::decode_image(network, queries.data(), 77, 13, T, colors.data(), 2), "an image with a hole");
    expect(sf::decode_image(network, queries.data(), 0, 0, T, colors.data(), 2), "an empty image");
}

void blend() {
    const int width = 37, height = 11;
    std::vector<float> z(width * height, 1.0f), color(3 * width * height), total(width * height), trust(width * height);
    const float hostile[] = {0.0f, kTiny, -1.0f, kMax, kInf, kNan, 1e-7f};
    for (size_t i = 0; i < 7; ++i) z[30 * i] = hostile[i];
    const std::vector<uint8_t> surface(width * height, 1), image(3 * 5 * 3, 200);
    const std::vector<uint16_t> depth(5 * 3, 1000);
    for (const float focal : {0.0f, 1.0f, 1e30f, kNan}) {
        const sf::SourceView view{image.data(), depth.data(), 1e-3f, 5, 3, {focal, 0, 0, 0, focal, 0, 0, 0, 1},
                                  {1, 1, 0}, 1.0f, 2.0f};
        sf::blend_view(z.data(), surface.data(), width, height, view, {0.05f, 0.3f, 16.0f, 0.1f}, color.data(),
                       total.data(), trust.data(), 2);
    }
    for (size_t i = 0; i < total.size(); ++i)
        expect(total[i] >= 0.0f && trust[i] <= 1.0f && std::abs(color[3 * i] - 200.0f * total[i]) < 0.1f, "a blend");
    expect(total[1] > 0.0f, "a pixel that the view sees");
}

}  // namespace

int main() {
    rasterizer();
    grid();
    tables();
    decoder();
    blend();
    std::puts("all kernels behave");
}

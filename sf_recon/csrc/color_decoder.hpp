// SPDX-License-Identifier: Apache-2.0
// The colour of surface points in one pass: nearest neural points of all levels, interpolated features, network.
// sf_recon/core/color_field.py is its definition.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "point_grid.hpp"

namespace sf {

struct FieldLevel {
    const PointGrid* grid;
    const float* features;  // [rows, columns]
    size_t rows, columns;
    float radius;         // of the neighbour search
    float inverse_sigma;  // of the weight exp(-d2 / sigma), 1 / m^2
};

struct Layer {  // out = weight in + bias, then max(0, .) unless it is the last
    const float* weight;  // [outputs, inputs]
    const float* bias;    // [outputs]
    size_t inputs, outputs;
};

struct ColorNetwork {
    std::vector<FieldLevel> levels;
    std::vector<Layer> layers;  // the last one has three outputs; their sigmoid is the colour
    int neighbours;
    const float* base;  // [rows, 3] colours of the points of level 0, whose logit the output is added to; or null
    size_t base_rows;
    int degree;       // of the viewing direction in the input: 0 none, 1 xyz, 2 also xy yz xz x2-y2 3z2-1
    const float* extra;  // [n, extra_columns] further inputs of every query, after the direction; or null
    size_t extra_columns;
};

constexpr size_t direction_columns(int degree) { return degree == 0 ? 0 : degree == 1 ? 3 : 8; }

// Colours [n, 3] in 0..1 of points [n, 3] of the map frame, seen from `eye` [3]. Fast where points that follow one
// another lie together; the result does not depend on their order. False when a point lies outside the grid's range.
bool decode_colors(const ColorNetwork& network, const float* points, size_t n, const float* eye, float* colors,
                   int threads);

// The same for the pixels of an image [height, width, 3] of positions in the camera frame; NaN gives black.
bool decode_image(const ColorNetwork& network, const float* positions, size_t height, size_t width,
                  const float* T_map_camera, float* colors, int threads);

}  // namespace sf

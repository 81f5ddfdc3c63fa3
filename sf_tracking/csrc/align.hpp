// SPDX-License-Identifier: Apache-2.0
// Inverse compositional alignment of patches with gain and bias; align_reference.py says what it computes.
#pragma once
#include <cstddef>
#include <cstdint>

namespace sf {

constexpr int kMaxSide = 41;

struct Image {
    const float* grey;  // [height, width]
    int width, height;
};

struct Alignment {
    double* centre;      // [E, 2] px, NaN where the start or the warp is not finite
    double* covariance;  // [E, 2, 2] px^2
    double* gain;        // [E]
    double* residual;    // [E] grey levels
    double* explained;   // [E]
};

struct Aligned {
    const double *centre, *covariance, *gain, *residual, *explained;  // as in Alignment
};

struct Limits {
    double border;         // px from the edge of the image
    double reach;          // px from the start
    double explained;      // share of the variance that must be explained at least, where
    double noise;          // the residual is larger than this, grey levels
    double residual;       // grey levels, at most
    double gain;           // at most, and at least one over it
    double own;            // px, deviation that every position has
};

// Templates J [M, 4, side^2] and inverse [M, 4, 4] of the patches at uv [M, 2]; side <= kMaxSide.
void describe(const Image& image, const double* uv, size_t count, int side, float* J, double* inverse);

// Edge e is template rows[e], looked for near start [E, 2], warped by warp [E, 2, 2].
void align(const Image& image, const float* J, const double* inverse, const int64_t* rows, size_t edges, int side,
           int iterations, const double* start, const double* warp, const Alignment& out);

// Which alignments are believed in an image of width by height px, and the information [E, 2, 2] of all of them.
void judge(const double* start, const Aligned& found, size_t edges, int width, int height, const Limits& limits,
           double* information, bool* valid);

}  // namespace sf

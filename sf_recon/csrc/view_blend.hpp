// SPDX-License-Identifier: Apache-2.0
// What keyframe images show of a drawn surface, added up pixel by pixel.
#pragma once
#include <cstddef>
#include <cstdint>

namespace sf {

struct SourceView {  // a keyframe seen from the drawn view: its pixel of a surface point is (A [u v 1] z + b), dehomogenised
    const uint8_t* image;  // [height, width, 3]
    const uint16_t* depth;  // [height, width] in steps, 0 = none
    float step;             // m
    int width, height;
    float A[9], b[3];
    float trust, weight;  // of the whole view
};

struct BlendRules {
    float doubt;    // of the depth: a view whose own depth is off by so much counts half
    float other;    // of the depth: off by more, it saw another surface
    float feather;  // px over which a view fades out towards its border
    float unknown;  // agreement of a pixel without depth
};

// For each pixel with depth z [height, width]: color [., 3] += w * image, total += w, confidence = max(., trust).
// Where surface is 0, z is a guess and the view is not asked whether it saw that depth.
void blend_view(const float* z, const uint8_t* surface, int width, int height, const SourceView& view,
                const BlendRules& rules, float* color, float* total, float* confidence, int threads);

}  // namespace sf

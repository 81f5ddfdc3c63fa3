// SPDX-License-Identifier: Apache-2.0
#include "reproject.hpp"

#include <cmath>

namespace sf {
namespace {

constexpr double kMinZ = 0.05;

}  // namespace

void reproject(const Camera& camera, const double* T, const Rays& rays, double width, double height, double least,
               double most, const Reprojection& out) {
    const double focal[2] = {camera.fx, camera.fy}, centre[2] = {camera.cx, camera.cy};
    for (size_t k = 0; k < rays.count; ++k) {
        const double w = rays.w[k], *slope = rays.slope + 2 * k;
        const double x = (rays.uv[2 * k] - camera.cx) / camera.fx, y = (rays.uv[2 * k + 1] - camera.cy) / camera.fy;
        double X[3], along[3][2];  // the scaled point and its change by a pixel
        for (int i = 0; i < 3; ++i) {
            const double* row = T + 4 * i;
            X[i] = row[0] * x + row[1] * y + row[2] + w * row[3];
            for (int j = 0; j < 2; ++j) along[i][j] = row[j] / focal[j] + row[3] * slope[j];
        }
        const bool ahead = X[2] > kMinZ;
        const double z = ahead ? X[2] : 1.0;
        double *uv = out.uv + 2 * k, *warp = out.warp + 4 * k;
        for (int i = 0; i < 2; ++i) {
            const double on_axis = X[i] / z, scaled = focal[i] / z;
            uv[i] = ahead ? focal[i] * on_axis + centre[i] : std::nan("");
            out.J_w[2 * k + i] = scaled * (T[4 * i + 3] - on_axis * T[11]);
            for (int j = 0; j < 2; ++j) warp[2 * i + j] = scaled * (along[i][j] - on_axis * along[2][j]);
        }
        const double area = warp[0] * warp[3] - warp[1] * warp[2];
        out.w[k] = w / z;
        out.visible[k] = uv[0] >= 0 && uv[1] >= 0 && uv[0] < width && uv[1] < height && area > least && area < most;
    }
}

}  // namespace sf

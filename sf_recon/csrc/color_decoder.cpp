// SPDX-License-Identifier: Apache-2.0
// Queries go in groups of 64 that lie together. A group looks up the points that can be a neighbour of any of its
// members once, and then works on 16 queries at a time, one per vector lane.
#include "color_decoder.hpp"

#include <omp.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "simd.hpp"

namespace sf {
namespace {

constexpr int kGroup = 64, kLanes = 16, kSide = 8;
constexpr int kMaxK = 16;
constexpr float kBaseMargin = 0.02f;  // keeps the logit of a black or white base colour finite
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kSpread = 0.4f;  // of the search radius: groups wider than this are divided

struct Group {
    int count = 0;
    size_t row[kGroup];  // of each query in the output
    alignas(64) float x[kGroup], y[kGroup], z[kGroup];

    void add(size_t r, float px, float py, float pz) {
        row[count] = r;
        x[count] = px, y[count] = py, z[count++] = pz;
    }
};

struct Lanes {  // the K nearest of 16 queries, ascending
    alignas(64) float distance2[kMaxK][kLanes];
    alignas(64) int32_t id[kMaxK][kLanes];
};

struct Scratch {
    Lanes near[kGroup / kLanes];
    Candidates candidates;
    std::vector<float> rows, input, hidden[2];  // [kGroup, columns]; [columns, kGroup] from here on
    float base[kGroup][3], points[kGroup * 3], distance2[kGroup * kMaxK];
    int32_t ids[kGroup * kMaxK];
    uint32_t order[kGroup];
};

SF_SIMD void select_nearest(const Candidates& c, const float* x, const float* y, const float* z, int k, float radius2,
                            Lanes& near) {
    const float start = std::nextafter(radius2, kInfinity);
    for (int j = 0; j < k; ++j)
        for (int i = 0; i < kLanes; ++i) near.distance2[j][i] = start, near.id[j][i] = -1;
    for (int n = 0; n < c.count; ++n) {
        float d2[kLanes];
        int32_t id[kLanes];
        int32_t closer = 0;
        for (int i = 0; i < kLanes; ++i) {
            const float dx = c.x[n] - x[i], dy = c.y[n] - y[i], dz = c.z[n] - z[i];
            d2[i] = dx * dx + dy * dy + dz * dz;
            id[i] = c.id[n];
            closer |= d2[i] < near.distance2[k - 1][i];
        }
        if (!closer) continue;
        for (int j = 0; j < k; ++j)
            for (int i = 0; i < kLanes; ++i) {
                const bool before = d2[i] < near.distance2[j][i];
                const float far = before ? near.distance2[j][i] : d2[i];
                const int32_t far_id = before ? near.id[j][i] : id[i];
                near.distance2[j][i] = before ? d2[i] : near.distance2[j][i];
                near.id[j][i] = before ? id[i] : near.id[j][i];
                d2[i] = far, id[i] = far_id;
            }
    }
}

// Weights exp(-d2 / sigma) in place of the squared distances; they sum to 1, or are all 0 where no point is near.
SF_SIMD void weigh(int k, float inverse_sigma, Lanes& near) {
    float nearest[kLanes], sum[kLanes] = {};
    for (int i = 0; i < kLanes; ++i) nearest[i] = near.distance2[0][i];
    for (int j = 0; j < k; ++j)
        for (int i = 0; i < kLanes; ++i) {
            const float w = exp_negative((nearest[i] - near.distance2[j][i]) * inverse_sigma);
            near.distance2[j][i] = near.id[j][i] >= 0 ? w : 0.0f;
            sum[i] += near.distance2[j][i];
        }
    for (int j = 0; j < k; ++j)
        for (int i = 0; i < kLanes; ++i) near.distance2[j][i] /= sum[i] > 1e-12f ? sum[i] : 1e-12f;
}

// out [lanes, columns] = weighted rows of the neighbours; a neighbour whose row is not there yet is left out.
SF_SIMD void blend(const Lanes& near, int k, const float* table, size_t rows, size_t columns, float* out,
                   size_t stride) {
    for (int i = 0; i < kLanes; ++i) {
        float* sum = out + i * stride;
        const float* row[kMaxK];
        float weight[kMaxK];
        int found = 0;
        for (int j = 0; j < k; ++j) {
            const size_t id = static_cast<size_t>(near.id[j][i]);  // -1 becomes huge
            row[found] = table + (id < rows ? id : 0) * columns, weight[found] = near.distance2[j][i];
            found += id < rows;
        }
        size_t c = 0;
        for (; c + 8 <= columns; c += 8) {
            Float8 total = {};
            for (int j = 0; j < found; ++j) total += weight[j] * load8(row[j] + c);
            std::memcpy(sum + c, &total, sizeof(total));
        }
        for (; c < columns; ++c) {
            float total = 0.0f;
            for (int j = 0; j < found; ++j) total += weight[j] * row[j][c];
            sum[c] = total;
        }
    }
}

typedef float Vector __attribute__((vector_size(4 * kLanes), aligned(4)));

// out [outputs, kGroup] = weight in [inputs, kGroup] + bias; four outputs at a time share what they load.
SF_SIMD void dense(const Layer& layer, const float* in, float* out, bool relu) {
    for (size_t o = 0; o < layer.outputs; o += 4) {
        const size_t block = std::min<size_t>(4, layer.outputs - o);
        const float* w[4];
        for (size_t b = 0; b < 4; ++b) w[b] = layer.weight + std::min(o + b, layer.outputs - 1) * layer.inputs;
        for (int q = 0; q < kGroup; q += kLanes) {
            Vector sum[4] = {};
            for (size_t c = 0; c < layer.inputs; ++c) {
                const Vector x = *reinterpret_cast<const Vector*>(in + c * kGroup + q);
                sum[0] += w[0][c] * x, sum[1] += w[1][c] * x, sum[2] += w[2][c] * x, sum[3] += w[3][c] * x;
            }
            for (size_t b = 0; b < block; ++b) {
                const Vector y = sum[b] + layer.bias[o + b];
                *reinterpret_cast<Vector*>(out + (o + b) * kGroup + q) = relu ? (y > 0.0f ? y : Vector{}) : y;
            }
        }
    }
}

SF_SIMD void transpose(const float* rows, size_t columns, float* out) {
    for (size_t c = 0; c < columns; ++c)
        for (int q = 0; q < kGroup; ++q) out[c * kGroup + q] = rows[q * columns + c];
}

class Decoder {
   public:
    Decoder(const ColorNetwork& network, const float* eye) : net_(network), eye_(eye) {
        size_t widest = 0;
        for (const FieldLevel& level : net_.levels) {
            encoded_ += level.columns;
            cursors_.emplace_back(*level.grid);
        }
        for (int i = 0; i < kGroup; ++i) scratch_.order[i] = static_cast<uint32_t>(i);
        for (const Layer& layer : net_.layers) widest = std::max(widest, layer.outputs);
        scratch_.rows.resize(kGroup * encoded_);
        scratch_.input.resize(kGroup * net_.layers.front().inputs);
        for (auto& hidden : scratch_.hidden) hidden.resize(kGroup * widest);
    }

    void decode(Group& group, float* colors) {
        if (group.count == 0) return;
        for (int i = group.count; i < kGroup; ++i)  // lanes beyond the end repeat the last query
            group.x[i] = group.x[i - 1], group.y[i] = group.y[i - 1], group.z[i] = group.z[i - 1];
        size_t column = 0;
        for (const FieldLevel& level : net_.levels) {
            find(level, group, 0, kGroup);
            for (int first = 0; first < kGroup; first += kLanes) {
                Lanes& near = scratch_.near[first / kLanes];
                weigh(net_.neighbours, level.inverse_sigma, near);
                blend(near, net_.neighbours, level.features, level.rows, level.columns,
                      scratch_.rows.data() + first * encoded_ + column, encoded_);
                if (column == 0 && net_.base)
                    blend(near, net_.neighbours, net_.base, net_.base_rows, 3, scratch_.base[first], 3);
            }
            column += level.columns;
        }
        transpose(scratch_.rows.data(), encoded_, scratch_.input.data());
        append(group);
        const float* out = run_network();
        for (int i = 0; i < group.count; ++i)
            for (int c = 0; c < 3; ++c) colors[3 * group.row[i] + c] = color(out[c * kGroup + i], i, c);
        group.count = 0;
    }

   private:
    // The nearest points of queries first..first + count into the lanes, through their common candidates.
    void find(const FieldLevel& level, const Group& g, int first, int count) {
        float low[3], high[3], centre[3], spread2 = 0.0f;
        const float* axes[3] = {g.x + first, g.y + first, g.z + first};
        for (int a = 0; a < 3; ++a) {
            low[a] = *std::min_element(axes[a], axes[a] + count);
            high[a] = *std::max_element(axes[a], axes[a] + count);
            centre[a] = 0.5f * (low[a] + high[a]);
            spread2 += 0.25f * (high[a] - low[a]) * (high[a] - low[a]);
        }
        const float spread = std::sqrt(spread2) * 1.0001f, limit = kSpread * level.radius;
        if (count > kLanes && spread > limit) {
            for (int i = first; i < first + count; i += kLanes) find(level, g, i, kLanes);
        } else if (spread > limit || !collect(level, centre, spread)) {
            find_each(level, g, first, count);
        } else {
            for (int i = first; i < first + count; i += kLanes)
                select_nearest(scratch_.candidates, g.x + i, g.y + i, g.z + i, net_.neighbours,
                               level.radius * level.radius, scratch_.near[i / kLanes]);
        }
    }

    GridCursor& cursor(const FieldLevel& level) { return cursors_[&level - net_.levels.data()]; }

    // Every member is within `spread` of the centre, so its K nearest are within (K-th distance + 2 spread) of it.
    bool collect(const FieldLevel& level, const float* centre, float spread) {
        int32_t ids[kMaxK];
        float distance2[kMaxK];
        const float widest = (level.radius + spread) * 1.0001f;
        cursor(level).query(centre, scratch_.order, 1, net_.neighbours, widest, ids, distance2);
        const float kth = std::sqrt(distance2[net_.neighbours - 1]);
        return level.grid->collect(centre, std::min(widest, (kth + 2 * spread) * 1.0001f), scratch_.candidates);
    }

    void find_each(const FieldLevel& level, const Group& g, int first, int count) {
        const int k = net_.neighbours;
        for (int i = first; i < first + count; ++i) {
            scratch_.points[3 * i] = g.x[i], scratch_.points[3 * i + 1] = g.y[i], scratch_.points[3 * i + 2] = g.z[i];
        }
        cursor(level).query(scratch_.points, scratch_.order + first, count, k, level.radius, scratch_.ids,
                                                    scratch_.distance2);
        for (int i = first; i < first + count; ++i) {
            Lanes& near = scratch_.near[i / kLanes];
            for (int j = 0; j < k; ++j) {
                near.id[j][i % kLanes] = scratch_.ids[i * k + j];
                near.distance2[j][i % kLanes] = std::min(scratch_.distance2[i * k + j], 2 * level.radius * level.radius);
            }
        }
    }

    // Viewing direction and further inputs, below the encoded features.
    void append(const Group& g) {
        float* input = scratch_.input.data() + encoded_ * kGroup;
        for (int i = 0; i < kGroup && net_.degree > 0; ++i) {
            float d[3] = {g.x[i] - eye_[0], g.y[i] - eye_[1], g.z[i] - eye_[2]};
            const float norm = std::max(std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-12f);
            for (float& v : d) v /= norm;
            const float terms[8] = {d[0],        d[1],        d[2],                      d[0] * d[1],
                                    d[1] * d[2], d[0] * d[2], d[0] * d[0] - d[1] * d[1], 3 * d[2] * d[2] - 1};
            for (size_t c = 0; c < direction_columns(net_.degree); ++c) input[c * kGroup + i] = terms[c];
        }
        input += direction_columns(net_.degree) * kGroup;
        for (int i = 0; i < kGroup && net_.extra; ++i)
            for (size_t c = 0; c < net_.extra_columns; ++c)
                input[c * kGroup + i] = net_.extra[g.row[std::min(i, g.count - 1)] * net_.extra_columns + c];
    }

    const float* run_network() {
        const float* in = scratch_.input.data();
        for (size_t l = 0; l < net_.layers.size(); ++l) {
            float* out = scratch_.hidden[l % 2].data();
            dense(net_.layers[l], in, out, l + 1 < net_.layers.size());
            in = out;
        }
        return in;
    }

    float color(float value, int query, int channel) const {
        if (net_.base) {
            const float p = std::min(std::max(scratch_.base[query][channel], kBaseMargin), 1 - kBaseMargin);
            value += std::log(p / (1 - p));
        }
        const float e = exp_negative(-std::abs(value));
        return (value < 0 ? e : 1.0f) / (1.0f + e);
    }

    const ColorNetwork& net_;
    const float* eye_;
    size_t encoded_ = 0;
    std::vector<GridCursor> cursors_;
    Scratch scratch_;
};

// Runs make(decoder) on a team of threads, which call it for the items they get.
template <class Visit>
bool in_parallel(const ColorNetwork& network, const float* eye, size_t items, int threads, const Visit& visit) {
    std::atomic<bool> good{true};
#pragma omp parallel num_threads(threads > 0 ? threads : omp_get_max_threads())
    {
        Decoder decoder(network, eye);
#pragma omp for schedule(dynamic, 8)
        for (size_t i = 0; i < items; ++i) {
            try {
                visit(i, decoder);
            } catch (const std::out_of_range&) {  // an exception must not leave a parallel region
                good = false;
            }
        }
    }
    return good;
}

}  // namespace

bool decode_colors(const ColorNetwork& network, const float* points, size_t n, const float* eye, float* colors,
                   int threads) {
    return in_parallel(network, eye, (n + kGroup - 1) / kGroup, threads, [&](size_t g, Decoder& decoder) {
        Group group;
        for (size_t i = g * kGroup; i < std::min(n, (g + 1) * kGroup); ++i)
            group.add(i, points[3 * i], points[3 * i + 1], points[3 * i + 2]);
        decoder.decode(group, colors);
    });
}

bool decode_image(const ColorNetwork& network, const float* positions, size_t height, size_t width,
                  const float* T_map_camera, float* colors, int threads) {
    const float* T = T_map_camera;
    const float eye[3] = {T[3], T[7], T[11]};
    const size_t columns = (width + kSide - 1) / kSide, tiles = columns * ((height + kSide - 1) / kSide);
    return in_parallel(network, eye, tiles, threads, [&](size_t tile, Decoder& decoder) {
        Group group;
        const size_t top = tile / columns * kSide, left = tile % columns * kSide;
        for (size_t i = 0; i < kGroup; ++i) {  // quarter by quarter, so that 16 lanes are a square
            const size_t v = top + i / 32 * 4 + i % 16 / 4, u = left + i / 16 % 2 * 4 + i % 4;
            if (v >= height || u >= width) continue;
            const size_t row = v * width + u;
            const float* p = positions + 3 * row;
            if (std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]))
                group.add(row, T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3],
                          T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7],
                          T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11]);
            else
                colors[3 * row] = colors[3 * row + 1] = colors[3 * row + 2] = 0.0f;
        }
        decoder.decode(group, colors);
    });
}

}  // namespace sf

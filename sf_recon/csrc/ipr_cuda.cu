// SPDX-License-Identifier: Apache-2.0
// One key per point and tile, tile number above the bits of the depth; one radix sort then leaves every tile's points
// front to back, and a block of 16 x 16 threads draws its tile until all its pixels are full. Equal depths keep the
// order of the cloud, because keys are written in that order and the sort is stable.
// Compiled with -fmad=false: indices must equal those of the CPU.
#include "ipr_cuda.hpp"

#include <cub/cub.cuh>
#include <stdexcept>

#include "cuda_memory.hpp"
#include "ipr_window.hpp"

namespace sf {
namespace {

constexpr int kThreads = kTile * kTile;
constexpr int kDepthBits = 31;  // of a positive float
constexpr float kMinStep = 1e-5f, kMinSine = 1e-2f;  // as on the CPU

__device__ __forceinline__ float hole() { return __int_as_float(0x7fc00000); }

__global__ void count_tiles(const float* points, int n, RasterSpec s, uint32_t* counts, unsigned long long* total) {
    using Reduce = cub::BlockReduce<uint32_t, kThreads>;
    __shared__ typename Reduce::TempStorage shared;
    const int i = blockIdx.x * kThreads + threadIdx.x;
    uint32_t count = 0;
    float u, v, z;
    Window w;
    if (i < n && project(s, points + 3 * static_cast<size_t>(i), u, v, z, w))
        count = (w.x1 / kTile - w.x0 / kTile + 1) * (w.y1 / kTile - w.y0 / kTile + 1);
    if (i < n) counts[i] = count;
    const uint32_t sum = Reduce(shared).Sum(count);
    if (threadIdx.x == 0 && sum > 0) atomicAdd(total, static_cast<unsigned long long>(sum));
}

__global__ void write_keys(const float* points, int n, RasterSpec s, int tiles_x, const uint32_t* offsets,
                           uint64_t* keys, int32_t* ids) {
    const int i = blockIdx.x * kThreads + threadIdx.x;
    float u, v, z;
    Window w;
    if (i >= n || !project(s, points + 3 * static_cast<size_t>(i), u, v, z, w)) return;
    uint32_t at = offsets[i];
    for (int ty = w.y0 / kTile; ty <= w.y1 / kTile; ++ty)
        for (int tx = w.x0 / kTile; tx <= w.x1 / kTile; ++tx, ++at) {
            keys[at] = static_cast<uint64_t>(ty * tiles_x + tx) << kDepthBits | __float_as_uint(z);
            ids[at] = i;
        }
}

__global__ void find_tiles(const uint64_t* keys, int count, int2* ranges) {
    const int i = blockIdx.x * kThreads + threadIdx.x;
    if (i >= count) return;
    const int tile = static_cast<int>(keys[i] >> kDepthBits);
    if (i == 0 || static_cast<int>(keys[i - 1] >> kDepthBits) != tile) ranges[tile].x = i;
    if (i == count - 1 || static_cast<int>(keys[i + 1] >> kDepthBits) != tile) ranges[tile].y = i + 1;
}

struct Splat {
    float u, v, z, per_x2, per_y2;  // the last two: -1 / (sigma * half-width^2)
    int32_t id;
    uint32_t window;  // x0 | x1 << 8 | y0 << 16 | y1 << 24, pixels of the tile
};

__device__ Splat load_splat(const RasterSpec& s, const float* points, int32_t id, int left, int top) {
    Splat splat;
    Window w;
    project(s, points + 3 * static_cast<size_t>(id), splat.u, splat.v, splat.z, w);
    const float hx = half_width(s, s.fx, splat.z), hy = half_width(s, s.fy, splat.z);
    splat.per_x2 = -1.0f / (s.sigma * hx * hx), splat.per_y2 = -1.0f / (s.sigma * hy * hy);
    splat.id = id;
    splat.window = static_cast<uint32_t>(max(w.x0 - left, 0) | min(w.x1 - left, kTile - 1) << 8 |
                                         max(w.y0 - top, 0) << 16 | min(w.y1 - top, kTile - 1) << 24);
    return splat;
}

struct Pixel {  // sums over the first layer
    float last_z = 0, weight = 0, x = 0, y = 0, z = 0, normal[3] = {0, 0, 0};
    int count = 0;
    bool closed = false;
};

// Mean of the points' normals, each turned towards the camera (along the ray of the point itself).
__device__ void add_normal(const RasterSpec& s, const float* normal, const Splat& f, float weight, Pixel& pixel) {
    const float* R = s.rotation;
    float m[3];
    for (int a = 0; a < 3; ++a) m[a] = R[3 * a] * normal[0] + R[3 * a + 1] * normal[1] + R[3 * a + 2] * normal[2];
    const float along = m[0] * (f.u - s.cx) / s.fx + m[1] * (f.v - s.cy) / s.fy + m[2];
    for (int a = 0; a < 3; ++a) pixel.normal[a] += (along > 0 ? -weight : weight) * m[a];
}

__device__ void write_pixel(const RasterSpec& s, const Pixel& pixel, bool blend, size_t at, const RasterImages& out) {
    const bool hit = pixel.count > 0;
    const float scale = hit ? 1.0f / pixel.weight : hole();
    out.depth[at] = pixel.z * scale;
    if (out.position) {
        out.position[3 * at] = pixel.x * scale / s.fx, out.position[3 * at + 1] = pixel.y * scale / s.fy;
        out.position[3 * at + 2] = pixel.z * scale;
    }
    for (int c = 0; c < s.k_ray && out.weight; ++c) {
        float& weight = out.weight[at * s.k_ray + c];
        weight = c < pixel.count ? weight * scale : 0.0f;
    }
    for (int c = pixel.count; c < s.k_ray && out.index; ++c) out.index[at * s.k_ray + c] = -1;
    if (!blend) return;
    const float* m = pixel.normal;
    const float norm = sqrtf(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]);
    for (int a = 0; a < 3; ++a) out.normal[3 * at + a] = norm > 1e-6f * pixel.weight && hit ? m[a] / norm : hole();
}

__global__ void draw_tiles(const float* points, const float* normals, RasterSpec s, const int32_t* ids,
                           const int2* ranges, RasterImages out) {
    __shared__ Splat splats[kThreads];
    const int left = blockIdx.x * kTile, top = blockIdx.y * kTile;
    const int column = threadIdx.x % kTile, row = threadIdx.x / kTile, u = left + column, v = top + row;
    const size_t at = static_cast<size_t>(v) * s.width + u;
    const int2 range = ranges[blockIdx.y * gridDim.x + blockIdx.x];
    const bool inside = u < s.width && v < s.height, blend = out.normal != nullptr && normals != nullptr;
    Pixel pixel;
    pixel.closed = !inside;
    for (int begin = range.x; begin < range.y; begin += kThreads) {
        if (__syncthreads_and(pixel.closed)) break;  // also keeps the splats until everybody has read them
        if (begin + static_cast<int>(threadIdx.x) < range.y)
            splats[threadIdx.x] = load_splat(s, points, ids[begin + threadIdx.x], left, top);
        __syncthreads();
        for (int i = 0; i < min(kThreads, range.y - begin) && !pixel.closed; ++i) {
            const Splat& f = splats[i];
            const uint32_t w = f.window;
            if (column < int(w & 255) || column > int(w >> 8 & 255) || row < int(w >> 16 & 255) || row > int(w >> 24))
                continue;
            if (pixel.count > 0 && !(f.z - pixel.last_z < s.layer_gap)) {
                pixel.closed = true;
                break;
            }
            const float dx = u + 0.5f - f.u, dy = v + 0.5f - f.v;
            const float weight = expf(dx * dx * f.per_x2 + dy * dy * f.per_y2);
            if (out.index) out.index[at * s.k_ray + pixel.count] = f.id;
            if (out.weight) out.weight[at * s.k_ray + pixel.count] = weight;
            if (blend) add_normal(s, normals + 3 * static_cast<size_t>(f.id), f, weight, pixel);
            pixel.weight += weight, pixel.z += weight * f.z, pixel.last_z = f.z;
            pixel.x += weight * f.z * (f.u - s.cx), pixel.y += weight * f.z * (f.v - s.cy);
            pixel.closed = ++pixel.count == s.k_ray;
        }
    }
    if (inside) write_pixel(s, pixel, blend, at, out);
}

__device__ const float* same_layer(const float* p, const float* other, bool exists, float layer_gap) {
    return exists && fabsf(other[2] - p[2]) < layer_gap ? other : p;
}

__global__ void draw_normals(const float* position, RasterSpec s, float* normal) {
    const int u = blockIdx.x * kTile + threadIdx.x % kTile, v = blockIdx.y * kTile + threadIdx.x / kTile;
    if (u >= s.width || v >= s.height) return;
    const size_t at = static_cast<size_t>(v) * s.width + u;
    const float* p = position + 3 * at;
    const float* l = same_layer(p, p - 3, u > 0, s.layer_gap);
    const float* r = same_layer(p, p + 3, u + 1 < s.width, s.layer_gap);
    const float* a = same_layer(p, p - 3 * static_cast<ptrdiff_t>(s.width), v > 0, s.layer_gap);
    const float* b = same_layer(p, p + 3 * static_cast<ptrdiff_t>(s.width), v + 1 < s.height, s.layer_gap);
    const float3 x = make_float3(r[0] - l[0], r[1] - l[1], r[2] - l[2]);
    const float3 y = make_float3(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    const float n[3] = {y.y * x.z - y.z * x.y, y.z * x.x - y.x * x.z, y.x * x.y - y.y * x.x};
    const float norm = sqrtf(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    const float across = sqrtf(x.x * x.x + x.y * x.y + x.z * x.z), down = sqrtf(y.x * y.x + y.y * y.y + y.z * y.z);
    const bool sound = fminf(across, down) > kMinStep * p[2] && norm > kMinSine * across * down;
    for (int c = 0; c < 3; ++c) normal[3 * at + c] = sound ? n[c] / norm : hole();
}

int blocks(size_t items) { return static_cast<int>((items + kThreads - 1) / kThreads); }

}  // namespace

struct CudaRasterizer::Workspace {
    Buffer counts, offsets, total, keys[2], ids[2], ranges, scratch, position;
    cudaStream_t last_stream = nullptr;  // its work may still use the buffers
};

CudaRasterizer::CudaRasterizer(int device) : device_(device), workspace_(new Workspace) {}

CudaRasterizer::~CudaRasterizer() {
    int before = 0;
    cudaGetDevice(&before);
    cudaSetDevice(device_);
    workspace_.reset();
    cudaSetDevice(before);
}

void CudaRasterizer::rasterize(const float* points, const float* normals, size_t n, const RasterSpec& s,
                               const RasterImages& wanted, void* stream_pointer) {
    const std::lock_guard<std::mutex> lock(mutex_);
    const DeviceGuard guard(device_);
    const auto stream = static_cast<cudaStream_t>(stream_pointer);
    const dim3 grid((s.width + kTile - 1) / kTile, (s.height + kTile - 1) / kTile);
    const int tiles = static_cast<int>(grid.x * grid.y), points_count = static_cast<int>(n);
    Workspace& w = *workspace_;
    if (w.last_stream != stream) check(cudaStreamSynchronize(w.last_stream), "waiting for the stream before");
    w.last_stream = stream;
    RasterImages out = wanted;
    if (out.normal && !normals && !out.position)
        out.position = w.position.reserve<float>(3 * static_cast<size_t>(s.width) * s.height);
    int2* ranges = w.ranges.reserve<int2>(tiles);
    check(cudaMemsetAsync(ranges, 0, tiles * sizeof(int2), stream), "cudaMemsetAsync");

    uint32_t *counts = w.counts.reserve<uint32_t>(n), *offsets = w.offsets.reserve<uint32_t>(n);
    auto* total = w.total.reserve<unsigned long long>(1);
    unsigned long long fragments = 0;
    if (n > 0) {
        check(cudaMemsetAsync(total, 0, sizeof(*total), stream), "cudaMemsetAsync");
        count_tiles<<<blocks(n), kThreads, 0, stream>>>(points, points_count, s, counts, total);
        check(cudaGetLastError(), "count_tiles");
        check(cudaMemcpyAsync(&fragments, total, sizeof(*total), cudaMemcpyDeviceToHost, stream), "cudaMemcpyAsync");
        check(cudaStreamSynchronize(stream), "counting fragments");
    }
    if (fragments > 0x7fffffffull)
        throw std::runtime_error("the points cover more than 2^31 tiles: raise the near plane or lower max_half");
    int32_t* ids = nullptr;
    if (fragments > 0) {
        const int count = static_cast<int>(fragments);
        cub::DoubleBuffer<uint64_t> key_buffer(w.keys[0].reserve<uint64_t>(count), w.keys[1].reserve<uint64_t>(count));
        cub::DoubleBuffer<int32_t> id_buffer(w.ids[0].reserve<int32_t>(count), w.ids[1].reserve<int32_t>(count));
        int bits = kDepthBits;
        while (tiles > 1 << (bits - kDepthBits)) ++bits;
        size_t scan_bytes = 0, sort_bytes = 0;
        check(cub::DeviceScan::ExclusiveSum(nullptr, scan_bytes, counts, offsets, points_count, stream), "scan");
        check(cub::DeviceRadixSort::SortPairs(nullptr, sort_bytes, key_buffer, id_buffer, count, 0, bits, stream),
              "sort");
        void* scratch = w.scratch.reserve<char>(scan_bytes > sort_bytes ? scan_bytes : sort_bytes);
        check(cub::DeviceScan::ExclusiveSum(scratch, scan_bytes, counts, offsets, points_count, stream), "scan");
        write_keys<<<blocks(n), kThreads, 0, stream>>>(points, points_count, s, grid.x, offsets, key_buffer.Current(),
                                                       id_buffer.Current());
        check(cudaGetLastError(), "write_keys");
        check(cub::DeviceRadixSort::SortPairs(scratch, sort_bytes, key_buffer, id_buffer, count, 0, bits, stream),
              "sort");
        find_tiles<<<blocks(count), kThreads, 0, stream>>>(key_buffer.Current(), count, ranges);
        check(cudaGetLastError(), "find_tiles");
        ids = id_buffer.Current();
    }
    draw_tiles<<<grid, kThreads, 0, stream>>>(points, normals, s, ids, ranges, out);
    check(cudaGetLastError(), "draw_tiles");
    if (out.normal && !normals) {
        draw_normals<<<grid, kThreads, 0, stream>>>(out.position, s, out.normal);
        check(cudaGetLastError(), "draw_normals");
    }
}

}  // namespace sf

// SPDX-License-Identifier: Apache-2.0
// One radix sort by cell leaves the points of a cell together, in the order of their ids. A query walks the cells that
// its ball touches. Compiled with -fmad=false: distances must equal those of the CPU.
#include "grid_cuda.hpp"

#include <cub/cub.cuh>

#include "cuda_memory.hpp"

namespace sf {
namespace {

constexpr int kThreads = 256;
constexpr int kLimit = 1 << 20;  // cells on each side of the origin, as on the CPU: 21 bits an axis
constexpr unsigned long long kFree = ~0ull, kNowhere = 1ull << 63;
constexpr int kKeyBits = 64;

struct Slot {
    unsigned long long cell;
    uint32_t first;  // of the cell's points in sorted order
};

__device__ bool cell_of(float coordinate, float inverse, int& cell) {
    const float c = floorf(coordinate * inverse);
    const bool inside = c > -kLimit && c < kLimit;  // false for NaN
    cell = inside ? static_cast<int>(c) : 0;
    return inside;
}

__device__ unsigned long long pack(int x, int y, int z) {
    return static_cast<unsigned long long>(x + kLimit) << 42 | static_cast<unsigned long long>(y + kLimit) << 21 |
           static_cast<unsigned long long>(z + kLimit);
}

__device__ uint32_t slot_of(unsigned long long cell, uint32_t mask) {
    cell ^= cell >> 31, cell *= 0x7fb5d329728ea185ull;
    cell ^= cell >> 27, cell *= 0x81dadef4bc2dd44dull;
    return static_cast<uint32_t>(cell ^ cell >> 33) & mask;
}

__global__ void find_cells(const float* points, uint32_t n, float inverse, unsigned long long* cells, uint32_t* ids) {
    const uint32_t i = blockIdx.x * kThreads + threadIdx.x;
    if (i >= n) return;
    int x, y, z;
    const float* p = points + 3 * static_cast<size_t>(i);
    const bool inside = cell_of(p[0], inverse, x) & cell_of(p[1], inverse, y) & cell_of(p[2], inverse, z);
    cells[i] = inside ? pack(x, y, z) : kNowhere;
    ids[i] = i;
}

__global__ void place(const float* points, const uint32_t* ids, uint32_t n, const unsigned long long* cells,
                      float4* sorted, Slot* table, uint32_t mask) {
    const uint32_t i = blockIdx.x * kThreads + threadIdx.x;
    if (i >= n) return;
    const float* p = points + 3 * static_cast<size_t>(ids[i]);
    sorted[i] = make_float4(p[0], p[1], p[2], __int_as_float(static_cast<int>(ids[i])));
    if (cells[i] == kNowhere || (i > 0 && cells[i - 1] == cells[i])) return;
    for (uint32_t s = slot_of(cells[i], mask);; s = (s + 1) & mask)
        if (atomicCAS(&table[s].cell, kFree, cells[i]) == kFree) {
            table[s].first = i;
            return;
        }
}

struct Best {  // ascending by (distance, id)
    float distance2[kMaxDeviceNeighbours];
    int32_t id[kMaxDeviceNeighbours];

    __device__ bool before(float d2, int32_t i, int at) const {
        return d2 < distance2[at] || (d2 == distance2[at] && i < id[at]);
    }
    __device__ void add(float d2, int32_t i, int k) {
        if (!before(d2, i, k - 1)) return;
        int at = k - 1;
        for (; at > 0 && before(d2, i, at - 1); --at) distance2[at] = distance2[at - 1], id[at] = id[at - 1];
        distance2[at] = d2, id[at] = i;
    }
};

__global__ void search(const float* queries, uint32_t n, int k, float radius, float inverse, const float4* points,
                       uint32_t count, const unsigned long long* cells, const Slot* table, uint32_t mask,
                       int32_t* ids, float* distance2) {
    const uint32_t q = blockIdx.x * kThreads + threadIdx.x;
    if (q >= n) return;
    const float* p = queries + 3 * static_cast<size_t>(q);
    const float radius2 = radius * radius;
    Best best;
    for (int j = 0; j < k; ++j) best.distance2[j] = INFINITY, best.id[j] = INT32_MAX;
    int low[3], high[3];
    bool inside = count > 0;
    for (int a = 0; a < 3; ++a)
        inside = inside & cell_of(p[a] - radius, inverse, low[a]) & cell_of(p[a] + radius, inverse, high[a]);
    for (int x = low[0]; inside && x <= high[0]; ++x)
        for (int y = low[1]; y <= high[1]; ++y)
            for (int z = low[2]; z <= high[2]; ++z) {
                const unsigned long long cell = pack(x, y, z);
                uint32_t s = slot_of(cell, mask);
                while (table[s].cell != cell && table[s].cell != kFree) s = (s + 1) & mask;
                if (table[s].cell == kFree) continue;
                for (uint32_t i = table[s].first; i < count && cells[i] == cell; ++i) {
                    const float4 other = points[i];
                    const float dx = other.x - p[0], dy = other.y - p[1], dz = other.z - p[2];
                    const float d2 = dx * dx + dy * dy + dz * dz;
                    if (d2 <= radius2) best.add(d2, __float_as_int(other.w), k);
                }
            }
    for (int j = 0; j < k; ++j) {
        const size_t at = static_cast<size_t>(q) * k + j;
        ids[at] = best.id[j] == INT32_MAX ? -1 : best.id[j], distance2[at] = best.distance2[j];
    }
}

uint32_t blocks(size_t items) { return static_cast<uint32_t>((items + kThreads - 1) / kThreads); }

}  // namespace

struct CudaGrid::Memory {
    Buffer cells[2], ids[2], sorted, table, scratch;
    const unsigned long long* cells_in_order = nullptr;
    uint32_t mask = 0;
};

CudaGrid::CudaGrid(int device, float cell_size) : device_(device), inverse_(1.0f / cell_size), memory_(new Memory) {}

CudaGrid::~CudaGrid() {
    int before = 0;
    cudaGetDevice(&before);
    cudaSetDevice(device_);
    memory_.reset();
    cudaSetDevice(before);
}

void CudaGrid::build(const float* points, size_t n, void* stream_pointer) {
    const DeviceGuard guard(device_);
    const auto stream = static_cast<cudaStream_t>(stream_pointer);
    Memory& m = *memory_;
    count_ = n;
    if (n == 0) return;
    const auto count = static_cast<uint32_t>(n);
    cub::DoubleBuffer<unsigned long long> cells(m.cells[0].reserve<unsigned long long>(n),
                                                m.cells[1].reserve<unsigned long long>(n));
    cub::DoubleBuffer<uint32_t> ids(m.ids[0].reserve<uint32_t>(n), m.ids[1].reserve<uint32_t>(n));
    find_cells<<<blocks(n), kThreads, 0, stream>>>(points, count, inverse_, cells.Current(), ids.Current());
    check(cudaGetLastError(), "find_cells");
    size_t bytes = 0;
    check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, cells, ids, count, 0, kKeyBits, stream), "sort");
    void* scratch = m.scratch.reserve<char>(bytes);
    check(cub::DeviceRadixSort::SortPairs(scratch, bytes, cells, ids, count, 0, kKeyBits, stream), "sort");
    size_t slots = 64;
    while (slots < 2 * n) slots *= 2;
    Slot* table = m.table.reserve<Slot>(slots);
    check(cudaMemsetAsync(table, 0xff, slots * sizeof(Slot), stream), "cudaMemsetAsync");
    m.mask = static_cast<uint32_t>(slots - 1), m.cells_in_order = cells.Current();
    place<<<blocks(n), kThreads, 0, stream>>>(points, ids.Current(), count, cells.Current(),
                                              m.sorted.reserve<float4>(n), table, m.mask);
    check(cudaGetLastError(), "place");
}

void CudaGrid::knn(const float* queries, size_t n, int k, float radius, int32_t* ids, float* distance2,
                   void* stream_pointer) const {
    const DeviceGuard guard(device_);
    if (n == 0) return;
    const Memory& m = *memory_;
    search<<<blocks(n), kThreads, 0, static_cast<cudaStream_t>(stream_pointer)>>>(
        queries, static_cast<uint32_t>(n), k, radius, inverse_, m.sorted.get<float4>(), static_cast<uint32_t>(count_),
        m.cells_in_order, m.table.get<Slot>(), m.mask, ids, distance2);
    check(cudaGetLastError(), "search");
}

}  // namespace sf

// SPDX-License-Identifier: Apache-2.0
#include "diffusion.hpp"

#include <cstring>
#include <vector>

#include "simd.hpp"

namespace sf {
namespace {

constexpr uint32_t kNone = UINT32_MAX;

typedef float Float4 __attribute__((vector_size(16)));
typedef double Double4 __attribute__((vector_size(32)));
typedef std::vector<Float4> Values;  // one for each pixel that has links

// A pixel with links: which pixels it is linked to, the conductance of these links, and what all its links sum up to;
// the pivot belongs to the incomplete factors.
struct Pixel {
    uint32_t at, left, right, up, down;
    float to_left, to_right, to_up, to_down, sum, pivot;
};

// The linear system A x = inflow of an image: A = sum of conductances less the conductance to each neighbour.
class System {
  public:
    explicit System(const Linked& l) {
        const size_t w = l.columns;
        std::vector<uint32_t> number(l.rows * w, kNone);
        for (size_t at = 0; at < l.rows * w; ++at) {
            const size_t r = at / w, c = at % w;
            Pixel p{static_cast<uint32_t>(at), kNone, kNone, kNone, kNone, 0, 0, 0, 0, 0, 0};
            if (c > 0) p.to_left = l.right[at - 1];
            if (c + 1 < w) p.to_right = l.right[at];
            if (r > 0) p.to_up = l.down[at - w];
            if (r + 1 < l.rows) p.to_down = l.down[at];
            p.sum = ((p.to_left + p.to_right) + (p.to_up + p.to_down)) + l.ground[at];
            if (p.sum <= 0) continue;
            number[at] = static_cast<uint32_t>(pixels.size());
            pixels.push_back(p);
        }
        for (Pixel& p : pixels) {
            if (p.to_left > 0) p.left = number[p.at - 1];
            if (p.to_right > 0) p.right = number[p.at + 1];
            if (p.to_up > 0) p.up = number[p.at - w];
            if (p.to_down > 0) p.down = number[p.at + w];
            p.pivot = pivot_of(p);
        }
    }

    // out = A x; returns x . out for each channel.
    Double4 apply(const Values& x, Values& out) const {
        Double4 dot = {};
        for (size_t k = 0; k < pixels.size(); ++k) {
            const Pixel& p = pixels[k];
            out[k] = p.sum * x[k] - (before(p, x) + after(p, x));
            dot += wide(x[k]) * wide(out[k]);
        }
        return dot;
    }

    // out = M^-1 r with M of incomplete Cholesky factors; returns r . out for each channel.
    Double4 precondition(const Values& r, Values& out) const {
        for (size_t k = 0; k < pixels.size(); ++k) out[k] = (r[k] + before(pixels[k], out)) / pixels[k].pivot;
        Double4 dot = {};
        for (size_t k = pixels.size(); k-- > 0;) {
            out[k] += after(pixels[k], out) / pixels[k].pivot;
            dot += wide(r[k]) * wide(out[k]);
        }
        return dot;
    }

    std::vector<Pixel> pixels;

  private:
    float pivot_of(const Pixel& p) const {
        float pivot = p.sum;
        if (p.left != kNone) pivot -= p.to_left * p.to_left / pixels[p.left].pivot;
        if (p.up != kNone) pivot -= p.to_up * p.to_up / pixels[p.up].pivot;
        return pivot > 0 ? pivot : p.sum;  // where rounding leaves nothing
    }
    static Double4 wide(const Float4& v) { return __builtin_convertvector(v, Double4); }
    static Float4 before(const Pixel& p, const Values& x) {
        Float4 flow = {};
        if (p.left != kNone) flow += p.to_left * x[p.left];
        if (p.up != kNone) flow += p.to_up * x[p.up];
        return flow;
    }
    static Float4 after(const Pixel& p, const Values& x) {
        Float4 flow = {};
        if (p.right != kNone) flow += p.to_right * x[p.right];
        if (p.down != kNone) flow += p.to_down * x[p.down];
        return flow;
    }
};

// a / b, 0 where b is: a channel that has arrived stays.
Float4 ratio(const Double4& a, const Double4& b) {
    Float4 out = {};
    for (size_t q = 0; q < kChannels; ++q)
        if (b[q] > 0) out[q] = static_cast<float>(a[q] / b[q]);
    return out;
}

}  // namespace

void settle(const Linked& linked, size_t steps, float* values) {
    const System A(linked);
    const size_t count = A.pixels.size();
    Values x(count), r(count), z(count), p(count), Ap(count);
    for (size_t k = 0; k < count; ++k) std::memcpy(&x[k], values + kChannels * A.pixels[k].at, sizeof x[k]);
    A.apply(x, Ap);
    for (size_t k = 0; k < count; ++k) {
        Float4 inflow;
        std::memcpy(&inflow, linked.inflow + kChannels * A.pixels[k].at, sizeof inflow);
        r[k] = inflow - Ap[k];
    }
    Double4 rz = A.precondition(r, z);
    p = z;
    for (size_t step = 0; step < steps; ++step) {
        const Float4 alpha = ratio(rz, A.apply(p, Ap));
        for (size_t k = 0; k < count; ++k) {
            x[k] += alpha * p[k];
            r[k] -= alpha * Ap[k];
        }
        const Double4 next = A.precondition(r, z);
        const Float4 beta = ratio(next, rz);
        for (size_t k = 0; k < count; ++k) p[k] = z[k] + beta * p[k];
        rz = next;
    }
    for (size_t k = 0; k < count; ++k) std::memcpy(values + kChannels * A.pixels[k].at, &x[k], sizeof x[k]);
}

}  // namespace sf

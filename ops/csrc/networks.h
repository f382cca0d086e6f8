// One small network for each Gaussian (E -> H -> C with a ReLU) at B positions; hidden units are the lanes.
// Every weight is read from memory once, whatever the batch.
#pragma once
#include <string.h>

#include "kernels.h"
#include "simd.h"
#include "strips.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> struct NetworkArgs {
    int samples, count, inputs, hidden, outputs, threads;
    const S *encoded, *weight1, *bias1, *weight2, *bias2;  // (B, E), (N, E, H), (N, H), (N, H, C), (N, C)
    NetworkArgs(const Call& call, Reader& in) : threads(call.threads) {
        in.sizes(samples, count, inputs, hidden, outputs);
        in.read(encoded, weight1, bias1, weight2, bias2);
    }
};

constexpr int kNetworkChunk = 64, kSamplesAtOnce = 4;

// Rows of C numbers, n of them, as C rows of n.
template <class S> GSPARC_INLINE void turn_rows(const S* rows, int outputs, S* to) {
    constexpr int n = Lanes<S>::n;
    for (int c = 0; c < outputs; ++c)
        for (int h = 0; h < n; ++h) to[c * n + h] = rows[h * outputs + c];
}
#if defined(__AVX512F__)
template <> GSPARC_INLINE void turn_rows<float>(const float* rows, int outputs, float* to) {
    if (outputs == 1) return _mm512_storeu_ps(to, _mm512_loadu_ps(rows));
    if (outputs == 2) {
        const __m512 a = _mm512_loadu_ps(rows), b = _mm512_loadu_ps(rows + 16);
        const __m512i even = _mm512_set_epi32(30, 28, 26, 24, 22, 20, 18, 16, 14, 12, 10, 8, 6, 4, 2, 0);
        _mm512_storeu_ps(to, _mm512_permutex2var_ps(a, even, b));
        return _mm512_storeu_ps(to + 16, _mm512_permutex2var_ps(a, _mm512_add_epi32(even, _mm512_set1_epi32(1)), b));
    }
    for (int c = 0; c < outputs; ++c)
        for (int h = 0; h < 16; ++h) to[c * 16 + h] = rows[h * outputs + c];
}
#endif

// One Gaussian's weights for a block of lanes of hidden units: first layer, bias, and the second layer by output.
// Lanes past the last hidden unit are zero.
template <class S> struct HiddenBlock {
    const S* first;  // (E, stride)
    int stride;
    Vec<S> bias;
    S* second;       // (C, lanes), in scratch

    GSPARC_INLINE HiddenBlock(const NetworkArgs<S>& a, int64_t i, int hidden, S* scratch) : second(scratch) {
        constexpr int n = Lanes<S>::n;
        const int some = a.hidden - hidden < n ? a.hidden - hidden : n;
        const S* weight2 = a.weight2 + (i * a.hidden + hidden) * a.outputs;
        const S *weight1 = a.weight1 + i * a.inputs * a.hidden + hidden, *bias1 = a.bias1 + i * a.hidden + hidden;
        if (some == n) {
            turn_rows(weight2, a.outputs, second);
            first = weight1, stride = a.hidden, bias = load(bias1);
            return;
        }
        for (int c = 0; c < a.outputs; ++c)
            for (int h = 0; h < n; ++h) second[c * n + h] = h < some ? weight2[h * a.outputs + c] : S(0);
        S* copy = scratch + a.outputs * n;
        S last[n] = {};
        for (int e = 0; e < a.inputs; ++e)
            for (int h = 0; h < n; ++h) copy[e * n + h] = h < some ? weight1[int64_t(e) * a.hidden + h] : S(0);
        memcpy(last, bias1, some * sizeof(S));
        first = copy, stride = n, bias = load(last);
    }
    static int64_t scratch(const NetworkArgs<S>& a) { return int64_t(Lanes<S>::n) * (a.outputs + a.inputs); }
};

template <class S, int kSamples> GSPARC_INLINE void hidden_units(const NetworkArgs<S>& a, const HiddenBlock<S>& block, int sample, Vec<S>* inner) {
    const S* x = a.encoded + int64_t(sample) * a.inputs;
    for (int b = 0; b < kSamples; ++b) inner[b] = block.bias;
    for (int e = 0; e < a.inputs; ++e) {
        const Vec<S> w = load(block.first + int64_t(e) * block.stride);
        for (int b = 0; b < kSamples; ++b) inner[b] = fma(splat(x[b * a.inputs + e]), w, inner[b]);
    }
}

template <class S, int kSamples> GSPARC_INLINE void network_outputs(const NetworkArgs<S>& a, const HiddenBlock<S>& block, int64_t i, int sample, S* out) {
    const Vec<S> none = splat(S(0));
    Vec<S> inner[kSamples];
    hidden_units<S, kSamples>(a, block, sample, inner);
    for (int c = 0; c < a.outputs; ++c) {
        const Vec<S> w = load(block.second + c * Lanes<S>::n);
        for (int b = 0; b < kSamples; ++b) out[(int64_t(sample + b) * a.count + i) * a.outputs + c] += sum<S>(greater<S>(inner[b], none) * w);
    }
}

template <class S> int64_t networks(const Call& call) {
    Reader in(call);
    const NetworkArgs<S> a(call, in);
    S* const out = in.next<S>();  // (B, N, C)
    constexpr int n = Lanes<S>::n;
    const int64_t each = HiddenBlock<S>::scratch(a);
    Buffer<S> memory(each * a.threads);
    auto run = [&](int task, int worker) {
        const int64_t begin = int64_t(task) * kNetworkChunk, end = begin + kNetworkChunk < a.count ? begin + kNetworkChunk : a.count;
        for (int64_t i = begin; i < end; ++i) {
            for (int b = 0; b < a.samples; ++b)
                for (int c = 0; c < a.outputs; ++c) out[(int64_t(b) * a.count + i) * a.outputs + c] = a.bias2[i * a.outputs + c];
            for (int hidden = 0; hidden < a.hidden; hidden += n) {
                const HiddenBlock<S> block(a, i, hidden, memory.data + worker * each);
                int sample = 0;
                for (; sample + kSamplesAtOnce <= a.samples; sample += kSamplesAtOnce) network_outputs<S, kSamplesAtOnce>(a, block, i, sample, out);
                for (; sample < a.samples; ++sample) network_outputs<S, 1>(a, block, i, sample, out);
            }
        }
    };
    parallel_for((a.count + kNetworkChunk - 1) / kNetworkChunk, a.threads, run);
    return 0;
}

template <class S> int64_t networks_backward(const Call& call) {
    Reader in(call);
    const NetworkArgs<S> a(call, in);
    const S* slope_of;              // (B, N, C)
    S *weight1, *bias1, *weight2, *bias2;
    in.read(slope_of, weight1, bias1, weight2, bias2);
    constexpr int n = Lanes<S>::n;
    const int64_t block_size = HiddenBlock<S>::scratch(a), each = block_size + int64_t(n) * (a.inputs + a.outputs);
    Buffer<S> memory(each * a.threads);
    auto run = [&](int task, int worker) {
        S *mine = memory.data + worker * each, *first = mine + block_size, *second = first + int64_t(n) * a.inputs;
        const int64_t begin = int64_t(task) * kNetworkChunk, end = begin + kNetworkChunk < a.count ? begin + kNetworkChunk : a.count;
        for (int64_t i = begin; i < end; ++i) {
            for (int c = 0; c < a.outputs; ++c) {
                S total = 0;
                for (int b = 0; b < a.samples; ++b) total += slope_of[(int64_t(b) * a.count + i) * a.outputs + c];
                bias2[i * a.outputs + c] = total;
            }
            for (int hidden = 0; hidden < a.hidden; hidden += n) {
                const HiddenBlock<S> block(a, i, hidden, mine);
                const int some = a.hidden - hidden < n ? a.hidden - hidden : n;
                Vec<S> bias = splat(S(0));
                fill(first, int64_t(n) * (a.inputs + a.outputs), S(0));
                for (int b = 0; b < a.samples; ++b) {
                    const S *slope = slope_of + (int64_t(b) * a.count + i) * a.outputs, *x = a.encoded + int64_t(b) * a.inputs;
                    Vec<S> inner, back = splat(S(0));
                    hidden_units<S, 1>(a, block, b, &inner);
                    const Mask<S> off = at_most(inner, splat(S(0)));
                    inner = select(off, splat(S(0)), inner);
                    for (int c = 0; c < a.outputs; ++c) {
                        back = fma(splat(slope[c]), load(block.second + c * n), back);
                        store(second + c * n, fma(splat(slope[c]), inner, load(second + c * n)));
                    }
                    back = select(off, splat(S(0)), back);
                    bias += back;
                    for (int e = 0; e < a.inputs; ++e) store(first + e * n, fma(splat(x[e]), back, load(first + e * n)));
                }
                S lanes[n];
                store(lanes, bias);
                memcpy(bias1 + i * a.hidden + hidden, lanes, some * sizeof(S));
                for (int e = 0; e < a.inputs; ++e) memcpy(weight1 + (i * a.inputs + e) * a.hidden + hidden, first + e * n, some * sizeof(S));
                for (int h = 0; h < some; ++h)
                    for (int c = 0; c < a.outputs; ++c) weight2[(i * a.hidden + hidden + h) * a.outputs + c] = second[c * n + h];
            }
        }
    };
    parallel_for((a.count + kNetworkChunk - 1) / kNetworkChunk, a.threads, run);
    return 0;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

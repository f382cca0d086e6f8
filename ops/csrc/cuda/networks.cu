// Emission: one small network (E -> H -> C, ReLU) for each of N Gaussians, evaluated together at B positions.
// A warp holds one Gaussian, a lane one hidden unit; kSamples positions at a time share every weight they read.
#include "cuda/view.h"

namespace gsparc {
namespace GSPARC_ISA {
namespace {

constexpr int kMany = 16;  // positions at a time
#ifdef __CUDACC__
constexpr int64_t kMostRows = 65535;  // of a grid; blocks go on to further positions
#else
constexpr int64_t kMostRows = 2;  // few, so that tests do as well
#endif

struct Networks {
    int samples, count, inputs, hidden, outputs;
    const float *x, *weight1, *bias1, *weight2, *bias2;  // (B, E), (N, E, H), (N, H), (N, H, C), (N, C)
};

// Positions [from, from + kSamples) into shared memory, by input; zeros beyond the batch.
template <int kSamples> __device__ void read_inputs(const Networks& n, int from, float (&x)[kMostInputs][kSamples]) {
    block_sync();
    for (int at = threadIdx.x; at < n.inputs * kSamples; at += kBlock) {
        const int e = at / kSamples, b = at % kSamples;
        x[e][b] = b < n.samples - from ? n.x[int64_t(from + b) * n.inputs + e] : 0.0f;
    }
    block_sync();
}

// What hidden unit h of Gaussian i sees at each position, before the ReLU.
template <int kSamples> __device__ void hidden_unit(const Networks& n, int64_t i, int h, const float (&x)[kMostInputs][kSamples], float (&sums)[kSamples]) {
    const float bias = n.bias1[i * n.hidden + h];
    for (int b = 0; b < kSamples; ++b) sums[b] = bias;
    const float* weight = n.weight1 + i * n.inputs * n.hidden + h;
    GSPARC_UNROLL_BY(4)
    for (int e = 0; e < n.inputs; ++e) {
        const float w = weight[int64_t(e) * n.hidden];
        GSPARC_UNROLL
        for (int b = 0; b < kSamples; ++b) sums[b] = fma(x[e][b], w, sums[b]);
    }
}

template <int kSamples> __global__ void __launch_bounds__(kBlock) networks_kernel(Networks n, float* out) {
    alignas(16) __shared__ float x[kMostInputs][kSamples];
    const int lane = threadIdx.x % kWarp;
    const int64_t i = int64_t(blockIdx.x) * kWarps + threadIdx.x / kWarp;
    for (int64_t start = int64_t(blockIdx.y) * kSamples; start < n.samples; start += int64_t(gridDim.y) * kSamples) {
        const int from = int(start);
        read_inputs(n, from, x);
        if (i >= n.count) continue;  // it only meets at the barriers
        for (int c = 0; c < n.outputs; ++c) {
            float parts[kSamples] = {};
            for (int h = lane; h < n.hidden; h += kWarp) {
                float sums[kSamples];
                hidden_unit(n, i, h, x, sums);
                const float w = n.weight2[(i * n.hidden + h) * n.outputs + c];
                GSPARC_UNROLL
                for (int b = 0; b < kSamples; ++b) parts[b] = fma(sums[b] > 0 ? sums[b] : 0.0f, w, parts[b]);
            }
            const float total = warp_sums(parts) + n.bias2[i * n.outputs + c];
            if (lane < kSamples && lane < n.samples - from) out[(int64_t(from + lane) * n.count + i) * n.outputs + c] = total;
        }
    }
}

struct Derivatives {
    const float* out;                            // (B, N, C)
    float *weight1, *bias1, *weight2, *bias2;    // as in Networks
};

__global__ void __launch_bounds__(kBlock) networks_backward_kernel(Networks n, Derivatives d) {
    alignas(16) __shared__ float x[kMostInputs][kMany];
    const int lane = threadIdx.x % kWarp;
    const int64_t i = int64_t(blockIdx.x) * kWarps + threadIdx.x / kWarp;
    const bool there = i < n.count;  // the others only meet at the barriers
    for (int from = 0; from < n.samples; from += kMany) {
        read_inputs(n, from, x);
        if (!there) continue;
        float up[kMostOutputs][kMany];
        GSPARC_UNROLL
        for (int c = 0; c < kMostOutputs; ++c)
            GSPARC_UNROLL
            for (int b = 0; b < kMany; ++b)
                up[c][b] = c < n.outputs && from + b < n.samples ? d.out[(int64_t(from + b) * n.count + i) * n.outputs + c] : 0.0f;
        for (int h = lane; h < n.hidden; h += kWarp) {
            float sums[kMany], slope[kMany] = {};
            hidden_unit(n, i, h, x, sums);
            GSPARC_UNROLL
            for (int c = 0; c < kMostOutputs; ++c) {
                if (c >= n.outputs) break;
                const int64_t at = (i * n.hidden + h) * n.outputs + c;
                const float w = n.weight2[at];
                float total = from ? d.weight2[at] : 0.0f;
                GSPARC_UNROLL
                for (int b = 0; b < kMany; ++b) {
                    const float here = up[c][b];
                    slope[b] = fma(here, w, slope[b]), total = fma(sums[b] > 0 ? sums[b] : 0.0f, here, total);
                }
                d.weight2[at] = total;
            }
            float bias = from ? d.bias1[i * n.hidden + h] : 0.0f;
            GSPARC_UNROLL
            for (int b = 0; b < kMany; ++b) slope[b] = sums[b] > 0 ? slope[b] : 0.0f, bias += slope[b];
            d.bias1[i * n.hidden + h] = bias;
            for (int e = 0; e < n.inputs; ++e) {
                const int64_t at = (i * n.inputs + e) * n.hidden + h;
                float total = from ? d.weight1[at] : 0.0f;
                GSPARC_UNROLL
                for (int b = 0; b < kMany; ++b) total = fma(x[e][b], slope[b], total);
                d.weight1[at] = total;
            }
        }
        if (lane < n.outputs) {
            float total = from ? d.bias2[i * n.outputs + lane] : 0.0f;
            for (int b = from; b < n.samples && b < from + kMany; ++b) total += d.out[(int64_t(b) * n.count + i) * n.outputs + lane];
            d.bias2[i * n.outputs + lane] = total;
        }
    }
}

Networks read_networks(Reader& in) {
    Networks n;
    in.sizes(n.samples, n.count, n.inputs, n.hidden, n.outputs);
    in.read(n.x, n.weight1, n.bias1, n.weight2, n.bias2);
    return n;
}

}  // namespace
}  // namespace GSPARC_ISA
}  // namespace gsparc

extern "C" {

int64_t gsparc_networks(const gsparc::Call* call) {
    using namespace gsparc::GSPARC_ISA;
    gsparc::Reader in(*call);
    const Networks n = read_networks(in);
    float* out = in.next<float>();
    if (!call->scratch) return 1;
    if (const int64_t error = use_device(call->device)) return -error;
    void* stream = reinterpret_cast<void*>(uintptr_t(call->stream));
    const int64_t blocks = (n.count + kWarps - 1) / kWarps;
    if (n.samples == 1) return -launch(networks_kernel<1>, blocks, 1, kBlock, stream, n, out);
    const int64_t rows = (int64_t(n.samples) + kMany - 1) / kMany;
    return -launch(networks_kernel<kMany>, blocks, int(rows < kMostRows ? rows : kMostRows), kBlock, stream, n, out);
}

int64_t gsparc_networks_backward(const gsparc::Call* call) {
    using namespace gsparc::GSPARC_ISA;
    gsparc::Reader in(*call);
    const Networks n = read_networks(in);
    Derivatives d;
    in.read(d.out, d.weight1, d.bias1, d.weight2, d.bias2);
    if (!call->scratch) return 1;
    if (const int64_t error = use_device(call->device)) return -error;
    void* stream = reinterpret_cast<void*>(uintptr_t(call->stream));
    return -launch(networks_backward_kernel, (n.count + kWarps - 1) / kWarps, 1, kBlock, stream, n, d);
}

}  // extern "C"

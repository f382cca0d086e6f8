// Blending, forward and backward, and each Gaussian's weights. Without atomics: an entry (a Gaussian in a tile)
// has a row of its own for its sums, rows of one Gaussian lie together and are added in their order.
#include "cuda/walk.h"

namespace gsparc {
namespace GSPARC_ISA {
namespace {

constexpr int kThreads = 128;

template <class S> struct Picture {
    const S* features;  // (P, N, K), K channels per pose
    int channels;
    S *image, *transmittance;  // (P, K, H, W), (P, H, W); the second may be absent
};

template <class S> GSPARC_HD int64_t pixels_of(const KernelSettings<S>& settings) { return int64_t(settings.height) * settings.width; }

template <class S, class P, int kChannels>
__global__ void __launch_bounds__(kBlock) composite_kernel(View<S> v, Model<S> model, Picture<S> out) {
    __shared__ Desk<S, kChannels> desk;
    Walk<S, P, kChannels> walk(v, desk, blockIdx.x, threadIdx.x);
    const int from = blockIdx.y * kChannels, used = out.channels - from < kChannels ? out.channels - from : kChannels;
    const bool broken = v.overflows();
    S sums[kChannels] = {};
    while (!broken && walk.base < walk.end) {
        walk.look(model, out.features, out.channels, from, used);
        S light = walk.start;
        if (walk.lit(light))
            for (int j = 0; j < walk.taken; ++j) {
                const S form = walk.form(j);
                if (form < 0 || !walk.lit(light)) continue;
                const Layer<S> layer = walk.layer(j, form);
                const S weight = light * layer.alpha;
                light *= S(1) - layer.alpha;
                GSPARC_UNROLL
                for (int k = 0; k < kChannels; ++k) sums[k] = fma(walk.entry(j).features[k], weight, sums[k]);
            }
        if (!walk.next(light, false)) break;
    }
    static_assert(kChannels <= kBatch<S>, "the sums take the place of the shapes");
    for (int k = 0; k < kChannels; ++k) desk.forms[walk.warp][k][walk.lane] = sums[k];
    block_sync();
    if (!walk.pixel.real) return;
    const int64_t pixels = pixels_of(v.settings), at = walk.pixel.place(v.settings);
    for (int k = walk.warp; k < used; k += kWarps) {
        S total = 0;
        for (int w = 0; w < kWarps; ++w) total += desk.forms[w][k][walk.lane];
        out.image[(int64_t(walk.pose) * out.channels + from + k) * pixels + at] = broken ? S(NAN) : total;
    }
    if (out.transmittance && blockIdx.y == 0 && walk.warp == 0)
        out.transmittance[walk.pose * pixels + at] = broken ? S(NAN) : walk.light;
}

template <class S> struct Upstream {
    const S *image, *transmittance;  // as above; the second may be absent: then the first is 1 everywhere
    const S* per_alpha;              // (P, N), loss by the sum of alpha, lit or not; may be absent
    S* rows;                         // (chunks, capacity, kMoments + kChannels)
};

constexpr int power_of_two(int least) { return least <= 16 ? 16 : 32; }

template <class S, class P, int kChannels>
__global__ void __launch_bounds__(kBlock) backward_kernel(View<S> v, Model<S> model, Picture<S> forward, Upstream<S> up) {
    constexpr int kRow = kMoments + kChannels;
    __shared__ Desk<S, kChannels> desk;
    if (v.overflows()) return;
    Walk<S, P, kChannels> walk(v, desk, blockIdx.x, threadIdx.x);
    const int from = blockIdx.y * kChannels, used = forward.channels - from < kChannels ? forward.channels - from : kChannels;
    const int64_t pixels = pixels_of(v.settings), at = walk.pixel.place(v.settings), row0 = int64_t(blockIdx.y) * v.capacity;
    S g[kChannels] = {}, behind = 0;  // what is still to come of the loss, behind the batch's front
    if (walk.pixel.real) {
        for (int k = 0; k < used; ++k) {
            const int64_t plane = (int64_t(walk.pose) * forward.channels + from + k) * pixels + at;
            g[k] = up.image ? up.image[plane] : S(1);
            behind += g[k] * forward.image[plane];
        }
        if (up.transmittance && blockIdx.y == 0)
            behind += up.transmittance[walk.pose * pixels + at] * forward.transmittance[walk.pose * pixels + at];
    }
    while (walk.base < walk.end) {
        walk.look(model, forward.features, forward.channels, from, used);
        auto gain_of = [&](int j) {
            S gain = 0;
            GSPARC_UNROLL
            for (int k = 0; k < kChannels; ++k) gain = fma(walk.entry(j).features[k], g[k], gain);
            return gain;
        };
        S light = walk.start, spent = 0;
        for (int j = 0; j < walk.taken && walk.lit(light); ++j) {
            if (walk.form(j) < 0) continue;
            const Layer<S> layer = walk.layer(j, walk.form(j));
            spent += light * layer.alpha * gain_of(j);
            light *= S(1) - layer.alpha;
        }
        const S after = light;
        desk.spent[walk.warp][walk.lane] = spent;
        block_sync();
        S rest = behind;
        for (int w = 0; w < kWarps; ++w) {
            if (w == walk.warp) rest = behind;
            behind -= desk.spent[w][walk.lane];
        }
        light = walk.start;
        for (int j = 0; j < walk.taken; ++j) {
            const S per_alpha = up.per_alpha ? up.per_alpha[int64_t(walk.pose) * v.count + walk.entry(j).gaussian] : S(0);
            const bool inside = walk.form(j) >= 0, lit = inside && walk.lit(light), counts = lit || (inside && up.per_alpha);
            S total = 0;
            if (warp_any(counts)) {
                S values[power_of_two(kRow)] = {};
                if (counts) {
                    S tau1, tau2, form;
                    walk.pixel.offsets(walk.entry(j).record, v.settings, tau1, tau2, form);
                    const Layer<S> layer = walk.layer(j, form);
                    const S gain = lit ? gain_of(j) : S(0), weight = light * layer.alpha, through = S(1) - layer.alpha;
                    if (lit) rest -= weight * gain;
                    MomentSums<S, P> sums;
                    sums.add(layer, true, fma(light, gain, per_alpha) + (lit ? -rest / through : S(0)), tau1, tau2, form, walk.alpha_max);
                    sums.write(values);
                    GSPARC_UNROLL
                    for (int k = 0; k < kChannels; ++k) values[kMoments + k] = lit ? weight * g[k] : S(0);
                    if (lit) light *= through;
                }
                total = warp_sums(values);
            }
            if (walk.lane < kRow) up.rows[(row0 + walk.entry(j).slot) * kRow + walk.lane] = total;
        }
        if (!walk.next(after, up.per_alpha != nullptr)) break;
    }
    for (int e = walk.base + walk.warp; e < walk.end; e += kWarps)  // behind the last light
        if (walk.lane < kRow) up.rows[(row0 + v.slot_of[e]) * kRow + walk.lane] = 0;
}

template <class S> struct Weighed {
    S* rows;        // (capacity, 2): sums of alpha T and of alpha over the pixels of a tile; or
    S* blocks;      // (capacity, kWarp): alpha T by pixel, in the order of the entries
    int32_t* ends;  // (tiles,): first entry of a tile that nobody sees
};

template <class S, class P>
__global__ void __launch_bounds__(kBlock) weigh_kernel(View<S> v, Model<S> model, Weighed<S> out) {
    __shared__ Desk<S, 1> desk;
    if (v.overflows()) return;
    Walk<S, P, 1> walk(v, desk, blockIdx.x, threadIdx.x);
    while (walk.base < walk.end) {
        walk.look(model, nullptr, 0, 0, 0);
        S light = walk.start;
        for (int j = 0; j < walk.taken; ++j) {
            S weight = 0, alpha = 0;
            if (walk.form(j) >= 0) {
                const Layer<S> layer = walk.layer(j, walk.form(j));
                alpha = layer.alpha;
                if (walk.lit(light)) weight = light * alpha, light *= S(1) - layer.alpha;
            }
            if (out.blocks) out.blocks[int64_t(walk.first + j) * kWarp + walk.lane] = weight;
            if (!out.rows) continue;
            S values[2] = {weight, alpha};
            const S total = warp_sums(values);
            if (walk.lane < 2) out.rows[int64_t(walk.entry(j).slot) * 2 + walk.lane] = total;
        }
        if (!walk.next(light, out.rows != nullptr)) break;
    }
    if (out.ends && threadIdx.x == 0) out.ends[blockIdx.x] = walk.base;
}

// Adds the rows of each Gaussian: value k of a row goes to first (.., split) or, from split on, to second (.., rest).
// A block takes as many ranks as have room, a thread one value; of int64 divisions there are none: they take longest.
// A list of more than kLong rows is added by the whole block: one thread would keep all others waiting.
#ifdef __CUDACC__
constexpr int64_t kLong = 32;
#else
constexpr int64_t kLong = 4;  // few, so that small images have such lists
#endif
GSPARC_HD int ranks_of_block(int width) { return kThreads / width; }
template <class S>
__global__ void add_rows(View<S> v, const S* rows, int width, int split, S* first, S* second, int rest) {
    __shared__ S parts[kThreads];
    const uint32_t together = ranks_of_block(width), within = threadIdx.x / width, all = uint32_t(v.poses) * v.count;
    const int k = threadIdx.x % width, chunk = blockIdx.y, value = chunk * (width - split) + k - split;
    const bool broken = v.overflows(), takes = within < together && (k < split || value < rest);
    // Every step-th row of a rank, the first of which is `from`.
    auto added = [&](int64_t from, int64_t end, int step) {
        S total = 0;
        GSPARC_UNROLL_BY(4)
        for (int64_t slot = from; slot < end; slot += step) total += rows[(int64_t(chunk) * v.capacity + slot) * width + k];
        return total;
    };
    auto put = [&](uint32_t ranked, S total) {
        const int pose = ranked / v.count, rank = ranked % v.count;
        const int64_t row = int64_t(pose) * v.count + (broken ? rank : v.order[ranked]);
        if (k < split)
            first[(int64_t(chunk) * all + row) * split + k] = total;
        else
            second[row * rest + value] = total;
    };
    struct Span {
        int64_t begin, end;
        GSPARC_HD bool is_long() const { return end - begin > kLong; }
    };
    auto span = [&](uint32_t ranked) -> Span {
        if (broken || ranked >= all) return {0, 0};
        const int pose = ranked / v.count, rank = ranked % v.count;
        return {v.first_slot(pose, rank), v.first_slot(pose, rank + 1)};
    };
    const uint32_t base = blockIdx.x * together, own = base + within;
    const Span mine = span(within < together ? own : all);
    if (takes && own < all && !mine.is_long()) put(own, broken ? S(NAN) : added(mine.begin, mine.end, 1));
    if (!block_any(mine.is_long())) return;
    for (uint32_t ranked = base; ranked < base + together; ++ranked) {
        const Span one = span(ranked);
        if (!one.is_long()) continue;
        if (takes) parts[threadIdx.x] = added(one.begin + within, one.end, together);
        block_sync();
        if (takes && within == 0) {
            S total = 0;
            for (uint32_t w = 0; w < together; ++w) total += parts[w * width + k];
            put(ranked, total);
        }
        block_sync();
    }
}

template <class S> struct Slopes {
    S *means, *quats, *scales, *opacities;
};

constexpr int kSlopes = 11;  // of a mean, a quaternion, three scales and opacity

// Chains the sums (chunks, P, N, kMoments) into slopes (P, N, kSlopes) of the parameters as each pose sees them.
template <class S, class P>
__global__ void chain_kernel(View<S> v, Model<S> model, const S* sums, int chunks, S* slopes, S* screen) {
    const uint32_t row = blockIdx.x * kThreads + threadIdx.x, all = uint32_t(v.poses) * v.count;
    if (row >= all) return;
    const int pose = row / v.count, i = row % v.count;
    const bool broken = v.overflows(), seen = !broken && v.boxes[row].row1 > v.boxes[row].row0;
    S* to = slopes + int64_t(row) * kSlopes;
    if (!seen) {
        for (int k = 0; k < kSlopes; ++k) to[k] = broken ? S(NAN) : S(0);
        if (screen) screen[2 * int64_t(row)] = screen[2 * int64_t(row) + 1] = broken ? S(NAN) : S(0);
        return;
    }
    S m[kMoments] = {};
    for (int chunk = 0; chunk < chunks; ++chunk)
        for (int k = 0; k < kMoments; ++k) m[k] += sums[(int64_t(chunk) * all + row) * kMoments + k];
    const Gaussian<S> g = gaussian(model, i);
    const S* rotation = model.rotations + 9 * pose;
    const Footprint<S> f = project<P>(g, model.positions + 3 * pose, rotation, v.settings);
    const Moments<S> moments = {m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7]};
    const Gradients<S> one = project_backward<P>(f, moments, model.opacities[i], rotation, v.settings);
    for (int k = 0; k < 3; ++k) to[k] = one.mean[k], to[7 + k] = one.scale[k];
    for (int k = 0; k < 4; ++k) to[3 + k] = one.quat[k];
    to[10] = one.opacity;
    if (screen) screen[2 * int64_t(row)] = one.screen[0], screen[2 * int64_t(row) + 1] = one.screen[1];
}

// Adds what the poses see, in their order: a thread holds one parameter of one Gaussian.
template <class S> __global__ void add_poses(View<S> v, const S* slopes, Slopes<S> out) {
    const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x, i = at / kSlopes, k = at % kSlopes;
    if (i >= v.count) return;
    S sum = 0;
    for (int pose = 0; pose < v.poses; ++pose) sum += slopes[(int64_t(pose) * v.count + i) * kSlopes + k];
    if (k < 3) out.means[3 * i + k] = sum;
    else if (k < 7) out.quats[4 * i + k - 3] = sum;
    else if (k < 10) out.scales[3 * i + k - 7] = sum;
    else out.opacities[i] = sum;
}

int64_t blocks_for(int64_t threads) { return (threads + kThreads - 1) / kThreads; }

// Channels that a block blends at once. float64 serves tests and has one size.
template <class S> int width_for(int channels) { return sizeof(S) == 8 ? 4 : (channels <= 1 ? 1 : (channels <= 4 ? 4 : 16)); }
int chunks_for(int channels, int width) { return channels > width ? (channels + width - 1) / width : 1; }

template <class S, class P> auto composite_of(int width) {
    if constexpr (sizeof(S) == 8) return composite_kernel<S, P, 4>;
    else return width == 1 ? composite_kernel<S, P, 1> : width == 4 ? composite_kernel<S, P, 4> : composite_kernel<S, P, 16>;
}
template <class S, class P> auto backward_of(int width) {
    if constexpr (sizeof(S) == 8) return backward_kernel<S, P, 4>;
    else return width == 1 ? backward_kernel<S, P, 1> : width == 4 ? backward_kernel<S, P, 4> : backward_kernel<S, P, 16>;
}

template <class S> int64_t blend(const View<S>& v, const Model<S>& model, const Picture<S>& picture, void* stream) {
    const int width = width_for<S>(picture.channels), chunks = chunks_for(picture.channels, width);
    const auto kernel = with_projection(v.settings.projection, [&](auto p) { return composite_of<S, decltype(p)>(width); });
    return launch(kernel, int64_t(v.poses) * v.tiles, chunks, kBlock, stream, v, model, picture);
}

template <class S>
int64_t add(const View<S>& v, int chunks, void* stream, const S* rows, int width, int split, S* first, S* second, int rest) {
    const int64_t together = ranks_of_block(width), all = int64_t(v.poses) * v.count;
    return launch(add_rows<S>, (all + together - 1) / together, chunks, kThreads, stream, v, rows, width, split, first, second, rest);
}

template <class S> int64_t composite(const Call& call) {
    Reader in(call);
    const View<S> v = read_view<S>(call, in);
    const Model<S> model = read_model<S>(in);
    Picture<S> out;
    in.sizes(out.channels);
    in.read(out.features, out.image, out.transmittance);
    if (!call.scratch) return 1;
    return -blend(v, model, out, reinterpret_cast<void*>(uintptr_t(call.stream)));
}

// Backward of `composite`, or, where `weights`, of the weights: then features are the slopes of the sums of
// alpha T, and the image they make is the total that the pass runs down from.
template <class S> int64_t backward(const Call& call, bool weights) {
    Reader in(call);
    const View<S> v = read_view<S>(call, in);
    const Model<S> model = read_model<S>(in);
    Picture<S> forward{};
    Upstream<S> up{};
    in.sizes(forward.channels);
    if (weights) in.read(forward.features, up.per_alpha);
    else in.read(forward.features, forward.image, forward.transmittance, up.image, up.transmittance);
    Slopes<S> out;
    in.read(out.means, out.quats, out.scales, out.opacities);
    S *features = nullptr, *screen = nullptr;
    if (!weights) in.read(features, screen);  // (P, N, K), (P, N, 2)

    const int64_t all = int64_t(v.poses) * v.count;
    const int width = width_for<S>(forward.channels), chunks = chunks_for(forward.channels, width), row = kMoments + width;
    Arena arena(reinterpret_cast<void*>(uintptr_t(call.scratch)));
    up.rows = arena.take<S>(int64_t(chunks) * v.capacity * row);
    S *sums = arena.take<S>(int64_t(chunks) * all * kMoments), *slopes = arena.take<S>(all * kSlopes);
    if (weights) forward.image = arena.take<S>(v.poses * pixels_of(v.settings));
    if (arena.measuring()) return arena.bytes();

    void* stream = reinterpret_cast<void*>(uintptr_t(call.stream));
    Steps steps;
    if (weights) steps.then([&] { return blend(v, model, forward, stream); });
    const auto kernel = with_projection(v.settings.projection, [&](auto p) { return backward_of<S, decltype(p)>(width); });
    const auto chain = with_projection(v.settings.projection, [](auto p) { return chain_kernel<S, decltype(p)>; });
    steps.then([&] { return launch(kernel, int64_t(v.poses) * v.tiles, chunks, kBlock, stream, v, model, forward, up); });
    steps.then([&] { return add<S>(v, chunks, stream, up.rows, row, kMoments, sums, features, weights ? 0 : forward.channels); });
    steps.then([&] { return launch(chain, blocks_for(all), 1, kThreads, stream, v, model, sums, chunks, slopes, screen); });
    steps.then([&] { return launch(add_poses<S>, blocks_for(int64_t(v.count) * kSlopes), 1, kThreads, stream, v, slopes, out); });
    return steps.result();
}

template <class S> int64_t weigh(const Call& call) {
    Reader in(call);
    const View<S> v = read_view<S>(call, in);
    const Model<S> model = read_model<S>(in);
    Weighed<S> out{};
    S* sums;  // (P, N, 2), or absent for blocks
    in.read(sums, out.blocks, out.ends);
    Arena arena(reinterpret_cast<void*>(uintptr_t(call.scratch)));
    if (sums) out.rows = arena.take<S>(int64_t(v.capacity) * 2);
    if (arena.measuring()) return arena.bytes();

    void* stream = reinterpret_cast<void*>(uintptr_t(call.stream));
    Steps steps;
    const auto kernel = with_projection(v.settings.projection, [](auto p) { return weigh_kernel<S, decltype(p)>; });
    steps.then([&] { return launch(kernel, int64_t(v.poses) * v.tiles, 1, kBlock, stream, v, model, out); });
    if (sums)
        steps.then([&] { return add<S>(v, 1, stream, out.rows, 2, 2, sums, nullptr, 0); });
    return steps.result();
}

}  // namespace
}  // namespace GSPARC_ISA
}  // namespace gsparc

GSPARC_ENTRY(composite, composite<S>(call))
GSPARC_ENTRY(composite_backward, backward<S>(call, false))
GSPARC_ENTRY(weights, weigh<S>(call))
GSPARC_ENTRY(weights_backward, backward<S>(call, true))

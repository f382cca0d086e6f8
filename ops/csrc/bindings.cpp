// The Python face of the kernels. Tensors arrive as addresses: cpu_kernels.py and its like, the only callers, have checked
// shape, dtype and contiguity, and keep them alive. An address of 0 is an absent tensor.
#include <nanobind/nanobind.h>
#include <nanobind/stl/vector.h>

#include <vector>

#include "plan.h"

namespace nb = nanobind;
using namespace gsparc;

// Python's `KernelSettings`, read by the names of its fields.
template <> struct nb::detail::type_caster<KernelSettings<double>> {
    NB_TYPE_CASTER(KernelSettings<double>, const_name("KernelSettings"))
    bool from_python(handle from, uint8_t, cleanup_list*) {
        using S = double;
#define X(type, name) value.name = nb::cast<type>(from.attr(#name));
        GSPARC_SETTINGS(X)
#undef X
        return true;
    }
};

namespace {

using Addresses = std::vector<uint64_t>;
using Settings = KernelSettings<double>;
using Ints = std::vector<int>;
using Reals = std::vector<double>;

int strips_of(int height) { return (height + kStripRows - 1) / kStripRows; }

template <class S> PlanView<S> read_plan(Reader& in, int poses, int count, int height) {
    PlanView<S> p;
    p.poses = poses, p.count = count, p.strips = strips_of(height);
    in.read(p.records, p.boxes, p.order, p.shown, p.slots, p.strip_starts, p.entries);
    return p;
}

// Calls run(S(), reader of the tensors) with S double or float, without holding Python's lock.
template <class F> auto with_scalar(bool twice, const Addresses& tensors, F run) {
    nb::gil_scoped_release unlocked;
    Reader in{tensors.data(), tensors.data() + tensors.size()};
    return twice ? run(double(), in) : run(float(), in);
}

int64_t plan(bool twice, int poses, int count, int threads, const Settings& settings, const Addresses& tensors) {
    return with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        PlanArgs<S> a;
        a.model = read_model<S>(in);
        a.poses = poses, a.count = count, a.strips = strips_of(settings.height), a.threads = threads;
        a.settings = in_precision<S>(settings);
        in.read(a.ids, a.records, a.boxes, a.order, a.shown, a.slots, a.strip_starts, a.means2d, a.radii, a.visible);
        return make_plan(a);
    });
}

void entries(bool twice, int poses, int count, int threads, int height, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        const auto view = read_plan<decltype(zero)>(in, poses, count, height);
        fill_entries(view, threads, const_cast<int32_t*>(view.entries));
    });
}

template <class S>
CompositeArgs<S> read_composite(Reader& in, int poses, int count, int threads, int samples, int channels, const Settings& settings) {
    CompositeArgs<S> a;
    a.plan = read_plan<S>(in, poses, count, settings.height);
    a.model = read_model<S>(in);
    a.settings = in_precision<S>(settings);
    a.samples = samples, a.channels = channels, a.threads = threads;
    in.read(a.features, a.image, a.transmittance);
    return a;
}

void composite(bool twice, int poses, int count, int threads, int samples, int channels, const Settings& settings, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        kernels<S>().composite(read_composite<S>(in, poses, count, threads, samples, channels, settings));
    });
}

void composite_backward(bool twice, int poses, int count, int threads, int samples, int channels, const Settings& settings, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        CompositeBackwardArgs<S> b;
        b.forward = read_composite<S>(in, poses, count, threads, samples, channels, settings);
        in.read(b.grad_image, b.grad_transmittance);
        in.read(b.means, b.quats, b.scales, b.opacities, b.extinctions, b.features, b.screen);
        kernels<S>().composite_backward(b);
    });
}

template <class S> WeightArgs<S> read_weights(Reader& in, int poses, int count, int threads, const Settings& settings) {
    WeightArgs<S> a;
    a.plan = read_plan<S>(in, poses, count, settings.height);
    a.model = read_model<S>(in);
    a.settings = in_precision<S>(settings);
    a.threads = threads;
    in.read(a.visible_sum, a.total);
    return a;
}

void weights(bool twice, int poses, int count, int threads, const Settings& settings, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        kernels<S>().weights(read_weights<S>(in, poses, count, threads, settings));
    });
}

void weights_backward(bool twice, int poses, int count, int threads, const Settings& settings, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        WeightBackwardArgs<S> b;
        b.forward = read_weights<S>(in, poses, count, threads, settings);
        in.read(b.grad_visible_sum, b.grad_total, b.means, b.quats, b.scales, b.opacities, b.extinctions);
        kernels<S>().weights_backward(b);
    });
}

int freeze(bool twice, int count, int threads, const Settings& settings, const Addresses& tensors) {
    return with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        FreezeArgs<S> a;
        a.plan = read_plan<S>(in, 1, count, settings.height);
        a.model = read_model<S>(in);
        a.settings = in_precision<S>(settings);
        a.threads = threads;
        in.read(a.starts, a.heads, a.weights);
        return kernels<S>().freeze(a);
    });
}

void thaw(bool twice, int channels, int height, int width, int threads, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        ThawArgs<S> a;
        a.height = height, a.width = width, a.channels = channels, a.threads = threads;
        in.read(a.starts, a.heads, a.weights, a.features, a.image);
        kernels<S>().thaw(a);
    });
}

template <class S> NetworkArgs<S> read_networks(Reader& in, const Ints& sizes, int threads) {
    NetworkArgs<S> a;
    a.samples = sizes.at(0), a.count = sizes.at(1), a.inputs = sizes.at(2), a.hidden = sizes.at(3), a.outputs = sizes.at(4);
    a.threads = threads;
    in.read(a.encoded, a.weight1, a.bias1, a.weight2, a.bias2, a.out);
    return a;
}

void networks(bool twice, const Ints& sizes, int threads, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        kernels<S>().networks(read_networks<S>(in, sizes, threads));
    });
}

void networks_backward(bool twice, const Ints& sizes, int threads, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        NetworkBackwardArgs<S> b;
        b.forward = read_networks<S>(in, sizes, threads);
        in.read(b.slope, b.weight1, b.bias1, b.weight2, b.bias2);
        kernels<S>().networks_backward(b);
    });
}

void similarity(const Ints& sizes, const Reals& stability, int threads, const Addresses& tensors) {
    with_scalar(false, tensors, [&](auto, Reader& in) {
        SimilarityArgs a;
        a.count = sizes.at(0), a.height = sizes.at(1), a.width = sizes.at(2), a.radius = sizes.at(3), a.threads = threads;
        a.c1 = float(stability.at(0)), a.c2 = float(stability.at(1));
        in.read(a.taps, a.prediction, a.target, a.value, a.slope);
        kernels<float>().similarity(a);
    });
}

template <class S> ChannelArgs<S> read_channels(Reader& in, const Ints& sizes, const Reals& tones, int threads) {
    ChannelArgs<S> a;
    a.samples = sizes.at(0), a.count = sizes.at(1), a.antennas = sizes.at(2), a.subcarriers = sizes.at(3), a.threads = threads;
    a.first = tones.at(0), a.step = tones.at(1);
    in.read(a.gains, a.steering, a.delays, a.out);
    return a;
}

void channels(bool twice, const Ints& sizes, const Reals& tones, int threads, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        kernels<S>().channels(read_channels<S>(in, sizes, tones, threads));
    });
}

void channels_backward(bool twice, const Ints& sizes, const Reals& tones, int threads, const Addresses& tensors) {
    with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        ChannelBackwardArgs<S> b;
        b.forward = read_channels<S>(in, sizes, tones, threads);
        in.read(b.slope, b.gains, b.steering, b.delays);
        kernels<S>().channels_backward(b);
    });
}

// Exponentials accumulated by `tasks` tasks of the roofline.
int64_t mark_exponentials(int tasks, int threads) {
    nb::gil_scoped_release unlocked;
    std::vector<float> sums(tasks);
    kernels<float>().mark_exponentials(tasks, threads, sums.data());
    return int64_t(tasks) * kMarkPairs;
}

void mark_copy(uintptr_t from, uintptr_t to, int64_t bytes, int threads) {
    nb::gil_scoped_release unlocked;
    kernels<float>().mark_copy(reinterpret_cast<const char*>(from), reinterpret_cast<char*>(to), bytes, threads);
}

int64_t mark_pairs(bool twice, int poses, int count, int threads, const Settings& settings, const Addresses& tensors) {
    return with_scalar(twice, tensors, [&](auto zero, Reader& in) {
        using S = decltype(zero);
        return kernels<S>().mark_pairs(read_plan<S>(in, poses, count, settings.height), in_precision<S>(settings), threads);
    });
}

}  // namespace

NB_MODULE(_native, module) {
    module.doc() = "GSpaRC CPU kernels; see cpu_kernels.py for their arguments";
    module.attr("RECORD") = kRecord;
    module.attr("MOMENTS") = kMoments;
    module.attr("STRIP_ROWS") = kStripRows;
    module.attr("UNSOUND_POSE") = kUnsoundPose;
    module.attr("TILE_WIDTH") = kTileWidth;
    module.attr("TILE_HEIGHT") = kTileHeight;
    module.attr("SIMILARITY_WIDTH") = kSimilarityWidth;
    module.attr("SIMILARITY_HEIGHT") = kSimilarityHeight;
    module.attr("MOST_RADIUS") = kMostRadius;
    module.attr("MOST_INPUTS") = kMostInputs;
    module.attr("MOST_OUTPUTS") = kMostOutputs;
    module.def("plan", &plan);
    module.def("entries", &entries);
    module.def("composite", &composite);
    module.def("composite_backward", &composite_backward);
    module.def("weights", &weights);
    module.def("weights_backward", &weights_backward);
    module.def("freeze", &freeze);
    module.def("thaw", &thaw);
    module.def("networks", &networks);
    module.def("networks_backward", &networks_backward);
    module.def("similarity", &similarity);
    module.def("channels", &channels);
    module.def("channels_backward", &channels_backward);
    module.def("mark_exponentials", &mark_exponentials);
    module.def("mark_copy", &mark_copy);
    module.def("mark_pairs", &mark_pairs);
    module.def("instruction_set", &instruction_set);
    module.def("use_instruction_set", &use_instruction_set);
}

// The Python face of the kernels. Tensors arrive as addresses: cpu_kernels.py and its like, the only callers, have checked
// shape, dtype and contiguity, and keep them alive. An address of 0 is an absent tensor.
#include <nanobind/nanobind.h>
#include <nanobind/stl/vector.h>

#include <vector>

#include "plan.h"

namespace nb = nanobind;
using namespace gsparc;

namespace {

using Addresses = std::vector<uintptr_t>;

template <class S> Lens<S> lens_from(const std::vector<int>& whole, const std::vector<double>& real) {
    return {whole[0], whole[1], whole[2] != 0, whole[3] != 0, whole[4] != 0, whole[5] != 0,
            S(real[0]), S(real[1]), S(real[2]), S(real[3]),
            S(real[4]), S(real[5]), S(real[6]), S(real[7]), S(real[8]), S(real[9])};
}

// Reads addresses one after the other.
struct Reader {
    const Addresses& all;
    size_t at = 0;
    template <class T> T* next() { return reinterpret_cast<T*>(all.at(at++)); }
};

template <class S> Model<S> read_model(Reader& in) {
    Model<S> m;
    m.means = in.next<const S>(), m.quats = in.next<const S>(), m.scales = in.next<const S>();
    m.opacities = in.next<const S>(), m.extinctions = in.next<const S>();
    m.positions = in.next<const S>(), m.rotations = in.next<const S>();
    return m;
}

int strips_of(int height) { return (height + kStripRows - 1) / kStripRows; }

template <class S> PlanView<S> read_plan(Reader& in, int poses, int count, int height) {
    PlanView<S> p;
    p.poses = poses, p.count = count, p.strips = strips_of(height);
    p.records = in.next<const S>(), p.boxes = in.next<const Box>();
    p.order = in.next<const int32_t>(), p.shown = in.next<const int32_t>();
    p.slots = in.next<const int64_t>(), p.strip_starts = in.next<const int64_t>();
    p.entries = in.next<const int32_t>();
    return p;
}

// Calls run(S()) with S double or float, without holding Python's lock.
template <class F> auto with_scalar(bool twice, F run) {
    nb::gil_scoped_release unlocked;
    return twice ? run(double()) : run(float());
}

using Ints = std::vector<int>;
using Reals = std::vector<double>;

int64_t plan(bool twice, int poses, int count, int threads, const Ints& whole, const Reals& real, const Addresses& tensors) {
    return with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        PlanArgs<S> a;
        a.model = read_model<S>(in);
        a.ids = in.next<const int64_t>();
        a.poses = poses, a.count = count, a.strips = strips_of(whole[0]), a.threads = threads;
        a.lens = lens_from<S>(whole, real);
        a.records = in.next<S>(), a.boxes = in.next<Box>(), a.order = in.next<int32_t>(), a.shown = in.next<int32_t>();
        a.slots = in.next<int64_t>(), a.strip_starts = in.next<int64_t>();
        a.means2d = in.next<S>(), a.radii = in.next<S>(), a.visible = in.next<bool>();
        return make_plan(a);
    });
}

void entries(bool twice, int poses, int count, int threads, int height, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        const PlanView<S> view = read_plan<S>(in, poses, count, height);
        fill_entries(view, threads, const_cast<int32_t*>(view.entries));
    });
}

template <class S>
CompositeArgs<S> read_composite(Reader& in, int poses, int count, int samples, int channels, int threads, const Ints& whole, const Reals& real) {
    CompositeArgs<S> a;
    a.plan = read_plan<S>(in, poses, count, whole[0]);
    a.model = read_model<S>(in);
    a.lens = lens_from<S>(whole, real);
    a.samples = samples, a.channels = channels, a.threads = threads;
    a.features = in.next<const S>(), a.image = in.next<S>(), a.transmittance = in.next<S>();
    return a;
}

void composite(bool twice, int poses, int count, int samples, int channels, int threads, const Ints& whole, const Reals& real, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        kernels<S>().composite(read_composite<S>(in, poses, count, samples, channels, threads, whole, real));
    });
}

void composite_backward(bool twice, int poses, int count, int samples, int channels, int threads, const Ints& whole, const Reals& real, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        CompositeBackwardArgs<S> b;
        b.forward = read_composite<S>(in, poses, count, samples, channels, threads, whole, real);
        b.grad_image = in.next<const S>(), b.grad_transmittance = in.next<const S>();
        b.means = in.next<S>(), b.quats = in.next<S>(), b.scales = in.next<S>(), b.opacities = in.next<S>();
        b.extinctions = in.next<S>(), b.features = in.next<S>(), b.screen = in.next<S>();
        kernels<S>().composite_backward(b);
    });
}

template <class S> WeightArgs<S> read_weights(Reader& in, int poses, int count, int threads, const Ints& whole, const Reals& real) {
    WeightArgs<S> a;
    a.plan = read_plan<S>(in, poses, count, whole[0]);
    a.model = read_model<S>(in);
    a.lens = lens_from<S>(whole, real);
    a.threads = threads;
    a.visible_sum = in.next<S>(), a.total = in.next<S>();
    return a;
}

void weights(bool twice, int poses, int count, int threads, const Ints& whole, const Reals& real, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        kernels<S>().weights(read_weights<S>(in, poses, count, threads, whole, real));
    });
}

void weights_backward(bool twice, int poses, int count, int threads, const Ints& whole, const Reals& real, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        WeightBackwardArgs<S> b;
        b.forward = read_weights<S>(in, poses, count, threads, whole, real);
        b.grad_visible_sum = in.next<const S>(), b.grad_total = in.next<const S>();
        b.means = in.next<S>(), b.quats = in.next<S>(), b.scales = in.next<S>(), b.opacities = in.next<S>();
        b.extinctions = in.next<S>();
        kernels<S>().weights_backward(b);
    });
}

int freeze(bool twice, int count, int threads, const Ints& whole, const Reals& real, const Addresses& tensors) {
    return with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        FreezeArgs<S> a;
        a.plan = read_plan<S>(in, 1, count, whole[0]);
        a.model = read_model<S>(in);
        a.lens = lens_from<S>(whole, real);
        a.threads = threads;
        a.starts = in.next<int64_t>(), a.heads = in.next<int32_t>(), a.weights = in.next<S>();
        return kernels<S>().freeze(a);
    });
}

void thaw(bool twice, int height, int width, int channels, int threads, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        ThawArgs<S> a;
        a.height = height, a.width = width, a.channels = channels, a.threads = threads;
        a.starts = in.next<const int64_t>(), a.heads = in.next<const int32_t>();
        a.weights = in.next<const S>(), a.features = in.next<const S>(), a.image = in.next<S>();
        kernels<S>().thaw(a);
    });
}

template <class S> NetworkArgs<S> read_networks(Reader& in, const Ints& sizes, int threads) {
    NetworkArgs<S> a;
    a.samples = sizes.at(0), a.count = sizes.at(1), a.inputs = sizes.at(2), a.hidden = sizes.at(3), a.outputs = sizes.at(4);
    a.threads = threads;
    a.encoded = in.next<const S>(), a.weight1 = in.next<const S>(), a.bias1 = in.next<const S>();
    a.weight2 = in.next<const S>(), a.bias2 = in.next<const S>(), a.out = in.next<S>();
    return a;
}

void networks(bool twice, const Ints& sizes, int threads, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        kernels<S>().networks(read_networks<S>(in, sizes, threads));
    });
}

void networks_backward(bool twice, const Ints& sizes, int threads, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        NetworkBackwardArgs<S> b;
        b.forward = read_networks<S>(in, sizes, threads);
        b.slope = in.next<const S>();
        b.weight1 = in.next<S>(), b.bias1 = in.next<S>(), b.weight2 = in.next<S>(), b.bias2 = in.next<S>();
        kernels<S>().networks_backward(b);
    });
}

void similarity(const Ints& sizes, const Reals& stability, int threads, const Addresses& tensors) {
    nb::gil_scoped_release unlocked;
    Reader in{tensors};
    SimilarityArgs a;
    a.count = sizes.at(0), a.height = sizes.at(1), a.width = sizes.at(2), a.radius = sizes.at(3), a.threads = threads;
    a.c1 = float(stability.at(0)), a.c2 = float(stability.at(1));
    a.taps = in.next<const float>(), a.prediction = in.next<const float>(), a.target = in.next<const float>();
    a.value = in.next<float>(), a.slope = in.next<float>();
    kernels<float>().similarity(a);
}

template <class S> ChannelArgs<S> read_channels(Reader& in, const Ints& sizes, const Reals& tones, int threads) {
    ChannelArgs<S> a;
    a.samples = sizes.at(0), a.count = sizes.at(1), a.antennas = sizes.at(2), a.subcarriers = sizes.at(3), a.threads = threads;
    a.first = tones.at(0), a.step = tones.at(1);
    a.gains = in.next<const S>(), a.steering = in.next<const S>(), a.delays = in.next<const double>(), a.out = in.next<S>();
    return a;
}

void channels(bool twice, const Ints& sizes, const Reals& tones, int threads, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        kernels<S>().channels(read_channels<S>(in, sizes, tones, threads));
    });
}

void channels_backward(bool twice, const Ints& sizes, const Reals& tones, int threads, const Addresses& tensors) {
    with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        ChannelBackwardArgs<S> b;
        b.forward = read_channels<S>(in, sizes, tones, threads);
        b.slope = in.next<const S>(), b.gains = in.next<S>(), b.steering = in.next<S>(), b.delays = in.next<double>();
        kernels<S>().channels_backward(b);
    });
}

// Exponentials accumulated by `tasks` tasks of the yardstick.
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

int64_t mark_pairs(bool twice, int poses, int count, int threads, const Ints& whole, const Reals& real, const Addresses& tensors) {
    return with_scalar(twice, [&](auto zero) {
        using S = decltype(zero);
        Reader in{tensors};
        return kernels<S>().mark_pairs(read_plan<S>(in, poses, count, whole[0]), lens_from<S>(whole, real), threads);
    });
}

}  // namespace

NB_MODULE(_native, module) {
    module.doc() = "GSpaRC CPU kernels; see cpu_kernels.py for their arguments";
    module.attr("RECORD") = kRecord;
    module.attr("MOMENTS") = kMoments;
    module.attr("STRIP_ROWS") = kStripRows;
    module.attr("UNSOUND_POSE") = kUnsoundPose;
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

// A block of kWarps warps walks down the list of a tile, front to back. The list is cut into as many pieces as
// there are warps, kBatch entries each at most: all warps evaluate their piece at once (`look`), learn from the
// products of the pieces before theirs how much light reaches it, and only then blend. Splitting the depth keeps
// the GPU busy with one small image, and a shape is evaluated once, whatever the number of channels.
#pragma once
#include "cuda/view.h"

namespace gsparc {
namespace GSPARC_ISA {

template <class S> constexpr int kBatch = sizeof(S) == 4 ? 32 : 16;  // entries a warp takes at a time

// What one instruction moves.
template <class S> struct alignas(16) Quarter {
    S numbers[16 / sizeof(S)];
};

template <class S, int kChannels> struct alignas(16) Staged {
    S record[kRecord];
    S opacity, features[kChannels + 1 + (kChannels == 16)];  // one or two to spare, see below
    int32_t slot, gaussian;
};
// Lanes fill an entry each: an odd number of quarters from one to the next spreads them over the banks.
static_assert(sizeof(Staged<float, 1>) / 16 % 2 && sizeof(Staged<float, 4>) / 16 % 2 && sizeof(Staged<float, 16>) / 16 % 2, "banks");

// What the warps of a block leave for each other.
template <class S, int kChannels> struct Desk {
    Staged<S, kChannels> staged[kWarps][kBatch<S>];
    S forms[kWarps][kBatch<S>][kWarp];  // exponent of the shape, -1 outside
    S through[kWarps][kWarp], after[kWarps][kWarp], spent[kWarps][kWarp];
};

template <class S, class P, int kChannels> struct Walk {
    using Shared = Desk<S, kChannels>;

    const View<S>& v;
    Shared& desk;
    const int warp, lane, pose;
    const Pixel<S, P> pixel;
    const S floor, alpha_max;
    int base, end, first = 0, taken = 0, per = 0;
    S light = 1, start = 1;  // before the batch of all warps, and before this warp's piece

    GSPARC_HD Walk(const View<S>& view, Shared& shared, int block, int thread)
        : v(view), desk(shared), warp(thread / kWarp), lane(thread % kWarp), pose(block / view.tiles),
          pixel(view, block % view.tiles / view.tiles_x, block % view.tiles % view.tiles_x, thread % kWarp), floor(view.settings.transmittance_min), alpha_max(view.settings.alpha_max),
          base(view.starts[block]), end(view.starts[block + 1]) {}

    GSPARC_HD bool lit(S before) const { return pixel.real && floor <= before; }
    GSPARC_HD const Staged<S, kChannels>& entry(int j) const { return desk.staged[warp][j]; }
    GSPARC_HD S form(int j) const { return desk.forms[warp][j][lane]; }
    GSPARC_HD Layer<S> layer(int j, S form) const { return {form, true, entry(j).opacity, alpha_max}; }

    // Fetches this warp's piece and evaluates it. features: (P, N, channels), of which `used` from `from` on.
    __device__ void look(const Model<S>& model, const S* features, int channels, int from, int used) {
        const int left = end - base, even = (left + kWarps - 1) / kWarps;
        per = even < kBatch<S> ? even : kBatch<S>;
        first = base + warp * per;
        taken = end - first < per ? end - first : per;
        taken = taken > 0 ? taken : 0;
        if (lane < taken) {
            Staged<S, kChannels>& to = desk.staged[warp][lane];
            const int32_t i = v.gaussians[first + lane];
            const int64_t row = int64_t(pose) * v.count + i;
            const Quarter<S>* record = reinterpret_cast<const Quarter<S>*>(v.records + row * kRecord);
            Quarter<S>* copy = reinterpret_cast<Quarter<S>*>(to.record);
            for (int k = 0; k < int(kRecord * sizeof(S) / sizeof(Quarter<S>)); ++k) copy[k] = record[k];
            to.opacity = to.record[kGain] * model.opacities[i];
            for (int k = 0; k < kChannels; ++k) to.features[k] = k < used ? features[row * channels + from + k] : S(0);
            to.slot = v.slot_of[first + lane], to.gaussian = i;
        }
        warp_sync();
        S product = 1;
        for (int j = 0; j < taken; ++j) {
            S tau1, tau2, form;
            const bool inside = pixel.offsets(entry(j).record, v.settings, tau1, tau2, form);
            if (inside) product *= S(1) - layer(j, form).alpha;
            desk.forms[warp][j][lane] = inside ? form : S(-1);
        }
        desk.through[warp][lane] = product;
        block_sync();
        start = light;
        for (int w = 0; w < warp; ++w) start *= desk.through[w][lane];
    }

    // Leaves the light behind this warp's piece and goes on behind the batch; false where nobody sees further.
    __device__ bool next(S after, bool to_the_end) {
        desk.after[warp][lane] = after;
        block_sync();
        S before = light, behind = desk.after[0][lane];
        for (int w = 1; w < kWarps; ++w) {
            before *= desk.through[w - 1][lane];
            if (floor <= before) behind = desk.after[w][lane];
        }
        light = behind;
        base += per * kWarps;
        base = base < end ? base : end;
        return block_any(lit(light)) || to_the_end;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

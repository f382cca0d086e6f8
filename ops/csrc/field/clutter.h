// Boxes and finite mirrors between a place and a static end, as `gsparc/models/image_sources/clutter` has them.
#pragma once
#include <math.h>

#include "blob.h"

namespace gsparc {
namespace GSPARC_ISA {

struct Clutter {
    static constexpr int kMostSteps = 8, kStep = 9, kBox = 7, kPatch = 16;  // reflections; numbers of each
    static constexpr float kMargin = 0.03f, kSoft = 0.02f, kEdge = 1e-6f, kParallel = 1e-9f, kNone = -2;
    int variants, steps, boxes, patches;
    // Legs that end on plane `kNone` are of other searches, whose paths are longer: near a box they would hide.
    // Boxes and patches begin with the number of their search. A patch: its plane, corners, normal, offset, tangents.
    const float *still, *legs, *box, *patch;

    void read(const Blob& blob, int sources) {
        if (steps > kMostSteps || !variants) refuse("paths of %d reflections, %d orders", steps, variants);
        blob.read("still", still, 3);
        blob.read("legs", legs, int64_t(sources) * variants * (1 + kStep * steps));
        blob.read("boxes", box, int64_t(boxes) * kBox);
        blob.read("patches", patch, int64_t(patches) * kPatch);
    }

    // Share of a search's source that reaches a place in the frame of the fit.
    float share(int source, int search, const float* place) const {
        float points[kMostSteps + 2][3], planes[kMostSteps + 1];
        bool valid = false;
        // The first order whose planes are met one after the other; else the first again.
        for (int v = 0; !valid && v <= variants; ++v) valid = trace(source, v % variants, place, points, planes);
        float seen = 1;
        for (int b = 0; valid && b < boxes; ++b)
            if (box[b * kBox] == float(search)) seen *= past_box(box + b * kBox + 1, points, planes);
        bool ends_somewhere = false;
        for (int j = 0; j <= steps; ++j) {
            float missed = 1;
            bool bounded = false;
            for (const float* own = patch; own != patch + patches * kPatch; own += kPatch) {
                if (own[0] != float(search)) continue;
                const bool ends = own[1] == planes[j];
                const float outside = 1 - (valid ? met(own, points[j], points[j + 1], ends) : 0);
                (ends ? missed : seen) *= outside, bounded |= ends;
            }
            if (bounded) seen *= 1 - missed, ends_somewhere = true;
        }
        return valid || !ends_somewhere ? seen : 0;
    }

private:
    static float along(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
    static float soft(float inside) { return 1 / (1 + expf(-inside / kSoft)); }

    // The legs of one order: place, reflections, static end; whether its planes are met between these.
    bool trace(int source, int variant, const float* place, float (*points)[3], float* planes) const {
        const float* at = legs + (int64_t(source) * variants + variant) * (1 + kStep * steps);
        bool valid = *at++ != 0;
        for (int axis = 0; axis < 3; ++axis) points[0][axis] = place[axis], points[steps + 1][axis] = still[axis];
        for (int i = 0; i < steps; ++i, at += kStep) {
            const float above = along(points[i], at + 1) - at[4], share = above / (above - at[5] + kParallel);
            valid = valid && fabsf(share - 0.5f) < 0.5f + kEdge;
            const float part = share > 0 ? fminf(share, 1) : 0;
            for (int axis = 0; axis < 3; ++axis) points[i + 1][axis] = points[i][axis] + part * (at[6 + axis] - points[i][axis]);
            planes[i] = at[0];
        }
        planes[steps] = -1;
        return valid;
    }

    float past_box(const float* corners, const float (*points)[3], const float* planes) const {
        float chord = -INFINITY;
        for (int j = 0; j <= steps; ++j) {
            if (planes[j] == kNone) continue;
            float enter = 0, leave = 1, squared = 0;
            for (int axis = 0; axis < 3; ++axis) {
                const float start = points[j][axis], way = points[j + 1][axis] - start, whole = fabsf(way) < kEdge ? kEdge : way;
                const float low = (corners[axis] - start) / whole, high = (corners[3 + axis] - start) / whole;
                enter = fmaxf(enter, fminf(low, high)), leave = fminf(leave, fmaxf(low, high)), squared += whole * whole;
            }
            chord = fmaxf(chord, (leave - enter) * sqrtf(squared));
        }
        return soft(kMargin - chord);
    }

    // How far inside a patch a leg crosses it, or ends on it; 0 where it does neither.
    static float met(const float* own, const float* from, const float* to, bool ends) {
        const float before = along(from, own + 6) - own[9], after = along(to, own + 6) - own[9];
        const bool crosses = before * after < 0 && fabsf(before) > kSoft && fabsf(after) > kSoft;
        if (!crosses && !ends) return 0;
        const float part = crosses ? before / (before - after) : 1, u = along(from, own + 10), v = along(from, own + 13);
        const float x = u + part * (along(to, own + 10) - u), y = v + part * (along(to, own + 13) - v);
        return soft(fminf(fminf(x - own[2], own[4] - x), fminf(y - own[3], own[5] - y)));
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

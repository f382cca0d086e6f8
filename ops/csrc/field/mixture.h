// The mean of several processes of powers in decibels.
#pragma once
#include "powers.h"

namespace gsparc {
namespace GSPARC_ISA {

struct MixtureForm final : Form {
    static constexpr int kMost = 8;
    struct Member {
        Blob* blob = nullptr;
        Form* form = nullptr;
        double share = 0;
        ~Member() { delete form, delete blob; }
    };
    int count;
    Member members[kMost];

    MixtureForm(const Blob& blob, Numbers& in) {
        count = in.size(kMost);
        if (!count) refuse("a mean of no processes");
        for (int i = 0; i < count; ++i) {
            char name[] = "member0";
            name[6] = char(name[6] + i);
            Member& own = members[i];
            in.values(own.share);
            const int64_t* bytes;
            const int64_t words = blob.count(name);
            blob.read(name, bytes, words);
            own.blob = new Blob(bytes, 8 * words);
            Numbers numbers(*own.blob);
            double head[5];
            if (numbers.size(4) != 4) refuse("a mean of what are no processes of powers");
            for (double& one : head) one = numbers.next();  // of a file: error, worst, origin
            own.form = new PowersForm(*own.blob, numbers);
            const gsparc_facts& own_facts = own.form->facts;
            if (i && own_facts.axes != facts.axes) refuse("a mean of processes of %d and %d axes", own_facts.axes, facts.axes);
            const int64_t scratch = facts.scratch > own_facts.scratch ? facts.scratch : own_facts.scratch;
            facts = own_facts, facts.scratch = scratch;
        }
    }

    int answer(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const override {
        const double slope = 0.23025850929940457;
        double mean = 0, square = 0, spread = 0, lost = 0;
        for (int i = 0; i < count; ++i) {
            float power, own = 0, doubt = 0;
            const int done = members[i].form->answer(place, &power, variance ? &own : nullptr, unknown ? &doubt : nullptr, scratch);
            if (done != GSPARC_DONE) return done;
            const double decibels = 10 * log10(double(power)), share = members[i].share;
            mean += share * decibels, square += share * decibels * decibels, lost += share * doubt;
            spread += share * own / (slope * power * slope * power);
        }
        const double power = pow(10.0, 0.1 * mean);
        *values = float(power);
        const double apart = square - mean * mean;
        if (variance) *variance = float((spread + (apart > 0 ? apart : 0)) * slope * power * slope * power);
        if (unknown) *unknown = float(lost > 1 ? 1 : lost);
        return GSPARC_DONE;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

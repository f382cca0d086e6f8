// The mean of several processes of powers in decibels, or of several sums of sources.
#pragma once
#include "powers.h"
#include "sources.h"

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
    double doubt;  // what variances of channels are multiplied by
    Member members[kMost];

    MixtureForm(const Blob& blob, Numbers& in) {
        count = in.size(kMost), doubt = in.next();
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
            const int kind = numbers.size(4);
            if (kind < 3) refuse("a mean of what are neither sources nor processes of powers");
            for (double& one : head) one = numbers.next();  // of a file: error, worst, origin
            if (kind == 3) own.form = new SourcesForm(*own.blob, numbers);
            else own.form = new PowersForm(*own.blob, numbers);
            const gsparc_facts& own_facts = own.form->facts;
            if (i && own_facts.axes != facts.axes) refuse("a mean of processes of %d and %d axes", own_facts.axes, facts.axes);
            if (i && (own_facts.kind != facts.kind || own_facts.values != facts.values)) refuse("a mean of answers of several shapes");
            const int64_t scratch = facts.scratch > own_facts.scratch ? facts.scratch : own_facts.scratch;
            facts = own_facts, facts.scratch = scratch;
        }
        Scratch counted{0};
        if (facts.kind == GSPARC_CHANNEL) counted.take<float>(facts.values), facts.scratch += int64_t(counted.next);
    }

    int answer(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const override {
        if (facts.kind == GSPARC_CHANNEL) return add_up(place, values, variance, unknown, scratch);
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

private:
    // Of channels; what members disagree about is part of the variance, mean over entries.
    int add_up(const float* place, float* values, float* variance, float* unknown, Scratch scratch) const {
        float* own = scratch.take<float>(facts.values);
        double spread = 0, apart = 0, lost = 0;
        memset(values, 0, facts.values * sizeof(float));
        for (int i = 0; i < count; ++i) {
            float left = 0, share = 0;
            const int done = members[i].form->answer(place, own, variance ? &left : nullptr, unknown ? &share : nullptr, scratch);
            if (done != GSPARC_DONE) return done;
            spread += members[i].share * left, lost += members[i].share * share;
            for (int64_t j = 0; j < facts.values; ++j) {
                const double value = own[j];
                values[j] += float(members[i].share * value), apart += members[i].share * value * value;
            }
        }
        for (int64_t j = 0; j < facts.values; ++j) apart -= double(values[j]) * values[j];
        if (variance) *variance = float(doubt * (spread + (apart > 0 ? 2 * apart / double(facts.values) : 0)));
        if (unknown) *unknown = float(lost > 1 ? 1 : lost);
        return GSPARC_DONE;
    }
};

}  // namespace GSPARC_ISA
}  // namespace gsparc

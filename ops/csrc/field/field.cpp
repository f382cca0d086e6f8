// The C interface: loads a file, picks the machine's instruction set.
#include "gsparc_field.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include <memory>
#include <new>
#include <vector>

#include "../processor.h"
#include "form.h"

namespace gsparc {
#define X(set)                           \
    namespace set {                      \
    extern Form* form_of(const Blob&);   \
    }
GSPARC_SETS(X)
#undef X
}  // namespace gsparc

struct gsparc_field {
    std::unique_ptr<gsparc::Blob> blob;
    std::unique_ptr<gsparc::Form> form;
};

namespace {

void say(char* why, size_t room, const char* text) {
    if (why && room) snprintf(why, room, "%s", text);
}

std::unique_ptr<gsparc::Form> form_of(const gsparc::Blob& blob) {
#define X(set) \
    if (gsparc::runs(#set)) return std::unique_ptr<gsparc::Form>(gsparc::set::form_of(blob));
    GSPARC_SETS(X)
#undef X
    return nullptr;
}

// What a query reads and writes is no larger than the interface says, and can be had.
void check(const gsparc_facts& facts) {
    if (facts.axes != 3 && facts.axes != 6) gsparc::refuse("places of %d coordinates", facts.axes);
    if (facts.values > (GSPARC_MOST_BYTES - facts.scratch) / int64_t(sizeof(float)))
        gsparc::refuse("an answer of %lld numbers, %lld bytes of scratch memory", (long long)facts.values, (long long)facts.scratch);
}

}  // namespace

#define GSPARC_EXPORT extern "C" __attribute__((visibility("default")))

GSPARC_EXPORT gsparc_field* gsparc_open(const void* bytes, size_t size, char* why, size_t room) {
    try {
        auto found = std::make_unique<gsparc_field>();
        found->blob = std::make_unique<gsparc::Blob>(bytes, int64_t(size));
        found->form = form_of(*found->blob);
        check(found->form->facts);
        return found.release();
    } catch (const gsparc::Refused& refused) {
        say(why, room, refused.why);
    } catch (const std::bad_alloc&) {
        say(why, room, "out of memory");
    } catch (...) {  // a C program could not catch it
        say(why, room, "an unexpected fault");
    }
    return nullptr;
}

GSPARC_EXPORT gsparc_field* gsparc_load(const char* path, char* why, size_t room) {
    std::unique_ptr<FILE, int (*)(FILE*)> file(fopen(path, "rb"), fclose);
    if (!file) return say(why, room, "the file cannot be opened"), nullptr;
    try {
        std::vector<char> bytes;
        constexpr size_t step = 1 << 20;
        for (size_t got = step; got == step;) {
            bytes.resize(bytes.size() + step);
            got = fread(bytes.data() + bytes.size() - step, 1, step, file.get());
            bytes.resize(bytes.size() - step + got);
        }
        return gsparc_open(bytes.data(), bytes.size(), why, room);
    } catch (...) {  // of memory alone, by a vector
        return say(why, room, "out of memory"), nullptr;
    }
}

GSPARC_EXPORT void gsparc_free(gsparc_field* field) { delete field; }
GSPARC_EXPORT gsparc_facts gsparc_about(const gsparc_field* field) { return field->form->facts; }

GSPARC_EXPORT int gsparc_query(const gsparc_field* field, const float* place, float* values, float* variance, float* unknown,
                               void* scratch) {
    const gsparc::Form& form = *field->form;
    for (int axis = 0; axis < form.facts.axes; ++axis)
        if (!(fabs(place[axis] + form.facts.origin[axis % 3]) <= GSPARC_FARTHEST_M)) return GSPARC_BAD_PLACE;
    return form.answer(place, values, variance, unknown, gsparc::Scratch{reinterpret_cast<uintptr_t>(scratch)});
}

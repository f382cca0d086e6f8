// The forms of a field, compiled once per instruction set.
#include "image.h"
#include "mixture.h"

namespace gsparc {
namespace GSPARC_ISA {

extern Form* form_of(const Blob& blob) {
    Numbers in(blob);
    const int kind = in.size(5);
    double error, worst, origin[3];
    in.values(error, worst, origin[0], origin[1], origin[2]);
    Form* found = nullptr;
    if (kind == 1) found = new SpectrumForm(blob, in);
    if (kind == 2) found = new ImageForm(blob, in);
    if (kind == 3) found = new SourcesForm(blob, in);
    if (kind == 4) found = new PowersForm(blob, in);
    if (kind == 5) found = new MixtureForm(blob, in);
    if (!found) refuse("form %d is none of this library's", kind);
    found->facts.error = error, found->facts.worst = worst;
    for (int axis = 0; axis < 3; ++axis) found->facts.origin[axis] = origin[axis];
    return found;
}

}  // namespace GSPARC_ISA
}  // namespace gsparc

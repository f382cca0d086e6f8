/* A trained field without Python: answers at places, from a file of `gsparc export to=c`.
 *
 * After loading nothing is allocated and nothing is locked: any number of threads may query one field, each with
 * scratch memory and results of its own. Places are float32 metres from `origin`, of the end that moved; of both ends,
 * transmitter first, where both did. */
#ifndef GSPARC_FIELD_H
#define GSPARC_FIELD_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define GSPARC_FIELD_VERSION 4
#define GSPARC_FARTHEST_M 1e7              /* from the origin of the world: no place in metres lies beyond, as in Python */
#define GSPARC_MOST_BYTES (INT64_C(1) << 28) /* of an answer and its scratch memory: files of more are refused, as damaged */

typedef struct gsparc_field gsparc_field;

enum { GSPARC_SPECTRUM = 1, GSPARC_CHANNEL = 2, GSPARC_POWER = 3 };           /* kinds of values */
enum { GSPARC_DONE = 0, GSPARC_BAD_PLACE = 1 /* not finite, or too far */, GSPARC_UNSOLVED = 2 }; /* what queries return */

typedef struct {
    int32_t kind;
    int32_t axes;      /* coordinates of a place: 3, or 6 of both ends */
    int32_t shape[2];  /* rows and columns of a spectrum, antennas and tones of a channel, 1 and 1 */
    int64_t values;    /* floats of an answer: rows * columns; 2 * antennas * tones, real before imaginary; 1 */
    int64_t scratch;   /* bytes of scratch memory that a query needs, its start a multiple of 64 */
    double origin[3];  /* of the places in the world [m]: subtract it in double precision */
    double error;      /* against the model, over random places: MSE of spectra, NMSE of channels, RMSE of powers [dB]; 0: none */
    double worst;      /* the same of the worst place; of a channel, over the mean power of all */
} gsparc_facts;

/* From a file, or from its bytes, which are copied; null where it is refused, and `why` (of `room` bytes) says so. */
gsparc_field* gsparc_load(const char* path, char* why, size_t room);
gsparc_field* gsparc_open(const void* bytes, size_t size, char* why, size_t room);
void gsparc_free(gsparc_field* field);
gsparc_facts gsparc_about(const gsparc_field* field);

/* The answer at one place, in the units of the measurements: a spectrum in [0, 1], a channel, a linear power.
 * `variance`: expected squared error of a power, or of an entry of a channel (mean over these), NaN of others; `unknown`: the
 * share in [0, 1] of what the training rows do not tell, NaN where that is not known. Either may be null, which is quicker. */
int gsparc_query(const gsparc_field* field, const float* place, float* values, float* variance, float* unknown, void* scratch);

#ifdef __cplusplus
}
#endif
#endif

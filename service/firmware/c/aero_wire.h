/* Wire: quantizers, frames and transmit policy; SPEC.md, sections 2 and 3. No heap, no I/O, no global that changes.
 *
 * Bit for bit what aeroloop's Python computes, where aero_float.h lets it compile. */
#ifndef AERO_WIRE_H
#define AERO_WIRE_H

#include "aero_float.h"

#include <stddef.h>
#include <stdint.h>

#include "aero_config.h"

/* AERO_CONFIG of aero_wire.c. Node and law compare it with their own when they start: object files of two exports in
 * one program would misread each other's frames. */
extern const uint64_t aero_wire_config;

enum { AERO_CONTINUOUS, AERO_UNIFORM, AERO_HYSTERESIS, AERO_LOGARITHMIC };
enum { AERO_MEASURED = 6, AERO_MAX_CODES = 8 }; /* codes of a measurement: e1 e2 e3 w1 w2 w3; of any frame at most */

/* Quantizer of one signal, lengths in its unit; what its kind lacks is 0. */
typedef struct {
    int kind, bits;                                      /* bits of a code; 64 of a continuous signal */
    double limit, deadzone, step, hysteresis, threshold;
    int top, growing;                                    /* outermost code; number of geometric intervals */
    const double *edges;                                 /* AERO_LOGARITHMIC: top + 1 of them */
} aero_quantizer;

extern const aero_quantizer aero_attitude, aero_rate, aero_voltage; /* as configured */

/* Code of a value, a level's index or a continuous signal's value; beyond the range the outermost one, of NaN "no valid
 * value". `held` is the last code of a valid value, NaN before the first; AERO_HYSTERESIS alone depends on it. */
double aero_encode(const aero_quantizer *q, double y, double held);
double aero_level(const aero_quantizer *q, double code); /* signal's unit; NaN for "no valid value" and no code */
double aero_no_value(const aero_quantizer *q);           /* code for "no valid value" */
int aero_saturates(const aero_quantizer *q, double y);   /* whether a value is beyond the range */

/* Counter and codes of a frame: 1; or 0 if it is malformed, by length, padding or an infinite float, and nothing is
 * written. */
int aero_unpack_measurement(const uint8_t *frame, size_t size, uint32_t *counter, double codes[AERO_MEASURED]);
int aero_unpack_command(const uint8_t *frame, size_t size, uint32_t *counter, double codes[AERO_ACTUATORS]);

/* Frame of a counter below AERO_COUNTERS and of codes that `aero_encode` or `aero_no_value` gave. */
void aero_pack_measurement(uint8_t frame[AERO_MEASUREMENT_BYTES], uint32_t counter, const double codes[AERO_MEASURED]);
void aero_pack_command(uint8_t frame[AERO_COMMAND_BYTES], uint32_t counter, const double codes[AERO_ACTUATORS]);

/* Memory of a direction's transmit policy: codes and tick of the last frame sent, and whether there are any. */
typedef struct {
    double codes[AERO_MAX_CODES];
    int64_t at;
    int has_codes, has_sent;
} aero_sender;

int aero_due(aero_sender *sender, int on_change, int64_t k, const double *codes, int count); /* to be sent at tick k? */
void aero_forget(aero_sender *sender); /* clear the memory at a session's start: the next frame is due */

#endif

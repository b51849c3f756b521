/* Law: the controller end of the loop, from a measurement's frame to a command's. No heap, no I/O, no clock.
 *
 * The law's time is the tick times the period. What the configuration's law computes is in aero_equations.c, generated
 * from the expressions that the Python controller evaluates; its state and gains have names in aero_names.h.
 *
 * One context: these functions share `law` without a lock. So call them, and change gains and pieces, from one task or
 * interrupt. On a bus the controller's heartbeat carries AERO_FINGERPRINT, and a node follows no other than its own. */
#ifndef AERO_LAW_H
#define AERO_LAW_H

#include "aero_wire.h"

#include "aero_names.h"

/* A piece of the reference: roll, pitch and yaw at time `start` + s are the polynomials of s plus the sinusoids. */
typedef struct {
    double start;         /* [s] */
    double quintic[6][3]; /* coefficients of s^0 ... s^5 of roll, pitch, yaw [rad/s^n] */
    double amplitude[3];  /* of roll, pitch, yaw [rad] */
    double frequency[3];  /* [rad/s] */
} aero_piece;

/* What a tick computed; the whole of it where the law gave numbers, up to `rate_error` where it did not. */
typedef struct {
    double attitude[4];       /* as received, scalar part first [1] */
    double desired[4];        /* desired attitude [1] */
    double rate[3];           /* as received, body frame [rad/s] */
    double attitude_error[3]; /* vector part of the error quaternion [1] */
    double rate_error[3];     /* body frame [rad/s] */
    double voltages[AERO_ACTUATORS]; /* before quantization [V] */
} aero_outputs;

typedef struct {
    aero_gains gains; /* may be changed between two ticks */
    const aero_piece *pieces; /* the reference, which the caller keeps, in the order of their starts */
    size_t piece_count;
    aero_state state;     /* after the last valid tick */
    aero_outputs outputs; /* of the last valid tick */
    int64_t tick;         /* last one answered from valid values; -1 before */
    double held[AERO_MEASURED]; /* codes of the last measurement, for ticks without one */
    int has_held;
    double voltage_codes[AERO_ACTUATORS]; /* of the last valid command; NaN before */
    aero_sender sender;
    uint32_t refused, invalid, saturated; /* malformed frames, measurements without valid values, voltages out of range */
    int fault; /* the law gave no number, in voltages or state, or was linked from two exports: until aero_law_start, at
                * the next session, every command has no valid value */
} aero_law;

enum { AERO_REFUSED = -1, AERO_UNCHANGED = 0 };

void aero_law_start(aero_law *law); /* before the first tick, as configured */

/* Answers the measurement of tick k, `size` bytes, none of which stand for unchanged levels. Returns the length of the
 * command; AERO_UNCHANGED if it would repeat the last one; AERO_REFUSED for malformed bytes and for a negative k. A
 * measurement without a valid value, and any in a fault, is answered by a command without one, at which the plant goes
 * to 0 V. */
int aero_law_tick(aero_law *law, const uint8_t *frame, size_t size, int64_t k, uint8_t command[AERO_COMMAND_BYTES]);

/* Holds the levels of a measurement that was received after its tick was over: 1; 0 if it is malformed. */
int aero_law_hold(aero_law *law, const uint8_t *frame, size_t size);

#endif

/* Node: the plant end on a CAN bus, with watchdog, limits and latch; SPEC.md, sections 6 and 9.
 *
 * It keeps no clock: time is the tick index, and the port's clock is for heartbeats and a silent peer alone. Outside a
 * session, after a trip and at first the motors are at 0 V, and their power stage is off. A board calls, at each tick k:
 * aero_poll, aero_tick(k).
 *
 * One context: these functions share `node` without a lock, and call the port's. So call them from one task or one
 * interrupt, and from nowhere that can interrupt it, nor from the port's functions. */
#ifndef AERO_NODE_H
#define AERO_NODE_H

#include "aero_wire.h"

enum { AERO_IDLE, AERO_GRANTED, AERO_DRIVEN, AERO_TRIPPED };
enum {
    AERO_NO_CAUSE, AERO_COMMAND_TIMEOUT, AERO_INVALID_COMMAND, AERO_ENVELOPE, AERO_SATURATION, AERO_SENSORS,
    AERO_OPERATOR, AERO_HOLDER_GONE, AERO_NO_ANSWER, AERO_BUS, AERO_NODE, AERO_DUPLICATE, AERO_PLANT
};
enum { AERO_HEARTBEAT_BYTES = 8, AERO_CAN_BYTES = 64 };

typedef struct {
    int state, cause;                               /* cause of the last trip, until the next session */
    double voltages[AERO_ACTUATORS];                /* in force [V] */
    uint32_t refused, stale;                        /* malformed frames and commands that were too old, so far */
    int64_t ticked, start;                          /* last tick; that of the session's first measurement */

    /* session */
    int number, measured;                           /* number on the bus, or -1; whether it has a measurement */
    int64_t echo, answered, since, patience;        /* last fresh command; what the next one is waited for [ticks] */
    int has_codes, has_command;                     /* whether a command is in force; whether one waits */
    double codes[AERO_ACTUATORS], held[AERO_MEASURED];
    uint8_t command[AERO_COMMAND_BYTES], command_size;
    uint8_t invalid[AERO_COUNTERS / 8];             /* by counter: whether the measurement had no valid value */
    int64_t invalid_ticks, saturated_ticks;         /* in a row */
    aero_sender sender;

    /* the two ends' heartbeats */
    int has_peer, peer_state, peer_number, peer_is_ours;
    int64_t peer_ns, beat_due_ns;
    uint8_t beat[AERO_HEARTBEAT_BYTES];             /* the last one sent */
} aero_node;

int aero_in_session(const aero_node *node);     /* granted or driven */

/* Idle, at 0 V, before tick 0. Linked with an aero_wire.c of another export it stays tripped, as AERO_NODE. */
void aero_start(aero_node *node);

/* Take what was received, as much as a bus carries in a period, and follow the controller's heartbeat. */
void aero_poll(aero_node *node);

/* Command, watchdog, voltages, measurement at tick k. k rises from 0 on, by any number: the skipped ticks are over, and
 * the watchdog counts them. A k that does not rise is a failure of the board, and trips: the watchdog would stand still. */
void aero_tick(aero_node *node, int64_t k);

int aero_answered(aero_node *node);             /* lockstep: whether the answer to the last measurement waits */
void aero_trip(aero_node *node, int cause);     /* end the session for a cause that the board detects, at 0 V */
void aero_leave(aero_node *node);               /* release, at 0 V */

#endif

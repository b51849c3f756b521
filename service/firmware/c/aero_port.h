/* Port: the six functions that a board implements. None of them may block.
 *
 * A program that hangs commands nothing: let a hardware watchdog, fed by `aero_port_actuate`, put the motors at 0 V. */
#ifndef AERO_PORT_H
#define AERO_PORT_H

#include <stddef.h>
#include <stdint.h>

#include "aero_config.h"

int64_t aero_port_now(void); /* monotonic clock [ns], above 0 */

/* Voltages of the motors from tick k on [V], within the supply's limit: 0 V at first, with k = -1, and at the end of a
 * session; in a session and outside of it at each tick. */
void aero_port_actuate(int64_t k, const double voltages[AERO_ACTUATORS]);

/* The power stage of the motors, on from the begin of a session to its end; off at first. At an end 0 V and this come
 * before anything is sent. Empty on a board without a power stage. */
void aero_port_enable(int on);

/* The sensors at tick k: attitude q, scalar first [1], and angular velocity in the body's frame [rad/s]; NaN for what
 * has no valid value. */
void aero_port_measure(int64_t k, double attitude[4], double rate[3]);

/* Send a data frame with an 11-bit identifier, as CAN FD if it has more than 8 bytes; or drop it. */
void aero_port_send(uint32_t id, const uint8_t *data, size_t size);

/* Take the oldest received data frame with an 11-bit identifier, of 64 bytes at most; 0 if there is none. An interrupt
 * that receives frames puts them into a queue of the board's own, which this empties. */
int aero_port_receive(uint32_t *id, uint8_t data[64], size_t *size);

#endif

/* Node: see aero_node.h. The same decisions as aeroloop's plant_emulator, in the same order. */
#include "aero_node.h"

#include <math.h>
#include <string.h>

#include "aero_port.h"

enum { MEASUREMENT_ID = 0x100, COMMAND_ID = 0x200, PLANT_BEAT_ID = 0x300, CONTROLLER_BEAT_ID = 0x380, CLASSIC = 8 };
/* Of one poll: no bus carries 40 frames a millisecond, so what a babbling one repeats takes no longer than this. */
enum { MOST_FRAMES = 64 + AERO_PERIOD_NS / 25000 };

static const uint8_t FINGERPRINT[AERO_HEARTBEAT_BYTES - 1] = AERO_FINGERPRINT;
static const int SILENT_COMMANDS = AERO_LOCKSTEP && AERO_COMMAND_ON_CHANGE;
/* On change a controller may learn only a heartbeat later that values are valid again: so long its commands may have
 * none. */
static const int FORGIVEN = AERO_MEASUREMENT_ON_CHANGE && !AERO_LOCKSTEP ? AERO_HEARTBEAT_TICKS : 0;

int aero_in_session(const aero_node *n) { return n->state == AERO_GRANTED || n->state == AERO_DRIVEN; }

static int64_t wrapped(int64_t count) { return (count % AERO_COUNTERS + AERO_COUNTERS) % AERO_COUNTERS; }

static int is_one_export(void) { return aero_wire_config == AERO_CONFIG; }

static void actuate(const aero_node *n)
{
    double clipped[AERO_ACTUATORS];
    for (int i = 0; i < AERO_ACTUATORS; i++) {
        clipped[i] = fmax(-AERO_VOLTAGE_LIMIT, fmin(AERO_VOLTAGE_LIMIT, n->voltages[i]));
    }
    aero_port_actuate(n->ticked, clipped);
}

/* -- begin and end of a session -- */

static void end(aero_node *n, int state)
{
    for (int i = 0; i < AERO_ACTUATORS; i++) { n->voltages[i] = 0; }
    actuate(n);
    aero_port_enable(0);
    n->state = state;
    n->echo = n->answered = n->since = -1;
    n->has_codes = 0;
}

static void begin(aero_node *n)
{
    n->number = n->peer_number;
    n->state = AERO_GRANTED;
    n->cause = AERO_NO_CAUSE;
    n->start = n->ticked + 1;
    n->has_command = n->measured = 0; /* a command of before is dropped */
    n->invalid_ticks = n->saturated_ticks = 0;
    for (int i = 0; i < AERO_MEASURED; i++) { n->held[i] = NAN; }
    memset(n->invalid, 0, sizeof n->invalid);
    aero_forget(&n->sender);
    aero_port_enable(1);
}

void aero_trip(aero_node *n, int cause)
{
    if (!aero_in_session(n)) { return; }
    end(n, AERO_TRIPPED);
    n->cause = cause;
}

/* -- the bus -- */

static void beat_when_due(aero_node *n)
{
    uint8_t beat[AERO_HEARTBEAT_BYTES] = {(uint8_t)(n->cause << 4 | n->state)};
    int64_t now = aero_port_now();
    memcpy(beat + 1, FINGERPRINT, sizeof FINGERPRINT);
    if (now < n->beat_due_ns && memcmp(beat, n->beat, sizeof beat) == 0) { return; }
    memcpy(n->beat, beat, sizeof beat);
    n->beat_due_ns = now + AERO_CAN_HEARTBEAT_NS;
    aero_port_send(PLANT_BEAT_ID + AERO_CAN_NODE, beat, sizeof beat);
}

static void accept_command(aero_node *n, const uint8_t *data, size_t size)
{
    if (size > AERO_CAN_BYTES) { n->refused++; return; }
    int good = size == AERO_COMMAND_BYTES || (size == 0 && SILENT_COMMANDS) ||
               (size > AERO_COMMAND_BYTES && AERO_COMMAND_BYTES > CLASSIC);
    for (size_t i = AERO_COMMAND_BYTES; i < size; i++) { good = good && data[i] == 0; }
    if (good && !AERO_LOCKSTEP) { /* junk of the right length displaces nothing */
        uint32_t counter;
        double codes[AERO_ACTUATORS];
        good = aero_unpack_command(data, AERO_COMMAND_BYTES, &counter, codes);
    }
    if (!good) { n->refused++; return; }
    n->has_command = 1; /* in place of one that still waits */
    n->command_size = (uint8_t)(size ? AERO_COMMAND_BYTES : 0);
    memcpy(n->command, data, n->command_size);
    n->peer_ns = aero_port_now();
}

static void accept_beat(aero_node *n, const uint8_t *data, size_t size)
{
    if (size != AERO_HEARTBEAT_BYTES || (data[0] & 0x0F) > AERO_TRIPPED) { n->refused++; return; }
    n->has_peer = 1;
    n->peer_state = data[0] & 0x0F;
    n->peer_number = data[0] >> 4;
    n->peer_is_ours = is_one_export() && memcmp(data + 1, FINGERPRINT, sizeof FINGERPRINT) == 0;
    n->peer_ns = aero_port_now();
}

void aero_poll(aero_node *n)
{
    uint8_t data[AERO_CAN_BYTES];
    uint32_t id;
    size_t size;
    for (int i = 0; i < MOST_FRAMES && aero_port_receive(&id, data, &size); i++) {
        if (id == COMMAND_ID + AERO_CAN_NODE) { accept_command(n, data, size); }
        if (id == CONTROLLER_BEAT_ID + AERO_CAN_NODE) { accept_beat(n, data, size); }
    }
    if (!n->has_peer || aero_port_now() - n->peer_ns > AERO_CAN_SILENT_NS) {
        aero_trip(n, AERO_HOLDER_GONE);
        n->number = -1;
    } else if (n->peer_state != AERO_GRANTED || n->peer_number != n->number) {
        if (aero_in_session(n)) { end(n, AERO_IDLE); }
        n->number = -1;
        if (n->peer_state == AERO_GRANTED && n->peer_is_ours) { begin(n); }
    }
    beat_when_due(n);
}

/* -- one tick -- */

static int may_be_invalid(const aero_node *n, int64_t echo)
{
    for (int ago = 0; ago <= FORGIVEN; ago++) {
        int64_t i = wrapped(echo - ago);
        if (n->invalid[i / 8] >> i % 8 & 1) { return 1; }
    }
    return 0;
}

static void apply(aero_node *n)
{
    double codes[AERO_ACTUATORS], volts[AERO_ACTUATORS], sum = 0;
    uint32_t counter = (uint32_t)wrapped(n->echo + 1);
    if (n->command_size == 0 && n->has_codes) { memcpy(codes, n->codes, sizeof codes); } /* silence: as before */
    else if (!aero_unpack_command(n->command, n->command_size, &counter, codes)) { n->refused++; return; }
    int64_t tick = n->ticked - n->start, age = wrapped(tick - counter);
    if (counter == n->echo || tick - age <= n->answered) { return; } /* repeated */
    if (age > AERO_WATCHDOG_TICKS) { n->stale++; return; }
    n->echo = counter;
    n->answered = tick - age;
    n->since = n->ticked;
    n->patience = AERO_WATCHDOG_TICKS;
    for (int i = 0; i < AERO_ACTUATORS; i++) { sum += volts[i] = aero_level(&aero_voltage, codes[i]); }
    if (!isfinite(sum) && !may_be_invalid(n, counter)) { aero_trip(n, AERO_INVALID_COMMAND); return; }
    for (int i = 0; i < AERO_ACTUATORS; i++) { n->voltages[i] = isfinite(sum) ? volts[i] : 0; }
    memcpy(n->codes, codes, sizeof codes);
    n->has_codes = 1;
    n->state = AERO_DRIVEN;
}

static int beyond_limits(aero_node *n, const double q[4], const double w[3], int valid) /* the cause, or 0 */
{
    double largest = 0;
    n->invalid_ticks = valid ? 0 : n->invalid_ticks + 1;
    if (!valid) { return (double)(n->invalid_ticks * AERO_PERIOD_NS) * 1e-9 > AERO_MAX_INVALID_S ? AERO_SENSORS : 0; }
    if (1 - 2 * (q[1] * q[1] + q[2] * q[2]) < AERO_LEAST_UPRIGHT) { return AERO_ENVELOPE; }
    if (hypot(hypot(w[0], w[1]), w[2]) > AERO_MAX_RATE) { return AERO_ENVELOPE; }
    for (int i = 0; i < AERO_ACTUATORS; i++) { largest = fmax(largest, fabs(n->voltages[i])); }
    n->saturated_ticks = largest >= AERO_FULL_VOLTAGE ? n->saturated_ticks + 1 : 0;
    return (double)(n->saturated_ticks * AERO_PERIOD_NS) * 1e-9 > AERO_MAX_SATURATED_S ? AERO_SATURATION : 0;
}

static void measure(aero_node *n, int64_t k)
{
    uint8_t frame[AERO_MEASUREMENT_CAN_BYTES] = {0};
    double q[4], w[3], codes[AERO_MEASURED];
    if (!n->measured) { /* the session's first has counter 0, whichever tick it is */
        n->measured = 1;
        n->start = n->since = n->ticked;
        n->patience = AERO_FIRST_COMMAND_TICKS;
    }
    aero_port_measure(n->ticked, q, w);
    int valid = isfinite(q[0] + q[1] + q[2] + q[3] + w[0] + w[1] + w[2]) != 0;
    int cause = beyond_limits(n, q, w, valid);
    if (cause) { aero_trip(n, cause); return; }
    int64_t counter = wrapped(n->ticked - n->start);
    for (int i = 0; i < AERO_MEASURED; i++) {
        const aero_quantizer *signal = i < 3 ? &aero_attitude : &aero_rate;
        double value = i >= 3 ? w[i - 3] : q[0] >= 0 ? q[i + 1] : -q[i + 1];
        codes[i] = valid ? aero_encode(signal, value, n->held[i]) : aero_no_value(signal);
        if (valid) { n->held[i] = codes[i]; }
    }
    uint8_t bit = (uint8_t)(1U << counter % 8), *invalid = &n->invalid[counter / 8];
    *invalid = (uint8_t)(valid ? *invalid & ~bit : *invalid | bit);
    if (aero_due(&n->sender, AERO_MEASUREMENT_ON_CHANGE, k, codes, AERO_MEASURED)) {
        aero_pack_measurement(frame, (uint32_t)counter, codes);
        aero_port_send(MEASUREMENT_ID + AERO_CAN_NODE, frame, sizeof frame);
    } else if (AERO_LOCKSTEP) {
        aero_port_send(MEASUREMENT_ID + AERO_CAN_NODE, frame, 0);
    }
}

/* The periods up to tick k pass, at 0 V from the tick on at which the next command is overdue. */
static void advance_to(aero_node *n, int64_t k)
{
    if (n->since < 0 || k - n->since <= n->patience) { actuate(n); }
    else {
        int64_t overdue = n->since + n->patience;
        if (n->ticked < overdue) { actuate(n); n->ticked = overdue; }
        aero_trip(n, AERO_COMMAND_TIMEOUT);
    }
    n->ticked = k;
}

void aero_tick(aero_node *n, int64_t k)
{
    if (k <= n->ticked) { aero_trip(n, AERO_NODE); beat_when_due(n); return; }
    if (n->ticked < 0) { n->ticked = 0; }
    else if (n->has_command && aero_in_session(n)) { apply(n); }
    if (aero_in_session(n)) { n->has_command = 0; }
    advance_to(n, k);
    if (aero_in_session(n)) { measure(n, k); }
    beat_when_due(n);
}

int aero_answered(aero_node *n)
{
    double codes[AERO_ACTUATORS];
    uint32_t counter;
    if (n->has_command && aero_unpack_command(n->command, n->command_size, &counter, codes) &&
        counter != wrapped(n->ticked - n->start)) {
        n->has_command = 0; /* of another measurement; what is malformed is for aero_tick to refuse */
    }
    return n->has_command;
}

void aero_start(aero_node *n)
{
    memset(n, 0, sizeof *n);
    n->ticked = n->number = -1;
    if (!is_one_export()) { n->cause = AERO_NODE; }
    end(n, is_one_export() ? AERO_IDLE : AERO_TRIPPED);
}

void aero_leave(aero_node *n)
{
    end(n, aero_in_session(n) ? AERO_IDLE : n->state);
    beat_when_due(n);
}

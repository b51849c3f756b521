#include "aero_law.h"

#include <math.h>
#include <string.h>

#define COUNT(array) (sizeof(array) / sizeof((array)[0]))

static const aero_state initial_state = AERO_INITIAL_STATE;
static const aero_gains configured_gains = AERO_CONFIGURED_GAINS;
static const aero_piece configured_reference[] = AERO_REFERENCE;

void aero_law_start(aero_law *law) {
    static const double identity[4] = {1.0, 0.0, 0.0, 0.0};
    memset(law, 0, sizeof *law);
    law->gains = configured_gains;
    law->pieces = configured_reference;
    law->piece_count = COUNT(configured_reference);
    law->state = initial_state;
    memcpy(law->outputs.attitude, identity, sizeof identity);
    law->tick = -1;
    law->fault = aero_wire_config != AERO_CONFIG || aero_equations_config != AERO_CONFIG;
    for (size_t i = 0; i < COUNT(law->voltage_codes); i++) law->voltage_codes[i] = (double)NAN;
    aero_forget(&law->sender);
}

static const aero_piece *piece_at(const aero_law *law, double t) {
    size_t last = law->piece_count - 1;
    while (last > 0 && law->pieces[last].start > t) last--;
    return &law->pieces[last];
}

/* Computes a tick from the levels of a measurement; `next` and `out` are its results, if it returns 1. */
static int compute(const aero_law *law, double t, const double levels[AERO_MEASURED], aero_state *next,
                    aero_outputs *out) {
    const aero_piece *piece = piece_at(law, t);
    double scratch[AERO_SCRATCH];
    long long int indices[AERO_SCRATCH_INDICES];
    const double *given[] = {&t, &piece->start, &piece->quintic[0][0], piece->amplitude, piece->frequency,
                             law->outputs.attitude, (const double *)&law->state, (const double *)&law->gains,
                             levels, levels + 3};
    double *found[] = {out->attitude, (double *)next, out->desired, out->attitude_error, out->rate_error, out->voltages};
    const double *arguments[AERO_SCRATCH_ARGUMENTS];
    double *results[AERO_SCRATCH_RESULTS];
    memcpy(arguments, given, sizeof given);
    memcpy(results, found, sizeof found);
    memcpy(out->rate, levels + 3, sizeof out->rate);
    return aero_equations(arguments, results, indices, scratch, 0) == 0;
}

static int has_nan(const aero_state *state) {
    const double *values = (const double *)state;
    for (size_t i = 0; i < AERO_STATE_BYTES / sizeof *values; i++) {
        if (isnan(values[i])) return 1;
    }
    return 0;
}

static int is_number(const double *values, size_t count) {
    double sum = 0.0;
    for (size_t i = 0; i < count; i++) sum += values[i];
    return fabs(sum) <= HUGE_VAL;
}

static int receive(aero_law *law, const uint8_t *frame, size_t size, uint32_t *counter) {
    if (aero_unpack_measurement(frame, size, counter, law->held)) return law->has_held = 1;
    law->refused++;
    return 0;
}

int aero_law_hold(aero_law *law, const uint8_t *frame, size_t size) {
    uint32_t counter;
    return receive(law, frame, size, &counter);
}

/* The codes of a command: from the levels of a valid measurement, or without a valid value. */
static void answer(aero_law *law, int64_t k, const double levels[AERO_MEASURED], double codes[AERO_ACTUATORS]) {
    aero_state next;
    aero_outputs out;
    for (size_t i = 0; i < AERO_ACTUATORS; i++) codes[i] = aero_no_value(&aero_voltage);
    if (!is_number(levels, AERO_MEASURED)) {
        law->invalid++;
        return;
    }
    if (law->fault) return;
    if (!compute(law, (double)k * AERO_PERIOD_S, levels, &next, &out)) {
        law->fault = 1;
        return;
    }
    if (is_number(out.voltages, AERO_ACTUATORS) && !has_nan(&next)) {
        for (size_t i = 0; i < AERO_ACTUATORS; i++) {
            if (aero_saturates(&aero_voltage, out.voltages[i])) law->saturated++;
            codes[i] = law->voltage_codes[i] = aero_encode(&aero_voltage, out.voltages[i], law->voltage_codes[i]);
        }
    } else {
        law->fault = 1;
        memcpy(out.voltages, law->outputs.voltages, sizeof out.voltages);
    }
    law->tick = k;
    law->state = next;
    law->outputs = out;
}

int aero_law_tick(aero_law *law, const uint8_t *frame, size_t size, int64_t k, uint8_t command[AERO_COMMAND_BYTES]) {
    uint32_t counter = (uint32_t)(k % AERO_COUNTERS);
    double levels[AERO_MEASURED], codes[AERO_ACTUATORS];
    int unchanged = AERO_MEASUREMENT_ON_CHANGE && size == 0 && law->has_held;
    if (k < 0) law->refused++;
    if (k < 0 || (!unchanged && !receive(law, frame, size, &counter))) return AERO_REFUSED;
    for (size_t i = 0; i < AERO_MEASURED; i++) levels[i] = aero_level(i < 3 ? &aero_attitude : &aero_rate, law->held[i]);
    answer(law, k, levels, codes);
    if (!aero_due(&law->sender, AERO_COMMAND_ON_CHANGE, k, codes, AERO_ACTUATORS)) return AERO_UNCHANGED;
    aero_pack_command(command, counter, codes);
    return AERO_COMMAND_BYTES;
}

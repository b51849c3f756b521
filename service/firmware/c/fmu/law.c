/* The controller end: attitude (scalar part first [1]) and rate [rad/s] in, the levels that it commands out [V]. */
#include <math.h>

#include "aero_law.h"
#include "model.h"

enum { ATTITUDE = 0, RATE = 4, VOLTAGES = 7 };

struct model {
    double values[MODEL_VALUES];
    aero_law law;
    double codes[AERO_MEASURED]; /* of the last measurement; NaN before */
    int64_t k;
};

size_t model_size(void) { return sizeof(model); }

double *model_values(model *m) { return m->values; }

void model_start(model *m) {
    aero_law_start(&m->law);
    for (size_t i = 0; i < AERO_MEASURED; i++) m->codes[i] = (double)NAN;
    for (size_t i = 0; i < MODEL_VALUES; i++) m->values[i] = i == ATTITUDE ? 1.0 : 0.0;
    m->k = 0;
}

void model_step(model *m) {
    const double *q = m->values + ATTITUDE, turned = q[0] >= 0.0 ? 1.0 : -1.0; /* of both q and -q the one sent */
    uint8_t measurement[AERO_MEASUREMENT_BYTES], command[AERO_COMMAND_BYTES];
    uint32_t counter;
    double codes[AERO_ACTUATORS];
    for (size_t i = 0; i < AERO_MEASURED; i++) {
        double value = i < 3 ? turned * q[1 + i] : m->values[RATE + i - 3];
        m->codes[i] = aero_encode(i < 3 ? &aero_attitude : &aero_rate, value, m->codes[i]);
    }
    aero_pack_measurement(measurement, (uint32_t)(m->k % AERO_COUNTERS), m->codes);
    int length = aero_law_tick(&m->law, measurement, sizeof measurement, m->k++, command);
    if (length <= 0 || !aero_unpack_command(command, (size_t)length, &counter, codes)) return; /* unchanged */
    for (size_t i = 0; i < AERO_ACTUATORS; i++) {
        double volts = aero_level(&aero_voltage, codes[i]);
        m->values[VOLTAGES + i] = volts == volts ? volts : 0.0; /* without a valid value the plant goes to 0 V */
    }
}

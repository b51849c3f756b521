/* The emulated plant: voltages [V] and loads [N m] in; attitude [1] and rate [rad/s] as its sensors measure them out. */
#include <string.h>

#include "aero_plant.h"
#include "model.h"

struct model {
    double values[MODEL_VALUES];
    aero_plant plant;
};

size_t model_size(void) { return sizeof(model); }

double *model_values(model *m) { return m->values; }

static void measure(model *m) {
    double *seen = m->values + MODEL_INPUTS;
    memcpy(seen, m->plant.attitude, sizeof m->plant.attitude);
    memcpy(seen + 4, m->plant.rate, sizeof m->plant.rate);
}

void model_start(model *m) {
    memset(m, 0, sizeof *m);
    aero_plant_start(&m->plant);
    measure(m);
}

void model_step(model *m) {
    memcpy(m->plant.voltages, m->values, sizeof m->plant.voltages);
    memcpy(m->plant.loads, m->values + AERO_PLANT_ACTUATORS, sizeof m->plant.loads);
    aero_plant_step(&m->plant);
    measure(m);
}

/* The emulated plant: voltages [V] and loads [N m] in; attitude [1] and rate [rad/s] as its sensors measure them. */
#include <math.h>
#include <string.h>

#include "model.h"

int step(const double **, double **, long long int *, double *, int);
int sensors(const double **, double **, long long int *, double *, int);

enum { VOLTAGES = 0, LOADS = PLANT_ACTUATORS, SEEN = PLANT_ACTUATORS + PLANT_AXES };

struct model {
    double values[MODEL_VALUES];
    double x[PLANT_STATES], held[4]; /* of the body and its rotors; of the encoders' filters */
};

size_t model_size(void) { return sizeof(model); }

double *model_values(model *m) { return m->values; }

static void sense(model *m, const double *attitude, const double *rate, const double *angles) {
    static const double zeros[] = PLANT_ZEROS, error[3] = {0.0, 0.0, 0.0};
    double after[4], scratch[PLANT_SCRATCH];
    const double *given[PLANT_SCRATCH_ARGUMENTS] = {attitude, rate, angles, m->held, zeros, error};
    double *found[PLANT_SCRATCH_RESULTS] = {m->values + SEEN, after};
    long long int indices[1];
    (void)sensors(given, found, indices, scratch, 0);
    memcpy(m->held, after, sizeof after);
}

void model_start(model *m) {
    static const double x[PLANT_STATES] = PLANT_INITIAL, seen[] = PLANT_INITIAL_SEEN;
    memset(m, 0, sizeof *m);
    memcpy(m->x, x, sizeof x);
    m->held[0] = m->held[2] = (double)NAN;
    sense(m, seen, seen + 4, seen + 7);
}

void model_step(model *m) {
    double u[PLANT_ACTUATORS], after[PLANT_STATES], attitude[4], rate[3], angles[2], scratch[PLANT_SCRATCH];
    const double *given[PLANT_SCRATCH_ARGUMENTS] = {m->x, u, m->values + LOADS};
    double *found[PLANT_SCRATCH_RESULTS] = {after, attitude, rate, angles};
    long long int indices[1];
    for (size_t i = 0; i < PLANT_ACTUATORS; i++) {
        u[i] = fmax(-PLANT_VOLTAGE_LIMIT, fmin(PLANT_VOLTAGE_LIMIT, m->values[VOLTAGES + i]));
    }
    (void)step(given, found, indices, scratch, 0);
    memcpy(m->x, after, sizeof after);
    sense(m, attitude, rate, angles);
}

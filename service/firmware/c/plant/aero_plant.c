#include "aero_plant.h"

#include <math.h>
#include <string.h>

static void sense(aero_plant *p, const double *attitude, const double *rate, const double *angles) {
    static const double zeros[] = AERO_PLANT_ZEROS, error[] = AERO_PLANT_ERROR;
    double seen[7], after[4], scratch[AERO_PLANT_SCRATCH];
    const double *given[AERO_PLANT_SCRATCH] = {attitude, rate, angles, p->held, zeros, error};
    double *found[AERO_PLANT_SCRATCH] = {seen, after};
    long long int indices[1];
    (void)sensors(given, found, indices, scratch, 0);
    memcpy(p->held, after, sizeof after);
    memcpy(p->attitude, seen, sizeof p->attitude);
    memcpy(p->rate, seen + 4, sizeof p->rate);
}

void aero_plant_start(aero_plant *p) {
    static const double x[] = AERO_PLANT_X, attitude[] = AERO_PLANT_ATTITUDE, rate[] = AERO_PLANT_RATE;
    static const double angles[] = AERO_PLANT_ANGLES;
    memset(p, 0, sizeof *p);
    memcpy(p->x, x, sizeof p->x);
    p->held[0] = p->held[2] = (double)NAN; /* the filters start at the first sample */
    sense(p, attitude, rate, angles);
}

void aero_plant_step(aero_plant *p) {
    double u[AERO_PLANT_ACTUATORS], after[AERO_PLANT_STATES], attitude[4], rate[3], angles[2];
    double scratch[AERO_PLANT_SCRATCH];
    const double *given[AERO_PLANT_SCRATCH] = {p->x, u, p->loads};
    double *found[AERO_PLANT_SCRATCH] = {after, attitude, rate, angles};
    long long int indices[1];
    for (int i = 0; i < AERO_PLANT_ACTUATORS; i++) {
        u[i] = fmax(-AERO_PLANT_VOLTAGE_LIMIT, fmin(AERO_PLANT_VOLTAGE_LIMIT, p->voltages[i]));
    }
    (void)step(given, found, indices, scratch, 0);
    memcpy(p->x, after, sizeof after);
    sense(p, attitude, rate, angles);
}

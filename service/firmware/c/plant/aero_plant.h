/* The emulated plant: the body with its rotors, and its sensors, stepped by the loop's period. */
#ifndef AERO_PLANT_H
#define AERO_PLANT_H

#include "aero_plant_config.h"

typedef struct {
    double voltages[AERO_PLANT_ACTUATORS]; /* in force over the next step [V] */
    double loads[AERO_PLANT_AXES];         /* torques about the axes over the next step [N m] */
    double attitude[4], rate[3];           /* as the sensors measure them: scalar part first [1]; body frame [rad/s] */
    double x[AERO_PLANT_STATES], held[4];  /* of body and rotors; of the encoders' filters */
} aero_plant;

void aero_plant_start(aero_plant *plant);
void aero_plant_step(aero_plant *plant);

#endif

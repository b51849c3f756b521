/* Model of an FMU: its values, inputs first, and one step of a fixed length. fmu.py writes model_config.h. */
#ifndef MODEL_H
#define MODEL_H

#include <stddef.h>

#include "model_config.h"

typedef struct model model; /* holds no pointer to itself: a copy of its bytes is a copy of its state */

size_t model_size(void);
double *model_values(model *m);
void model_start(model *m); /* before the first step */
void model_step(model *m);  /* the outputs after a step of MODEL_STEP_S from the inputs */

#endif

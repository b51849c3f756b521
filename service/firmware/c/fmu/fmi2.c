/* FMI 2.0 co-simulation of a model with a fixed step and real variables, without the standard's headers. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

typedef enum { OK, WARNING, DISCARD, ERROR } status;
typedef void (*logger)(void *environment, const char *name, status level, const char *category, const char *text, ...);
typedef struct {
    logger log;
    void *allocate, *release, *finished, *environment;
} callbacks;
typedef struct {
    model *of; /* after the instance, in the same memory */
    const callbacks *calls;
    char name[64];
} instance;

#define EXPORT __attribute__((visibility("default")))

static status refuse(instance *one, const char *text) {
    if (one->calls != NULL && one->calls->log != NULL) one->calls->log(one->calls->environment, one->name, ERROR, "error", text);
    return ERROR;
}

EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }

EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                             const callbacks *calls, int visible, int logging) {
    instance *one = calloc(1, sizeof *one + model_size());
    (void)resources, (void)visible, (void)logging;
    if (one == NULL) return NULL;
    one->of = (model *)(one + 1);
    one->calls = calls;
    strncpy(one->name, name, sizeof one->name - 1);
    model_start(one->of);
    if (type == 1 && strcmp(guid, MODEL_GUID) == 0) return one;
    (void)refuse(one, "not this FMU's GUID, or no co-simulation");
    free(one);
    return NULL;
}

EXPORT void fmi2FreeInstance(instance *one) { free(one); }

EXPORT status fmi2Reset(instance *one) { return model_start(one->of), OK; }

EXPORT status fmi2GetReal(instance *one, const unsigned *which, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        if (which[i] >= MODEL_VALUES) return refuse(one, "no such variable");
        values[i] = model_values(one->of)[which[i]];
    }
    return OK;
}

EXPORT status fmi2SetReal(instance *one, const unsigned *which, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        if (which[i] >= MODEL_INPUTS) return refuse(one, "no such input");
        model_values(one->of)[which[i]] = values[i];
    }
    return OK;
}

EXPORT status fmi2DoStep(instance *one, double time, double length, int keeps_no_state) {
    (void)time, (void)keeps_no_state;
    if (fabs(length - MODEL_STEP_S) > 1e-9 * MODEL_STEP_S) return refuse(one, "the step is not the loop's period");
    return model_step(one->of), OK;
}

EXPORT status fmi2GetFMUstate(instance *one, void **state) {
    if (*state == NULL && (*state = malloc(model_size())) == NULL) return refuse(one, "no memory");
    return memcpy(*state, one->of, model_size()), OK;
}

EXPORT status fmi2SetFMUstate(instance *one, const void *state) { return memcpy(one->of, state, model_size()), OK; }

EXPORT status fmi2FreeFMUstate(instance *one, void **state) { return (void)one, free(*state), *state = NULL, OK; }

EXPORT status fmi2SetupExperiment(instance *one, int tolerant, double tolerance, double start, int ends, double stop) {
    return (void)one, (void)tolerant, (void)tolerance, (void)start, (void)ends, (void)stop, OK;
}

#define PASSES(name) EXPORT status name(instance *one) { return (void)one, OK; }
PASSES(fmi2EnterInitializationMode) PASSES(fmi2ExitInitializationMode) PASSES(fmi2Terminate) PASSES(fmi2SetDebugLogging)

#define LACKS(name) EXPORT status name(instance *one) { return refuse(one, #name ": this FMU has no such thing"); }
LACKS(fmi2GetInteger) LACKS(fmi2GetBoolean) LACKS(fmi2GetString) LACKS(fmi2SetInteger) LACKS(fmi2SetBoolean)
LACKS(fmi2SetString) LACKS(fmi2SerializedFMUstateSize) LACKS(fmi2SerializeFMUstate) LACKS(fmi2DeSerializeFMUstate)
LACKS(fmi2GetDirectionalDerivative) LACKS(fmi2SetRealInputDerivatives) LACKS(fmi2GetRealOutputDerivatives)
LACKS(fmi2CancelStep) LACKS(fmi2GetStatus) LACKS(fmi2GetRealStatus) LACKS(fmi2GetIntegerStatus)
LACKS(fmi2GetBooleanStatus) LACKS(fmi2GetStringStatus)

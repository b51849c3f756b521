/* FMI 2 co-simulation around `step`, the C code that CasADi makes of our emulated Aero's period. */
#include <fmi2FunctionTypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

int step(const double** arg, double** res, int* iw, double* w, int mem);

enum { U, LOAD = 2, Q = 4, RATE = 8, ANGLES = 11, FAILS_AT = 13, FAILS_WITH, SIZE };

typedef struct {
  double v[SIZE], x[4], w[WORK];
  const fmi2CallbackFunctions* callbacks;
  int calls; /* of those in between, which must come in this order */
} Aero;

static fmi2Status in_order(fmi2Component c, int call) { return ((Aero*)c)->calls++ == call ? fmi2OK : fmi2Error; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
    const fmi2CallbackFunctions* callbacks, fmi2Boolean visible, fmi2Boolean logging) {
  Aero* aero = calloc(1, sizeof(Aero));
  aero->callbacks = callbacks;
  aero->v[Q] = 1;
  aero->v[FAILS_AT] = INFINITY;
  if (strcmp(guid, "aero")) {
    callbacks->logger(0, name, fmi2Error, "error", "the GUID is %s, not aero", guid);
    return 0;
  }
  return aero;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real start,
    fmi2Boolean stop_defined, fmi2Real stop) {
  return in_order(c, 0);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return in_order(c, 1); }

fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return in_order(c, 2); }

void fmi2FreeInstance(fmi2Component c) { free(c); }

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
  for (size_t i = 0; i < n; ++i) ((Aero*)c)->v[vr[i]] = value[i];
  return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
  for (size_t i = 0; i < n; ++i) value[i] = ((Aero*)c)->v[vr[i]];
  return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real length, fmi2Boolean no_set_state) {
  Aero* aero = c;
  double* v = aero->v;
  if (aero->calls != 3) return fmi2Error;
  if (fabs(length - PERIOD) > 1e-9) return fmi2Error;
  if (time >= v[FAILS_AT]) {
    fmi2Status status = (fmi2Status)v[FAILS_WITH];
    aero->callbacks->logger(0, "aero", status, "error", "the motor burnt at %g s", time);
    return status;
  }
  double after[4];
  const double* arg[] = {aero->x, v + U, v + LOAD};
  double* res[] = {after, v + Q, v + RATE, v + ANGLES};
  if (step(arg, res, 0, aero->w, 0)) return fmi2Error;
  memcpy(aero->x, after, sizeof after);
  return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }

#define IS_MISSING(name) fmi2Status name(fmi2Component c) { return fmi2Error; }
IS_MISSING(fmi2Reset) IS_MISSING(fmi2SetDebugLogging)
IS_MISSING(fmi2GetInteger) IS_MISSING(fmi2GetBoolean) IS_MISSING(fmi2GetString)
IS_MISSING(fmi2SetInteger) IS_MISSING(fmi2SetBoolean) IS_MISSING(fmi2SetString)
IS_MISSING(fmi2GetFMUstate) IS_MISSING(fmi2SetFMUstate) IS_MISSING(fmi2FreeFMUstate)
IS_MISSING(fmi2SerializedFMUstateSize) IS_MISSING(fmi2SerializeFMUstate) IS_MISSING(fmi2DeSerializeFMUstate)
IS_MISSING(fmi2GetDirectionalDerivative) IS_MISSING(fmi2SetRealInputDerivatives)
IS_MISSING(fmi2GetRealOutputDerivatives) IS_MISSING(fmi2CancelStep) IS_MISSING(fmi2GetStatus)
IS_MISSING(fmi2GetRealStatus) IS_MISSING(fmi2GetIntegerStatus) IS_MISSING(fmi2GetBooleanStatus)
IS_MISSING(fmi2GetStringStatus)
const char* fmi2GetVersion(void) { return "2.0"; }
const char* fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

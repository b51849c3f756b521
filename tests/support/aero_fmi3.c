/* Co-simulation around the model exchange code that CasADi's DaeBuilder exports, whose own functions for it are stubs:
   the classical Runge-Kutta method in steps of STEP seconds, each operation as in aeroloop's rk4. */
#include <fmi3Functions.h>
#include <math.h>

#undef fmi3DoStep
#undef fmi3InstantiateCoSimulation
#define fmi3DoStep exported_DoStep
#define fmi3InstantiateCoSimulation exported_InstantiateCoSimulation
#include "aero_wrap.c"
#undef fmi3DoStep
#undef fmi3InstantiateCoSimulation

FMI3_Export fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
    const fmi3ValueReference required[], size_t n_required, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
  return fmi3InstantiateModelExchange(name, token, resources, visible, logging, environment, log);
}

static fmi3Status slope(fmi3Instance aero, const double x[N_X], double factor, const double k[N_X], double out[N_X]) {
  double at[N_X];
  for (int i = 0; i < N_X; ++i) at[i] = k ? x[i] + factor * k[i] : x[i];
  fmi3SetContinuousStates(aero, at, N_X);
  return fmi3GetContinuousStateDerivatives(aero, out, N_X);
}

FMI3_Export fmi3Status fmi3DoStep(fmi3Instance aero, fmi3Float64 time, fmi3Float64 length, fmi3Boolean no_set_state,
    fmi3Boolean* event, fmi3Boolean* terminate, fmi3Boolean* early, fmi3Float64* reached) {
  const double h = STEP;
  double x[N_X], k1[N_X], k2[N_X], k3[N_X], k4[N_X];
  for (long step = lround(length / h); step > 0; --step) {
    fmi3GetContinuousStates(aero, x, N_X);
    slope(aero, x, 0, 0, k1);
    slope(aero, x, h / 2, k1, k2);
    slope(aero, x, h / 2, k2, k3);
    slope(aero, x, h, k3, k4);
    for (int i = 0; i < N_X; ++i) x[i] = x[i] + h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
    fmi3SetContinuousStates(aero, x, N_X);
  }
  *event = *early = false;
  *terminate = x[0] > M_PI; /* the pitch's stop: this model ends there */
  *reached = time + length;
  return fmi3OK;
}

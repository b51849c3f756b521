"""The closed loop in bare C: the floor that an experiment's time is compared with. No part of any experiment.

The same tick, as CasADi generates it, called by a `for` loop in C.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Final

import numpy as np

from aeroloop.service.config import Settings
from aeroloop.service.control.reference import Floats
from aeroloop.service.lab.c_code import shared_object_of, source_of
from aeroloop.service.lab.loop_function import loop_of

_LOOP: Final = """
void bare_loop(casadi_int ticks, double *state, const double *desired, const double *wind, const double *error,
               double *out) {{
  double after[{state}], w[{work}];
  casadi_int iw[{integers}], i, k;
  for (k = 0; k < ticks; k++) {{
    const double *arg[{arguments}] = {{state, desired + {desired} * k, wind + {wind} * k, error + {error} * k}};
    double *res[{results}] = {{after, out + {out} * k}};
    tick(arg, res, iw, w, 0);
    for (i = 0; i < {state}; i++) state[i] = after[i];
  }}
}}
"""


def bare_loop(settings: Settings, ticks: int) -> Callable[[], Floats] | None:
    """A function that runs so many ticks and returns `out` of each; None without a C compiler. Shape (ticks, …)."""
    loop = loop_of(settings)
    tick = loop.tick
    sizes = {name: tick.numel_in(name) for name in tick.name_in()} | {"out": tick.numel_out("out")}
    memory = {"integers": tick.sz_iw() + 1, "work": tick.sz_w() + 1}
    scratch = {"arguments": tick.sz_arg(), "results": tick.sz_res(), **memory}
    library = shared_object_of(source_of(tick) + _LOOP.format(**sizes, **scratch))
    if library is None:
        return None
    run = ctypes.CDLL(str(library)).bare_loop
    inputs, out = loop.inputs(settings, ticks), np.empty((ticks, sizes["out"]))

    def once() -> Floats:
        arrays = inputs["state"].copy(), inputs["desired"], inputs["wind"], inputs["error"], out
        run(ctypes.c_longlong(ticks), *(ctypes.c_void_p(array.ctypes.data) for array in arrays))
        return out

    return once

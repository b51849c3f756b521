"""Adapter from the project's settings to the NumPy twin, the one place where the two meet."""

from __future__ import annotations

import numpy as np

from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from tests.support.numpy_twin import Body


def body_of(p: AdaptiveSettings) -> Body:
    return Body(
        J=np.diag(p.inertia),
        m=p.mass,
        g=p.gravity,
        r_g=np.array(p.centre_of_mass),
        B=np.array(p.allocation),
        C1=np.diag(p.C1),
        C2=np.diag(p.C2),
        Gamma=np.diag(p.Gamma),
        bound=p.damping_bound,
        centre=np.array(p.damping_estimate),
    )

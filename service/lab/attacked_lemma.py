"""Instants at which Lemma 1 is put to the test: states near the reference, with errors within their bounds."""

from __future__ import annotations

from math import sin
from typing import Final

import numpy as np

from aeroloop.service.config import Settings
from aeroloop.service.control.reference import Floats, desired
from aeroloop.service.lab.attacked_loops import span, turned
from aeroloop.service.lab.search_points import ball
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import Evaluated
from aeroloop.service.theorem.lemma import Samples, lemma_inequalities, rotation, times

SIZE: Final = 13
"""Coordinates of an instant, each −1…1: phase, ε̃, ω_e, errors of ε and of ω."""
PREMISES: Final = ("C.28", "C.29")


class Instants:
    """Both sides of Lemma 1 for many instants, under its own premises: norms of errors within (C.28) and (C.29).

    Args:
        settings: The configuration.
        e: Its quantities.
    """

    def __init__(self, settings: Settings, e: Evaluated) -> None:
        self._settings, self._e = settings, e
        period = settings.loop.period
        self._desired = desired(settings.reference, period, round(span(settings.reference) / period) + 1)

    def shares(self, points: Floats) -> dict[str, Floats]:
        """Left over right side of each inequality, by its number; 0 where both are 0. Points of shape (n, SIZE)."""
        limit, p = self._settings.wire.rate.limit, self._e.known
        phase, eps, rate, error, rate_error = np.split(points, [1, 4, 7, 10], axis=1)
        now = np.round((len(self._desired) - 1) * (phase[:, 0] + 1) / 2).astype(int)
        q_d, omega_d = self._desired[now, :4], self._desired[now, 4:7]
        eps_e = ball(eps) * sin(p.half_angle_e)
        q = turned(q_d, eps_e)
        # Cubed, as the interesting rates are small; and within the range, as Lemma 1 assumes.
        omega = times(np.swapaxes(rotation(q), 1, 2), omega_d) + 2 * limit * rate**3
        omega = np.clip(omega, -limit, limit)

        sent = q[:, 1:] * np.where(q[:, :1] < 0, -1.0, 1.0) + p.delta_eps * ball(error)
        square = (sent**2).sum(axis=1, keepdims=True)
        received = np.hstack([np.sqrt(np.maximum(0.0, 1 - square)), sent / np.sqrt(np.maximum(1.0, square))])
        received *= np.where((received * q).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        samples = Samples(
            q=q,
            omega=omega,
            q_Q=received,
            omega_Q=omega + p.delta_omega * ball(rate_error),
            q_d=q_d,
            omega_d=omega_d,
            sign=np.ones(len(q)),
        )
        return {
            found.equation: np.where(
                found.right > 0, found.left / np.maximum(found.right, 1e-300), np.where(found.broken, np.inf, 0.0)
            )
            for found in lemma_inequalities(samples, with_theorem(self._settings).law, p, self._e.lemma)
            if found.equation not in PREMISES
        }

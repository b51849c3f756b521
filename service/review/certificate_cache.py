"""Certificate and bounds that a review checks a session against.

The controller's description has the certificate of its configuration, which is used if the session began with that
configuration; with other gains or another reference, or in an older log, it is computed from the log. The bounds of
Lemma 1 are always computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from pydantic import ValidationError

from aeroloop.plant_emulator.settings import IDEAL_AERO, PlantSettings
from aeroloop.protocol.messages.operator import Change, Gains, Reference
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.service.config import Settings
from aeroloop.service.control.law import LawSettings
from aeroloop.service.theorem.certificate import Certificate, Evaluated, bounds_of, certify
from aeroloop.service.theorem.extremes import BoundlessError


class CertifiedBounds(NamedTuple):
    """Certificate and bounds of a session.

    Attributes:
        law: The model, with the gains that the session began with.
        certificate: Theorem 1 applied to them; None for a stream of set-points.
        bounds: The bounds that the certificate is made of; likewise.
        verdict: The certificate in a sentence, or why there is none.
    """

    law: LawSettings
    certificate: Certificate | None
    bounds: Evaluated | None
    verdict: str

    @property
    def radius(self) -> float | None:
        """Where ‖z‖ is guaranteed to end; None without a guarantee."""
        return None if self.certificate is None or not self.certificate.holds else self.certificate.radius


class CertificateCache:
    """Computes the certified bounds of sessions and keeps the last, since most sessions begin alike.

    Args:
        settings: The controller's configuration.
        promised: The certificate in its description, if there is one.
    """

    def __init__(self, settings: Settings, promised: dict[str, Any] | None = None) -> None:
        self._settings = settings
        self._promised = promised
        self._last: tuple[Gains | None, Reference, CertifiedBounds] | None = None

    def of(self, changes: Sequence[Change]) -> CertifiedBounds:
        """The certified bounds of a session.

        Args:
            changes: Its changes of gains and reference, in order; one at tick 0 is what it began with.
        """
        settings = self._settings
        first = changes[0] if changes and changes[0].tick == 0 else None
        gains = first.gains if first else None
        reference = (first.reference if first else None) or settings.reference
        if self._last is None or self._last[:2] != (gains, reference):
            self._last = gains, reference, self._computed(gains, reference)
        return self._last[2]

    def _computed(self, gains: Gains | None, reference: Reference) -> CertifiedBounds:
        settings = self._settings
        given = {name: value for name, value in gains or () if value is not None}
        law = settings.law.model_copy(update=given)
        try:
            bounds = bounds_of(settings.wire, law, reference, settings.controller)
        except BoundlessError as error:
            return CertifiedBounds(law, None, None, f"Nothing is promised: {error}.")
        certificate = None
        if (law, reference) == (settings.law, settings.reference) and self._promised is not None:
            certificate = _read(self._promised)
        if certificate is None:
            certificate = certify(settings.wire, law, reference, settings.controller)
        return CertifiedBounds(law, certificate, bounds, certificate.verdict)


def _read(promised: dict[str, Any]) -> Certificate | None:
    """A description's certificate; None if it is not of this version."""
    try:
        return Certificate.model_validate(promised)
    except ValidationError:
        return None


def damping_of(plant: PlantSettings) -> Vector | None:
    """θ of an emulated plant [N·m·s/rad]; None if it has other friction, or is not emulated."""
    if plant.via == "quanser":
        return None
    if plant.kind == "rigid_body":
        theta: Vector | None = plant.rigid_body.damping
    else:
        theta = IDEAL_AERO.damping if plant.ideal else plant.aero.damping
    friction = (*plant.friction.viscous, *plant.friction.coulomb)
    return theta if plant.ideal or not any(friction) else None

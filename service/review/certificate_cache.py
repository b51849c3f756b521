"""What a session is held against: the certificate of what it began with, and the bounds that it is made of.

The controller's description carries the certificate of its configuration, so none is computed; where the session began
with other gains or another reference, or the log is older, it is computed from what the log says. The bounds of
Lemma 1 always are.
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
    """What a session is held against.

    Attributes:
        law: The model, with the gains that the session began with.
        certificate: What the theorem says of them; None of a stream.
        bounds: What the certificate is made of; None of a stream.
        verdict: The certificate in a sentence, or why there is none.
    """

    law: LawSettings
    certificate: Certificate | None
    bounds: Evaluated | None
    verdict: str

    @property
    def radius(self) -> float | None:
        """Where ‖z‖ ends; None where nothing is guaranteed."""
        return None if self.certificate is None or not self.certificate.holds else self.certificate.radius


class CertificateCache:
    """The grounds of a log's sessions, most of which began alike.

    Args:
        settings: The controller's configuration.
        promised: The certificate in its description, if there is one.
    """

    def __init__(self, settings: Settings, promised: dict[str, Any] | None = None) -> None:
        self._settings = settings
        self._promised = promised
        self._last: tuple[Gains | None, Reference, CertifiedBounds] | None = None

    def of(self, changes: Sequence[Change]) -> CertifiedBounds:
        """The grounds of a session.

        Args:
            changes: What its controller followed from which tick on; the first is what it began with.
        """
        settings = self._settings
        first = changes[0] if changes and changes[0].tick == 0 else None
        gains = first.gains if first else None
        reference = (first.reference if first else None) or settings.reference
        if self._last is None or self._last[:2] != (gains, reference):
            self._last = gains, reference, self._made(gains, reference)
        return self._last[2]

    def _made(self, gains: Gains | None, reference: Reference) -> CertifiedBounds:
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
    """θ of an emulated plant [N·m·s/rad]; None where its friction is not only that, or it is no emulated plant."""
    if plant.via == "quanser":
        return None
    if plant.kind == "rigid_body":
        theta: Vector | None = plant.rigid_body.damping
    else:
        theta = IDEAL_AERO.damping if plant.ideal else plant.aero.damping
    friction = (*plant.friction.viscous, *plant.friction.coulomb)
    return theta if plant.ideal or not any(friction) else None

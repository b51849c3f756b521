"""Certificate and bounds that a review checks a session against.

The controller's description has the certificate of its configuration, which is used if the session began with that
configuration; with other gains or another reference, or in an older log, it is computed from the log. The bounds of
Lemma 1 are always computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from pydantic import ValidationError

from aeroloop.protocol.messages.operator import Change
from aeroloop.service.config import Settings
from aeroloop.service.control.law import LawSettings
from aeroloop.service.theorem.certificate import Certificate, certify
from aeroloop.service.theorem.evaluation import Evaluated, evaluate
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
    def pointwise_radius(self) -> float | None:
        """Within which ‖z‖ stays in the end; None where no such bound is proven of the plant."""
        return None if self.certificate is None or not self.certificate.holds else self.certificate.plant_radius


def certified_bounds(
    settings: Settings, changes: Sequence[Change] = (), promised: dict[str, Any] | None = None
) -> CertifiedBounds:
    """The certified bounds of a session.

    Args:
        settings: The controller's configuration.
        changes: The session's changes of gains and reference, in order; one at tick 0 is what it began with.
        promised: The certificate in the controller's description, if there is one; unused if of another version.
    """
    first = changes[0] if changes and changes[0].tick == 0 else None
    gains = {name: value for name, value in (first and first.gains) or () if value is not None}
    law, reference = settings.law.model_copy(update=gains), (first and first.reference) or settings.reference
    try:
        begun = settings.model_copy(update={"law": law, "reference": reference})
        bounds = evaluate(begun)
    except BoundlessError as error:
        return CertifiedBounds(law, None, None, f"Nothing is promised: {error}.")
    certificate = None
    if (law, reference) == (settings.law, settings.reference) and promised is not None:
        with suppress(ValidationError):
            certificate = Certificate.model_validate(promised)
    certificate = certificate or certify(begun, seek_remedies=False)
    return CertifiedBounds(law, certificate, bounds, certificate.verdict)

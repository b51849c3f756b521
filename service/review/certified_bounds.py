"""Certificate and bounds that a review checks a session against.

The controller's description has the certificate of its configuration, which is used if the ticks judged begin with that
configuration; with other gains or another reference it is computed from the log. The bounds of Lemma 1 are always
computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Self

import numpy as np
from pydantic import ValidationError

from aeroloop.protocol.messages.operator import Change, in_force
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Array
from aeroloop.service.theorem.certificate import Certificate, certify
from aeroloop.service.theorem.configured import NoTheoremError, with_theorem
from aeroloop.service.theorem.evaluation import Evaluated, evaluate
from aeroloop.service.theorem.extremes import BoundlessError


class CertifiedBounds(NamedTuple):
    """Certificate and bounds of a session.

    Attributes:
        law: The paper's law with the gains that the session began with; None of another law, which has no theorem.
        certificate: Theorem 1 applied to them; None for a stream of set-points, and of another law.
        bounds: The bounds that the certificate is made of; likewise.
        verdict: The certificate in a sentence, or why there is none.
    """

    law: AdaptiveSettings | None
    certificate: Certificate | None
    bounds: Evaluated | None
    verdict: str

    @property
    def pointwise_radius(self) -> float | None:
        """Within which ‖z‖ stays in the end; None where no such bound is proven of the plant."""
        return None if self.certificate is None or not self.certificate.holds else self.certificate.plant_radius


class PaperSignals(NamedTuple):
    """Signals of the paper's law at ticks.

    Attributes:
        sign: ±1, the equilibrium approached. Shape (n,).
        gain: C₁'s diagonal [1/s]. Shape (n, 3).
        damping_estimate: θ̂ as the law used it [N·m·s/rad]. Shape (n, 3).
    """

    sign: Array
    gain: Array
    damping_estimate: Array

    @classmethod
    def of(cls, ticks: Ticks, certified: CertifiedBounds) -> Self:
        """By the order of `Adaptive.initial` and `Adaptive.gains`. With another law gain and estimate are NaN."""
        if certified.law is not None:
            return cls(ticks.state_next[:, 3], ticks.gains[:, :3], ticks.state[:, :3])
        nearer: Array = np.where((ticks.attitude * ticks.desired).sum(axis=1) < 0, -1.0, 1.0)
        return cls(nearer, *np.full((2, len(nearer), 3), np.nan))


def certified_bounds(
    settings: Settings, changes: Sequence[Change] = (), promised: dict[str, Any] | None = None
) -> CertifiedBounds:
    """The certified bounds of a session.

    Args:
        settings: The controller's configuration.
        changes: The changes that set the gains and the reference of its first judged tick.
        promised: The certificate in the controller's description, if there is one; unused if of another version.
    """
    law, reference = settings.law, settings.reference
    own = settings.law if isinstance(settings.law, AdaptiveSettings) else None
    for change in in_force(changes):
        reference = change.reference or reference
        if own is not None and change.gains is not None:
            law = own = own.model_copy(update=change.gains.named)
    try:
        begun = with_theorem(settings.model_copy(update={"law": law, "reference": reference}))
        bounds = evaluate(begun)
    except NoTheoremError as error:
        text = str(error)
        verdict = (promised or {}).get("verdict", f"{text[0].upper()}{text[1:]}.")
        return CertifiedBounds(None, None, None, verdict)
    except BoundlessError as error:
        return CertifiedBounds(own, None, None, f"Nothing is promised: {error}.")
    certificate = None
    if (law, reference) == (settings.law, settings.reference) and promised is not None:
        with suppress(ValidationError):
            certificate = Certificate.model_validate(promised)
    certificate = certificate or certify(begun)
    return CertifiedBounds(own, certificate, bounds, certificate.verdict)

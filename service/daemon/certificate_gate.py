"""Certificate gate: publishes the theorem's verdict on the running controller, and refuses what must hold and does not.

With `controller.require_certificate` the controller claims no vehicle unless the theorem holds, and an operator's
change after which it would not hold is refused. A certificate takes some 20 ms, and up to a second with remedies, so it
is computed in the thread of the operator's query and cached; the loop only looks it up. Without that setting it is
computed in a thread of its own after the change, without remedies, and counts as not holding until then.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import EventKind
from aeroloop.protocol.messages.operator import Gains, Reference
from aeroloop.protocol.runtime.role import Role
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.registry import with_gains
from aeroloop.service.theorem.any_law import OwnCertificate, certify_any
from aeroloop.service.theorem.certificate import Certificate
from aeroloop.service.theorem.configured import NoTheoremError
from aeroloop.service.theorem.extremes import BoundlessError

KEPT: Final = 8
"""Cached verdicts: a few for the running configuration, and for pending changes."""

PAUSE_S: Final = 0.5
"""Pause between two certificates of changes that follow each other fast [s]."""
GIVE_WAY_S: Final = 1e-4
"""Longest that a thread computing a certificate delays the loop, each time the loop becomes ready [s]."""


class UncertifiedError(AeroloopError):
    """A change after which the theorem would not hold, where it must; one line with the reason and the remedies."""


class Verdict(NamedTuple):
    """Whether gains and a reference satisfy the theorem.

    Attributes:
        certificate: None of a stream, which cannot be certified, and of a law without a theorem.
        text: The verdict in a sentence, without full stop.
        helps: Remedies where it does not hold, to be appended to the text.
    """

    certificate: Certificate | OwnCertificate | None
    text: str
    helps: str = ""

    @property
    def holds(self) -> bool:
        """Whether the theorem holds."""
        return self.certificate is not None and self.certificate.holds

    @classmethod
    def of(cls, certificate: Certificate | OwnCertificate) -> Verdict:
        """The verdict of a certificate."""
        text = certificate.verdict.rstrip(".")
        text = text[0].lower() + text[1:]  # within a sentence
        if certificate.holds or isinstance(certificate, OwnCertificate) or not certificate.remedies:
            return cls(certificate, text)
        ways = [remedy.text for remedy in certificate.remedies if remedy.overrides]
        return cls(certificate, text, f"; what would do: {', or '.join(ways) or 'no bits and no gains'}")


class CertificateGate:
    """Certificates of one controller: computed, cached, published and required.

    Attributes:
        required: Whether the theorem must hold.
    """

    def __init__(self, role: Role, settings: Settings, gains: Gains, reference: Reference) -> None:
        self._role = role
        self._settings = settings
        self.required = settings.controller.require_certificate
        self._cache: deque[tuple[Gains, Reference, Verdict]] = deque(maxlen=KEPT)
        self._now = gains, reference
        self._verdict: Verdict | None = self.verdict_of(*self._now)
        self._published = ""
        self._computing = False

    # ── in any thread ──

    def verdict_of(self, gains: Gains, reference: Reference) -> Verdict:
        """The verdict on gains and a reference, from the cache if there."""
        if (cached := self._cached(gains, reference)) is not None:
            return cached
        law = with_gains(self._settings.law, gains)
        try:
            with _giving_way():
                changed = self._settings.model_copy(update={"law": law, "reference": reference})
                verdict = Verdict.of(certify_any(changed, seek_remedies=self.required))
        except NoTheoremError as error:
            verdict = Verdict(None, str(error))
        except BoundlessError as error:
            verdict = Verdict(None, f"nothing is certified: {error}")
        self._cache.append((gains, reference, verdict))
        return verdict

    def admit(self, gains: Gains, reference: Reference, *, required: bool | None = None) -> None:
        """Refuse gains and a reference that must be certified, as configured or `required`, and are not.

        Raises:
            UncertifiedError: It must hold, and would not.
        """
        if not (self.required if required is None else required):
            return
        verdict = self.verdict_of(gains, reference)
        if not verdict.holds:
            raise UncertifiedError(f"controller.require_certificate is set, and then {verdict.text}{verdict.helps}")

    def certificate_of(self, gains: Gains, reference: Reference) -> dict[str, Any] | None:
        """The certificate as a description carries it; None of a stream."""
        certificate = self.verdict_of(gains, reference).certificate
        return None if certificate is None else certificate.model_dump(mode="json")

    # ── in the loop ──

    @property
    def blocks(self) -> str | None:
        """Why no vehicle is claimed; None if claims are allowed."""
        if not self.required or (self._verdict is not None and self._verdict.holds):
            return None
        why = "whether the theorem holds is not known yet" if self._verdict is None else self._verdict.text
        return f"claims no vehicle, as controller.require_certificate is set: {why}"

    def take(self, gains: Gains, reference: Reference) -> None:
        """Take the gains and the reference now in force, and publish their verdict."""
        self._now = gains, reference
        self._verdict = self._cached(gains, reference)
        if self._verdict is not None:
            self.publish()
            return

        if not self._computing:
            self._computing = True
            threading.Thread(target=self._compute, name="verdict_of", daemon=True).start()

    def _compute(self) -> None:
        """Compute verdicts until that of what is in force is known, with a pause before each further one."""
        while True:
            now = self._now
            verdict = self.verdict_of(*now)
            self._role.enqueue(partial(self._take_verdict, now, verdict))
            self._computing = False
            if self._now == now:
                return
            self._computing = True
            time.sleep(PAUSE_S)

    def _take_verdict(self, of: tuple[Gains, Reference], verdict: Verdict) -> None:
        if self._now == of:
            self._verdict = verdict
            self.publish()

    def publish(self) -> None:
        """Publish the verdict, if it differs from the last one published."""
        if self._verdict is None:
            return
        blocks, before = self.blocks, self._published
        self._published = (blocks or self._verdict.text) + self._verdict.helps
        if self._published != before:
            kind: EventKind = "fault" if blocks else "changed" if before else "started"
            self._role.event(kind, self._published)

    def _cached(self, gains: Gains, reference: Reference) -> Verdict | None:
        return next((entry[2] for entry in tuple(self._cache) if entry[:2] == (gains, reference)), None)


@contextmanager
def _giving_way() -> Iterator[None]:
    """Switch threads more often meanwhile: otherwise the loop would miss a dozen ticks at once."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(GIVE_WAY_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)

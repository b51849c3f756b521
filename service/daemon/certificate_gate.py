"""What the theorem promises of a controller as it runs: told when it changes, and asked for before it drives.

With `controller.require_certificate` a controller of which the theorem does not hold claims no vehicle, and an
operator's change after which it would not hold is refused. A certificate takes some 10 ms, and 200 ms where remedies
are sought, so there it is computed in the thread of whoever asks for a change, and kept; the loop only looks it up.
Otherwise it is computed in a thread of its own once the change is made, and counts as not holding until then.
"""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import EventKind
from aeroloop.protocol.messages.operator import Gains, Reference
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.law import LawSettings
from aeroloop.service.settings import ControllerSettings
from aeroloop.service.theorem.certificate import Certificate, certify
from aeroloop.service.theorem.extremes import BoundlessError

KEPT: Final = 8
"""Verdicts that are kept: a few for what runs, and for changes that are being asked for."""

GIVE_WAY_S: Final = 1e-4
"""How long a thread that computes a certificate keeps the loop waiting, each time the loop has something to do [s]."""


class UncertifiedError(AeroloopError):
    """A change after which the theorem would not hold, where it must; one line that says why, and what would do."""


class Verdict(NamedTuple):
    """What can be said of gains and a reference.

    Attributes:
        certificate: None of a stream, of which nothing can be promised.
        text: In a sentence, but for its full stop.
        helps: What would help where it does not hold, to be put behind it.
    """

    certificate: Certificate | None
    text: str
    helps: str = ""

    @property
    def holds(self) -> bool:
        """Whether the theorem holds."""
        return self.certificate is not None and self.certificate.holds

    @classmethod
    def of(cls, certificate: Certificate) -> Verdict:
        """The verdict that a certificate is."""
        text = certificate.verdict.rstrip(".")
        if certificate.holds:
            return cls(certificate, text)
        ways = [remedy.text for remedy in certificate.remedies if remedy.overrides]
        return cls(certificate, text, f"; what would do: {', or '.join(ways) or 'no bits and no gains'}")


class CertificateGate:
    """What the theorem promises of one controller.

    Args:
        role: Its presence on the network.
        wire: Its quantizers.
        law: Its model, and the gains to begin with.
        reference: The reference to begin with.
        settings: How a session begins, and whether the theorem must hold.

    Attributes:
        required: Whether it must.
    """

    def __init__(
        self, role: Role, wire: WireSpec, law: LawSettings, reference: Reference, settings: ControllerSettings
    ) -> None:
        self._role = role
        self._wire = wire
        self._law = law
        self._settings = settings
        self.required = settings.require_certificate
        self._weighed: deque[tuple[Gains, Reference, Verdict]] = deque(maxlen=KEPT)
        self._now = gains_of(law), reference
        self._verdict: Verdict | None = self.weigh(*self._now)
        self._told: str | None = None

    # ── in any thread ──

    def weigh(self, gains: Gains, reference: Reference) -> Verdict:
        """The verdict on gains and a reference; at once if they were weighed lately."""
        if (known := self._known(gains, reference)) is not None:
            return known
        law = self._law.model_copy(update={name: value for name, value in gains if value is not None})
        try:
            with _giving_way():
                verdict = Verdict.of(certify(self._wire, law, reference, self._settings))
        except BoundlessError as error:
            verdict = Verdict(None, f"nothing is certified: {error}")
        self._weighed.append((gains, reference, verdict))
        return verdict

    def admit(self, gains: Gains, reference: Reference, *, required: bool | None = None) -> None:
        """Refuse what is asked for if it must be certified and is not.

        Args:
            gains: All three.
            reference: What would be followed.
            required: Whether the theorem must hold; as configured if None.

        Raises:
            UncertifiedError: It must hold, and would not.
        """
        if not (self.required if required is None else required):
            return
        verdict = self.weigh(gains, reference)
        if not verdict.holds:
            raise UncertifiedError(f"controller.require_certificate is set, and then {verdict.text}{verdict.helps}")

    def promise(self, gains: Gains, reference: Reference) -> dict[str, Any] | None:
        """The certificate as a description carries it; None of a stream."""
        certificate = self.weigh(gains, reference).certificate
        return None if certificate is None else certificate.model_dump(mode="json")

    # ── in the loop ──

    @property
    def blocks(self) -> str | None:
        """Why no vehicle is to be claimed; None if nothing forbids it."""
        if not self.required or (self._verdict is not None and self._verdict.holds):
            return None
        why = "it is not known yet whether the theorem holds" if self._verdict is None else self._verdict.text
        return f"claims no vehicle, as controller.require_certificate is set: {why}"

    def take(self, gains: Gains, reference: Reference) -> None:
        """This is in force from now on."""
        self._now = gains, reference
        self._verdict = self._known(gains, reference)
        if self._verdict is not None:
            self.publish()
            return

        def weigh() -> None:
            verdict = self.weigh(gains, reference)
            self._role.later(lambda: self._stand_by(gains, reference, verdict))

        threading.Thread(target=weigh, name="weigh", daemon=True).start()

    def publish(self) -> None:
        """Tell the verdict, if it is not what was told last."""
        if self._verdict is None:
            return
        blocks, told = self.blocks, self._told
        self._told = (blocks or self._verdict.text) + self._verdict.helps
        if self._told != told:
            kind: EventKind = "fault" if blocks else "started" if told is None else "changed"
            self._role.event(kind, self._told)

    def _stand_by(self, gains: Gains, reference: Reference, verdict: Verdict) -> None:
        if self._now == (gains, reference):
            self._verdict = verdict
            self.publish()

    def _known(self, gains: Gains, reference: Reference) -> Verdict | None:
        for weighed in tuple(self._weighed):
            if weighed[:2] == (gains, reference):
                return weighed[2]
        return None


@contextmanager
def _giving_way() -> Iterator[None]:
    """The interpreter changes threads more often meanwhile, or a loop beside would miss a dozen ticks at once."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(GIVE_WAY_S)
    try:
        yield
    finally:
        sys.setswitchinterval(usual)


def gains_of(law: LawSettings) -> Gains:
    """The gains of a configured law."""
    return Gains(C1=law.C1, C2=law.C2, Gamma=law.Gamma)

"""How a controller comes by a vehicle, and gives it back: the questions it puts to the plant."""

from __future__ import annotations

import logging
import os
import uuid
from typing import Final

import zenoh
from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Claim, Grant, Refusal, Release
from aeroloop.protocol.messages.operator import Answer
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.transport.link import Mailbox, ZenohLink
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.daemon.tick_source import MAILBOX

log: Final = logging.getLogger("aeroloop")

ANSWER_WAIT_S: Final = 1.0


class SessionLostError(AeroloopError):
    """A run of a given duration lost its session before its end; to claim again would start the law's time anew."""


class ClaimClient:
    """Asks for one vehicle.

    Args:
        role: Who asks; its name must be unique, because the plant knows its holder by it.
        loop: The grid.
        wire: How frames are read and written.
        auto_arm: Whether to arm the plant with every claim.

    Attributes:
        auto_arm: As given; may change.
        session: The session it has, or None.
    """

    def __init__(self, role: Role, loop: LoopSettings, wire: WireSpec, *, auto_arm: bool) -> None:
        self._role = role
        self._loop = loop
        self._wire = wire
        self.auto_arm = auto_arm
        self._told = ""
        self.session: str | None = None

    def claim(self) -> ZenohLink | None:
        """Ask for the vehicle. The link is there before the question, so that the first measurement is not lost."""
        role = self._role
        claim = Claim(
            controller=role.name,
            session=uuid.uuid4().hex[:8],
            period_ns=self._loop.period_ns,
            lockstep=self._loop.lockstep,
            auto_arm=self.auto_arm,
            wire=self._wire,
        )
        link = ZenohLink(
            role.zenoh,
            send_key=topics.key("command", role.vehicle, session=claim.session),
            receive_key=topics.key("measurement", role.vehicle, session=claim.session),
            lossless=self._loop.lockstep,
            mailbox=Mailbox(depth=MAILBOX if self._wire.transmit.measurement == "on_change" else 1),
        )
        answer = self._ask(claim)
        if isinstance(answer, Grant):
            self.session, self._told = claim.session, ""
            return link
        link.close()
        if answer is not None and answer.reason != self._told:
            self._told = answer.reason
            role.event("refused", f"{role.vehicle} refuses: {answer.reason}", claim.session)
        return None

    def release(self) -> None:
        """Give the session back, whether or not the plant still is there to take it."""
        if self.session is None:
            return
        release = Release(session=self.session)
        key = topics.key("release", self._role.vehicle)
        try:
            for _ in self._role.zenoh.get(key, payload=release.encode(), timeout=ANSWER_WAIT_S):
                pass
        except zenoh.ZError as error:
            log.warning("controller: could not release the session: %s", error)
        self.session = None

    def _ask(self, claim: Claim) -> Grant | Refusal | None:
        """The plant's answer, or None if there is no plant, or none that answers in time."""
        key = topics.key("claim", self._role.vehicle)
        for reply in self._role.zenoh.get(key, payload=claim.encode(), timeout=ANSWER_WAIT_S):
            if reply.ok is None:
                continue
            payload = reply.ok.payload.to_bytes()
            for model in (Grant, Refusal):
                try:
                    return model.model_validate_json(payload)
                except ValidationError:
                    continue
            try:
                return Refusal(reason=Answer.model_validate_json(payload).text)
            except ValidationError:
                continue
        return None


def controller_name() -> str:
    """A name for this controller that no other has: host names repeat, so a few random digits follow the process id."""
    return f"controller-{os.getpid()}-{uuid.uuid4().hex[:4]}"

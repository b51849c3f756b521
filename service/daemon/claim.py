"""Claim protocol, controller side: requests a session, releases it, reports refusals."""

from __future__ import annotations

import os
import uuid
from contextlib import suppress
from typing import Final

import zenoh

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Claim, Event, Grant, Refusal, Release, SessionRecord, Status
from aeroloop.protocol.messages.operator import Answer, MessageError
from aeroloop.protocol.runtime.node import EncodedOnce, Node, log_event
from aeroloop.protocol.transport.link import ZenohLink
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.daemon.tick_source import LOCKSTEP_MAILBOX, MAILBOX

ANSWER_WAIT_S: Final = 1.0


class SessionLostError(AeroloopError):
    """A run of a given duration lost its session before its end. A new claim would restart the law's time at 0."""


class ClaimClient:
    """Claims one vehicle. The role's name must be unique: the plant identifies its holder by it."""

    def __init__(self, role: Node, loop: LoopSettings, wire: WireSpec, *, auto_arm: bool) -> None:
        self._role, self._loop, self._wire, self._auto_arm = role, loop, wire, auto_arm
        self.refusal = ""  # why the plant refused the last claim; empty if it did not
        self.session: str | None = None  # the granted one
        self.last: SessionRecord | None = None  # of the vehicle's last session, from the last grant
        self.by_datagrams = False  # whether the last claim's frames travel as datagrams
        self._kept: SessionRecord | None = None  # the last record that the plant has confirmed
        self._encoded = EncodedOnce()  # the record, which is sent again until it is confirmed

    def claim(self) -> ZenohLink | None:
        """Claim the vehicle. The link is opened before the query, so that the first measurement is not lost."""
        role = self._role
        claim = Claim(
            controller=role.name, session=uuid.uuid4().hex[:8], period_ns=self._loop.period_ns,
            lockstep=self._loop.lockstep, auto_arm=self._auto_arm, wire=self._wire,
        )  # fmt: skip
        carrier = self._carrier()
        if carrier is None:
            return None
        self.by_datagrams = carrier is not role.zenoh
        if self._loop.lockstep:
            depth = LOCKSTEP_MAILBOX
        else:
            depth = MAILBOX if self._wire.transmit.measurement == "on_change" else 1
        link = ZenohLink(
            carrier,
            send_key=topics.key("command", role.vehicle, session=claim.session),
            receive_key=topics.key("measurement", role.vehicle, session=claim.session),
            accepts=self._wire.acceptance("measurement", lockstep=self._loop.lockstep),
            lossless=self._loop.lockstep,
            depth=depth,
        )
        answer = self._query(claim)
        if isinstance(answer, Grant):
            self.session, self.last, self.refusal = claim.session, answer.last, ""
            return link
        link.close()
        if answer is not None and answer.reason != self.refusal:
            self.refusal = answer.reason
            role.event("refused", f"{role.vehicle} refuses: {answer.reason}", claim.session)
        return None

    def keep(self, record: SessionRecord) -> None:
        """Hand the running session's record to the plant, unless it has confirmed it. Waits for nothing."""
        if self.session is None or record is self._kept:
            return

        def answered(reply: zenoh.Reply) -> None:
            with suppress(MessageError):
                if reply.ok and Answer.decode(reply.ok.payload.to_bytes()).done:
                    self._kept = record

        payload = self._encoded.bytes_of(record)
        drop, key = zenoh.CongestionControl.DROP, topics.key("record", self._role.vehicle)
        self._role.zenoh.get(key, answered, payload=payload, timeout=ANSWER_WAIT_S, congestion_control=drop)

    def release(self) -> None:
        """Release the session, whether or not the plant still answers."""
        if self.session is None:
            return
        role, session, self.session = self._role, self.session, None
        payload = Release(session=session).encode()
        try:
            list(role.zenoh.get(topics.key("release", role.vehicle), payload=payload, timeout=ANSWER_WAIT_S))
        except zenoh.ZError as error:  # an event that is not published: Zenoh has just failed
            text = f"could not release the session: {error}"
            log_event(Event(role=role.role, kind="fault", text=text, session=session), role.vehicle)

    def _carrier(self) -> zenoh.Session | None:
        """The session of the frames: of datagrams once it has a link to the plant. None while that is undecided."""
        role, datagrams = self._role, self._role.datagrams
        if self._loop.lockstep or not datagrams.wanted:
            return role.zenoh
        if datagrams.linked:
            return datagrams.session
        for reply in role.zenoh.get(topics.key("status", role.vehicle, role="plant"), timeout=ANSWER_WAIT_S):
            if reply.ok is None:  # Zenoh's for a query that timed out, which decides nothing
                continue
            with suppress(MessageError):
                status = Status.decode(reply.ok.payload.to_bytes(), extra="ignore")
                if not status.datagrams:
                    return role.zenoh
                linked = datagrams.connect(status.datagrams)
                if linked is not False:
                    return datagrams.session if linked else None
                place = status.datagrams.partition("?")[0]
                text = f"no datagrams pass to {place}: frames go by TCP, where each lost packet delays them"
                role.warn("datagrams", "fault", text)
                return role.zenoh
        return None

    def _query(self, claim: Claim) -> Grant | Refusal | None:
        """The plant's answer; None if no plant answers in time."""
        models: tuple[type[Grant | Refusal | Answer], ...] = Grant, Refusal, Answer
        key = topics.key("claim", self._role.vehicle)
        for reply in self._role.zenoh.get(key, payload=claim.encode(), timeout=ANSWER_WAIT_S):
            payload = reply.ok.payload.to_bytes() if reply.ok else b""
            for model in models:
                with suppress(MessageError):
                    read = model.decode(payload)
                    return Refusal(reason=read.text) if isinstance(read, Answer) else read
        return None


def controller_name() -> str:
    """A unique name for this controller. Process ids repeat between hosts, so a few random digits follow."""
    return f"controller-{os.getpid()}-{uuid.uuid4().hex[:4]}"

"""A loop whose links are all mutual TLS: it runs and is operated, and what is not a certificate's right is denied."""

from __future__ import annotations

import os
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

import pytest
import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Release
from aeroloop.protocol.messages.operator import Advance, Gains, Inject, Message, Request
from aeroloop.protocol.transport.network_settings import SecuritySettings
from aeroloop.service.host.operator import OperatorError, gather, stop
from aeroloop.service.testing.hil import Hil
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.certificates import Authority
from tests.support.certified_link import open_session
from tests.support.zenoh_network import eventually

PATIENT: Final = {"plant.watchdog_s": 10, "controller.stale_s": 10, "wire.counter_bits": 14}
"""The watchdog is not the matter here, and must not end a session on a machine that stalls for seconds."""


@pytest.mark.smoke
def test_a_secured_loop_runs_and_is_operated_with_certificates_only(hil: Hil, tmp_path: Path) -> None:
    """Slack: `PATIENT`'s; statuses are waited for, as on a busy machine a link may take longer than a command waits."""
    ours, foreign = Authority(tmp_path / "ours"), Authority(tmp_path / "foreign")
    for role, vehicle in (("plant", "aero"), ("controller", "aero"), ("recorder", None), ("operator", None)):
        ours.issue(role, vehicle)
    foreign.issue("operator")
    keys = {"network.security.directory": str(ours.folder), "network.rendezvous": free_rendezvous("tls")}
    hil.start(settings={**PATIENT, **keys})
    network = hil.settings.network

    def well() -> bool:
        with suppress(OperatorError):
            statuses = gather(network).statuses["aero"]
            assert all(status.certificate_until for status in statuses.values())
            states = {role: status.state for role, status in statuses.items()}
            return states == {"controller": "running", "plant": "driven", "recorder": "recording"}
        return False

    hil.eventually("the status of all", well)
    for security in (network.security.model_copy(update={"directory": str(foreign.folder)}), SecuritySettings()):
        met = network.rendezvous if security.folder else [network.rendezvous[0].replace("tls", "tcp")]
        stranger = network.model_copy(update={"security": security, "rendezvous": met})
        assert stop(stranger, patience_s=1.0).answers == []
        with pytest.raises(OperatorError, match="issuer certificate" if security.folder else "no role answers"):
            gather(stranger)
    assert not hil.happened("tripped")
    hil.stop()
    hil.eventually("the stop", lambda: hil.happened("tripped", "stopped by an operator"))


STRANGERS: Final = {
    ("observer", "aero"): frozenset(topics.TOPICS),
    ("recorder", "aero"): frozenset(topics.TOPICS),
    ("operator", "aero"): frozenset({"claim", "release", "record", "command", "measurement", "alive"}),
    ("controller", "aero"): frozenset({"arm", "stop", "stand_down", "set_gains", "inject", "measurement", "reference"}),
    ("plant", "bero"): frozenset(topics.TOPICS),
    ("controller", "bero"): frozenset(topics.TOPICS),
    ("operator", "bero"): frozenset(topics.TOPICS),
}  # certificates, and topics that are not theirs


CAUSED: Final = ("armed", "changed", "claimed", "released", "tripped", "marked", "stopped")
"""Events of what a stranger asks for, if it is done. A busy machine has others, of lost or late frames."""


def harass(session: zenoh.Session, names: frozenset[str], running: str, tokens: list[str]) -> None:
    requests: dict[str, Message] = {
        **dict.fromkeys(("stop", "stand_down", "arm"), Request()),
        "release": Release(session=running),
        "set_gains": Gains(C1=(9.0, 9.0, 9.0)),
        "inject": Inject(faults=["motors:bias=24"]),
        "advance": Advance(seconds=1.0),
    }
    for name in sorted(names):
        key = topics.key(name, "aero", session=running, role="plant")
        for payload in (requests[name].encode() if name in requests else b"{}", os.urandom(7)):
            session.put(key, payload)
            session.delete(key)
            session.get(key, lambda _: None, payload=payload, timeout=1.0)
    for token in tokens if "alive" in names else []:
        session.liveliness().declare_token(token).undeclare()


@pytest.mark.smoke
def test_what_is_not_a_certificate_s_right_neither_moves_nor_trips_a_plant(hil: Hil, tmp_path: Path) -> None:
    """Slack: the watchdog of `PATIENT`; a second of driving, where a stop takes effect within milliseconds."""
    ours = Authority(tmp_path)
    for role in ("plant", "controller", "recorder", "operator"):
        ours.issue(role, "aero")
    keys = {"network.security.directory": str(ours.folder), "network.rendezvous": free_rendezvous("tls")}
    hil.start(settings={**PATIENT, **keys})
    hil.eventually("a status of each", lambda: hil.state("controller") == "running")
    running = hil.status("controller").session
    assert running is not None
    alive = hil.processes.zenoh.liveliness().get(topics.key("alive", "aero"))
    tokens = [str(reply.ok.key_expr) for reply in alive if reply.ok]
    assert "aeroloop/aero/alive/plant" in tokens
    places = [place.replace("tcp/", "tls/") for place in hil.settings.network.rendezvous_endpoints]
    with ExitStack() as stack:
        joined = {
            who: stack.enter_context(open_session(ours.issue(*who, file="-".join(who)), connect=places))
            for who in STRANGERS
        }
        for each in joined.values():
            eventually("links", lambda e=each: len(list(e.info.peers_zid())) >= 4)  # type: ignore[misc]  # bound now
        before = len(hil.events)
        for who, names in STRANGERS.items():
            harass(joined[who], names, running, tokens)
        hil.run(1.0)
        assert [event.text for event in hil.events[before:] if event.kind in CAUSED] == []
        assert (hil.state("plant"), hil.state("controller")) == ("driven", "running")
        assert hil.status("controller").session == hil.status("plant").session == running
        harass(joined["operator", "aero"], frozenset({"stop"}), running, tokens)  # as a proof that it would have
        hil.eventually("the stop", lambda: hil.happened("tripped", "stopped by an operator"))

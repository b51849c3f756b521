"""Mutual TLS: plain text stays on this host, and only our authority's certificates link, until they expire."""

from __future__ import annotations

import json
import logging
import shutil
import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from datetime import timedelta
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.messages.topics import NAME
from aeroloop.protocol.transport.certificate import (
    OF_ONE_VEHICLE,
    ROLES,
    CertificateError,
    common_name,
    own_certificate,
    read_certificate,
    read_common_name,
)
from aeroloop.protocol.transport.network import PLAIN_S, command_session, join, refusal
from aeroloop.protocol.transport.network_settings import (
    READER,
    Identity,
    NetworkError,
    NetworkSettings,
    SecuritySettings,
    opened,
    protected,
)
from aeroloop.protocol.transport.zenoh_config import tls_config
from aeroloop.service.config_sources import load_target
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.certificates import DAY, Authority
from tests.support.zenoh_network import PATIENCE_S, eventually, free_port

PLANT, CONTROLLER = Identity(("plant",), "aero"), Identity(("controller",), "aero")
HERE = ("tcp/127.0.0.1:1", "tcp/[::1]:1", "tcp/localhost:1", "udp/127.1.2.3:1", "unixsock-stream//run/a.sock")
BEYOND = ("tcp/10.0.0.1:1", "tcp/[fe80::1]:1?iface=eth0", "tcp/0.0.0.0:1", "tcp/[::]:1", "tcp/lab-2:1")


@pytest.mark.parametrize("endpoint", [*HERE, *BEYOND, "udp/10.0.0.1:1", "ws/10.0.0.1:1", "tls/127.0.0.1:1"])
def test_plain_text_leaves_this_host_only_where_that_is_written_down(endpoint: str) -> None:
    """By settings of certificates and `insecure`; None: refused."""
    here, tls = endpoint in HERE, endpoint.startswith("tls")
    as_tls = "tls" + endpoint.removeprefix("tcp") if endpoint.startswith("tcp") else None
    for security, insecure in product((SecuritySettings(), SecuritySettings(directory="/keys")), (False, True)):
        network = NetworkSettings(security=security, insecure=insecure)
        if security.directory:
            expected = endpoint if here or tls else as_tls
        else:
            expected = endpoint if here or (insecure and not tls) else None
        if expected is not None:
            assert opened(endpoint, network) == expected
        else:
            with pytest.raises(NetworkError, match=r"network\.security\.directory|name a tcp or tls endpoint"):
                opened(endpoint, network)


def test_plain_text_beyond_loopback_is_said_at_each_start(caplog: pytest.LogCaptureFixture) -> None:
    network = NetworkSettings(rendezvous=[], connect=["tcp/192.0.2.1:1"])  # an address that nobody has
    with pytest.raises(NetworkError):
        join(network)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            join(network.model_copy(update={"insecure": True})).close()
    assert len([line for line in caplog.messages if "tcp/192.0.2.1:1" in line and "insecure" in line]) == 2


def test_certificates_are_needed_only_where_a_link_uses_them(tmp_path: Path) -> None:
    nowhere = NetworkSettings(security=SecuritySettings(directory=str(tmp_path)))
    assert protected(nowhere, PLANT) == (nowhere, None, ())
    with pytest.raises(CertificateError, match=r"ca\.pem is missing"):  # never the system's authorities
        protected(nowhere.model_copy(update={"rendezvous": ["tls/127.0.0.1:7447"]}), PLANT)


class Secured:
    """A network on loopback with mutual TLS, and what its authority has issued."""

    def __init__(self, tmp_path: Path) -> None:
        self.authority, self.foreign = Authority(tmp_path / "keys"), Authority(tmp_path / "foreign")
        for role, vehicle in (("plant", "aero"), ("controller", "aero"), ("operator", None)):
            self.authority.issue(role, vehicle)
        self.settings = NetworkSettings(
            rendezvous=[free_rendezvous("tls")],
            security=SecuritySettings(directory=str(self.authority.folder), vehicles=["aero"]),
        )
        self.place = protected(self.settings, PLANT).settings.rendezvous_endpoints[0]

    def certificate(self, kind: str) -> Path:
        """A recorder's, which is good, expired or of a foreign authority."""
        if kind == "foreign":
            return self.foreign.issue("recorder")
        return self.authority.issue("recorder", ends=-DAY if kind == "expired" else DAY)


SPOILED = ("expired", "foreign")


@pytest.fixture
def network(tmp_path: Path) -> Secured:
    return Secured(tmp_path)


@contextmanager
def bare(certificate: Path | None, **tree: Any) -> Iterator[zenoh.Session]:
    """A session of Zenoh's alone, which checks nothing of its own certificate."""
    tls = {"transport": {"link": {"tls": tls_config(read_certificate(certificate))}}} if certificate else {}
    config = {"scouting": {"multicast": {"enabled": False}}, **tls, **tree}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        yield session


def links(session: zenoh.Session) -> set[str | None]:
    return {link.auth_identifier for link in session.info.links()}


def test_peers_link_by_their_certificates_and_a_command_visits_them(network: Secured) -> None:
    with join(network.settings, PLANT) as plant, join(network.settings, CONTROLLER) as controller:
        eventually("a link", lambda: links(plant) == {"controller/aero"} and links(controller) == {"plant/aero"})
        with command_session(network.settings) as here:
            here.wait_for_links()
            assert here.unanswered() == []
            assert links(here.session) == {"plant/aero", "controller/aero"}


@pytest.mark.parametrize("kind", [*SPOILED, "none"])
def test_a_peer_without_a_good_certificate_does_not_link(network: Secured, kind: str) -> None:
    certificate = None if kind == "none" else network.certificate(kind)
    place = network.place.replace("tls", "tcp") if certificate is None else network.place
    connect = {"endpoints": [place], "exit_on_failure": True, "timeout_ms": 0}
    with (
        join(network.settings, PLANT) as plant,
        pytest.raises(zenoh.ZError),
        bare(certificate, mode="client", connect=connect),
    ):
        pytest.fail(f"it links: {links(plant)}")


@pytest.mark.parametrize("kind", ["good", *SPOILED])
def test_no_byte_of_ours_passes_the_handshake_with_a_listening_stranger(network: Secured, kind: str) -> None:
    certificate = network.certificate(kind)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, certificate.with_suffix(".key"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE_S)
        place = f"tls/127.0.0.1:{server.getsockname()[1]}"
        with join(network.settings.model_copy(update={"rendezvous": [], "connect": [place]}), PLANT):
            caller, _ = server.accept()
            caller.settimeout(PATIENCE_S)
            with (
                caller,
                nullcontext() if kind == "good" else pytest.raises(ssl.SSLError, match=r"(?i)alert"),
                context.wrap_socket(caller, server_side=True) as link,
            ):
                assert link.recv(1)


def test_a_link_closes_when_its_certificate_expires(network: Secured) -> None:
    soon = network.authority.issue("recorder", begins=-DAY, ends=timedelta(seconds=3))
    connect = {"endpoints": [network.place], "exit_on_failure": True}
    with join(network.settings, PLANT) as plant, bare(soon, mode="client", connect=connect):
        eventually("the link", lambda: links(plant) == {"recorder"})
        eventually("its end", lambda: not links(plant))


THEIRS = {"expired": "certificate has expired", "foreign": "issuer certificate"}
OURS = {"expired": "certificate expired", "foreign": "issuer certificate"}


@pytest.mark.parametrize("kind", SPOILED)
def test_a_refused_peer_and_the_one_that_refuses_it_learn_why(network: Secured, kind: str) -> None:
    wrong, mine = (
        read_certificate(network.certificate(kind)),
        read_certificate(network.authority.folder / "operator.pem"),
    )
    with join(network.settings, PLANT):
        assert refusal(network.place, mine) is None
        line = refusal(network.place, wrong) or ""
        assert network.place in line
        assert OURS[kind] in line
    place = f"tls/127.0.0.1:{free_port()}"
    with bare(wrong.file, listen={"endpoints": [place]}):
        line = refusal(place, mine) or ""
        assert place in line
        assert THEIRS[kind] in line


def test_a_peer_without_tls_differs_from_one_that_is_halted(network: Secured) -> None:
    mine, plain = read_certificate(network.authority.folder / "operator.pem"), free_rendezvous()
    with join(NetworkSettings(rendezvous=[plain])):
        assert "does not speak TLS" in (refusal(plain.replace("tcp", "tls"), mine, PLAIN_S) or "")
    with socket.create_server(("127.0.0.1", 0)) as halted:
        assert refusal(f"tls/127.0.0.1:{halted.getsockname()[1]}", mine) is None
    assert refusal(f"tls/127.0.0.1:{free_port()}", mine) is None


def test_a_network_with_certificates_names_the_vehicles_whose_peers_have_rights(network: Secured) -> None:
    nobody = network.settings.model_copy(update={"security": SecuritySettings(directory=str(network.authority.folder))})
    with pytest.raises(NetworkError, match="name them in"):
        protected(nobody, READER)
    named = ["vehicle=falcon", f"network.security.directory={network.authority.folder}"]
    assert load_target(None, named).network.security.vehicles == ["falcon"]
    both = load_target(None, [*named, 'network.security.vehicles=["aero"]'])
    assert both.network.security.vehicles == ["falcon", "aero"]


# ── certificates of roles: each that cannot be used is refused in one line that says what is wrong and what to do ──


@given(st.sampled_from(ROLES), st.none() | st.from_regex(f"^{NAME}$", fullmatch=True))
def test_a_common_name_says_role_and_vehicle_and_is_no_domain(role: str, vehicle: str | None) -> None:
    """Zenoh's connecting side trusts public authorities, which sign names of domains such as plant.aero."""
    whole = vehicle is not None or role not in OF_ONE_VEHICLE
    assert read_common_name(common_name(role, vehicle)) == ((role, vehicle) if whole else None)
    assert "/" in common_name(role, vehicle) or "." not in role


@pytest.mark.parametrize("text", ["", "pilot", "plant", "plant/", "/aero", "plant.aero", "operator/"])
def test_any_other_common_name_is_none_of_a_role(text: str) -> None:
    assert read_common_name(text) is None


def test_a_processs_own_certificate_is_found_by_role_and_vehicle(tmp_path: Path) -> None:
    authority = Authority(tmp_path / "keys")
    of_all = authority.issue("operator")
    assert own_certificate(authority.folder, ("operator",), "aero").file == of_all
    own = authority.issue("operator", "aero")
    assert own_certificate(authority.folder, ("operator", "observer"), "aero").file == own
    assert own_certificate(authority.folder, ("operator",), None).file == of_all
    of_all.unlink()
    found = own_certificate(authority.folder, ("recorder", "operator"), None)
    assert (found.file, found.role, found.vehicle, found.name) == (own, "operator", "aero", "a test")
    assert 0.9 < found.days_left < 1.1


def replaced_key(authority: Authority) -> None:
    file = authority.issue("plant", "aero")
    shutil.copy(authority.issue("operator").with_suffix(".key"), file.with_suffix(".key"))


BROKEN: dict[str, tuple[Callable[[Authority], object], tuple[str, ...]]] = {
    "missing": (lambda _: None, ("plant.aero.pem is missing", "keys issue plant NAME --vehicle aero")),
    "no authority": (lambda ca: (ca.folder / "ca.pem").unlink(), ("ca.pem is missing", "copy it")),
    "no key": (lambda ca: ca.issue("plant", "aero").with_suffix(".key").unlink(), ("plant.aero.key is missing",)),
    "open key": (
        lambda ca: ca.issue("plant", "aero").with_suffix(".key").chmod(0o640),
        ("read by others (mode 0640)", "chmod 600"),
    ),
    "another's key": (replaced_key, ("is not the key of plant.aero.pem",)),
    "expired": (lambda ca: ca.issue("plant", "aero", ends=-DAY), ("expired at", "issue it anew")),
    "not yet valid": (
        lambda ca: ca.issue("plant", "aero", begins=DAY, ends=2 * DAY),
        ("not valid before", "set the clock"),
    ),
    "foreign": (
        lambda ca: Authority(ca.folder.with_name("foreign")).issue("plant", "aero", folder=ca.folder),
        ("was not issued by ca.pem",),
    ),
    "wrong role": (
        lambda ca: ca.issue("controller", "aero", file="plant.aero"),
        ("certificate of controller/aero, not of plant/aero",),
    ),
    "another vehicle's": (
        lambda ca: ca.issue("plant", "bero", file="plant.aero"),
        ("certificate of plant/bero, not of plant/aero",),
    ),
    "no role": (lambda ca: ca.issue("plant", "aero", cn="plant.aero"), ("common name is 'plant.aero'",)),
    "garbage": (lambda ca: (ca.folder / "plant.aero.pem").write_text("-----"), ("is no certificate in PEM",)),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_cannot_be_used_is_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    spoil, says = BROKEN[kind]
    authority = Authority(tmp_path / "keys")
    spoil(authority)
    with pytest.raises(CertificateError) as caught:
        own_certificate(authority.folder, ("plant",), "aero")
    text = str(caught.value)
    assert "\n" not in text
    for part in says:
        assert part in text

"""Certificates of roles: each that cannot be used is refused in one line that says what is wrong and what to do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.messages.topics import NAME
from aeroloop.protocol.transport.certificate import (
    OF_ONE_VEHICLE,
    ROLES,
    CertificateError,
    common_name,
    own_certificate,
    read_common_name,
)
from tests.support.certificates import DAY, Authority


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

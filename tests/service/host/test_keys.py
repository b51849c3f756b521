"""Keys of a host: what is issued can be used, nothing is overwritten, and no key leaves its host."""

from __future__ import annotations

import json
import shutil
import stat
from pathlib import Path

import pytest

from aeroloop.protocol.transport.certificate import CertificateError, load, own_certificate, read_certificate
from aeroloop.protocol.transport.network_settings import NetworkSettings, SecuritySettings
from aeroloop.service.cli.main import execute as run
from aeroloop.service.host import keys
from aeroloop.service.host.doctor import certificate_findings
from tests.support.certificates import DAY, Authority, common_name


def of(folder: Path) -> NetworkSettings:
    return NetworkSettings(security=SecuritySettings(directory=str(folder)))


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A directory with an authority."""
    keys.init(tmp_path / "keys")
    return tmp_path / "keys"


@pytest.mark.parametrize(
    ("role", "vehicle"), [("plant", "aero"), ("controller", "aero-2"), ("operator", None), ("recorder", "aero")]
)
def test_what_is_issued_can_be_used_for_ninety_days(folder: Path, role: str, vehicle: str | None) -> None:
    file = keys.issue(folder, role, "lab 2", vehicle)
    found = own_certificate(folder, (role,), vehicle)
    assert (found.file, found.role, found.vehicle, found.name) == (file, role, vehicle, "lab 2")
    assert 89.9 < found.days_left <= 90
    assert load(file).subject.rfc4514_string() == f"OU=lab 2,CN={common_name(role, vehicle)}"


def test_keys_are_the_owners_alone_and_nothing_is_overwritten(folder: Path) -> None:
    keys.issue(folder, "operator", "Ada")
    before = files(folder)
    secrets = [folder / name for name, content in before.items() if b"PRIVATE" in content]
    assert [stat.S_IMODE(path.stat().st_mode) for path in (folder, *secrets)] == [0o700, 0o600, 0o600]
    for again in (keys.init, lambda folder: keys.issue(folder, "operator", "Eve")):
        with pytest.raises(CertificateError, match="is not overwritten"):
            again(folder)
    assert files(folder) == before
    for mode in (0o750, 0o705, 0o710):  # to a group, to others, to enter only
        (folder / f"{mode:o}").mkdir(mode=mode)
        with pytest.raises(CertificateError, match="chmod 700"):
            keys.init(folder / f"{mode:o}")


def test_no_certificate_outlives_its_authority(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "DAYS", keys.AUTHORITY_DAYS + 1)
    file = keys.issue(folder, "operator", "Ada")
    assert read_certificate(file).not_after == load(folder / "ca.pem").not_valid_after_utc


@pytest.mark.parametrize(
    ("role", "name", "vehicle", "says"),
    [
        ("pilot", "Ada", None, "roles are plant, controller"),
        ("plant", "bench", None, "--vehicle V"),
        ("plant", "bench", "a/b", "cannot name a vehicle"),
        ("controller", "bench", "a" * 60, "too long"),
        ("operator", "", None, "1 to 64"),
        ("operator", "a\nb", None, "1 to 64"),
    ],
)
def test_what_cannot_be_in_a_certificate_is_refused(
    folder: Path, role: str, name: str, vehicle: str | None, says: str
) -> None:
    before = files(folder)
    with pytest.raises(CertificateError, match=says) as caught:
        keys.issue(folder, role, name, vehicle)
    assert "\n" not in str(caught.value)
    assert files(folder) == before


def test_what_expires_soon_or_cannot_be_used_is_shown(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    authority = Authority(tmp_path / "keys", days=100)
    authority.issue("plant", "aero", ends=50 * DAY)
    authority.issue("operator", ends=13 * DAY)
    words = ["host", "keys", "show", "--json", "--directory", str(authority.folder)]
    assert run(words) == 0
    authority.issue("observer", ends=-DAY)
    assert run(words) == 1
    rows = {row["file"]: row for row in json.loads(capfd.readouterr().out.partition("]\n")[2])}
    assert "expired" in rows["observer.pem"]["problem"]
    assert rows["plant.aero.pem"]["problem"] is None
    assert 49 < rows["plant.aero.pem"]["days_left"] < 51
    findings = {finding.what: finding for finding in certificate_findings(of(authority.folder))}
    assert [name for name, finding in findings.items() if not finding.good] == ["observer.pem", "operator.pem"]
    assert findings["operator.pem"].found == "13 days left"
    assert "keys issue" in findings["operator.pem"].advice
    (missing,) = certificate_findings(of(tmp_path))
    assert not missing.good
    monkeypatch.setenv("COLUMNS", "120")
    assert run([*words[:3], *words[4:]]) == 1
    assert "observer.pem expired" in capfd.readouterr().out


def test_the_command_line_makes_what_two_hosts_need(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    lab, far = tmp_path / "lab", tmp_path / "far"
    there = ["--directory", str(lab)]
    assert run(["host", "keys", "init", *there]) == 0
    assert run(["host", "keys", "issue", "operator", "Ada", *there]) == 0
    assert run(["host", "keys", "issue", "plant", "bench", "--vehicle", "aero", *there]) == 0
    assert capfd.readouterr().out.splitlines() == [f"{lab}/{file}.pem" for file in ("ca", "operator", "plant.aero")]
    assert run(["host", "keys", "issue", "operator", *there]) == 2
    assert run(["host", "keys", "issue", "plant", "bench", *there]) == 1
    far.mkdir()
    for name in ("ca.pem", "plant.aero.pem", "plant.aero.key"):
        shutil.move(lab / name, far)
    assert own_certificate(far, ("plant",), "aero").name == "bench"
    with pytest.raises(CertificateError, match=r"ca\.key is not here"):
        keys.issue(far, "operator", "Ada")

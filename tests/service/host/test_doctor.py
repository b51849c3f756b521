"""Doctor: measures the configured rate, and reports a machine that misses it."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest

from aeroloop.protocol.runtime.timing import TickGrid
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import Identity, NetworkSettings, SecuritySettings
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.service.host import doctor
from aeroloop.service.testing.process_group import free_rendezvous
from tests.support.certificates import Authority
from tests.support.processes import AEROLOOP

pytestmark = pytest.mark.processes


@pytest.mark.realtime
def test_the_trial_runs_at_the_configured_rate_and_every_finding_is_reported() -> None:
    """In a process of its own, which becomes real-time. The verdict is this machine's: only its reasons are checked."""
    command = [*AEROLOOP, "host", "doctor", "--json", "--set", "loop.rate_hz=100"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    diagnosis = json.loads(done.stdout)
    assert done.returncode == (0 if diagnosis["holds"] else 1)
    # 500 ticks in 5 s, less those of the half second of start-up; what was skipped was not woken for
    assert 450 - diagnosis["skipped"] <= diagnosis["wake_us"]["count"] <= 451
    assert {"clock source", "real-time set-up"} <= {f["what"] for f in diagnosis["findings"]}
    assert all(finding["good"] or finding["advice"] for finding in diagnosis["findings"])


def test_a_machine_that_stalls_does_not_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "prepare_process", lambda _settings: [])
    monkeypatch.setattr(doctor, "CHECK_S", 1.0)
    wait = TickGrid.wait

    def stalling(grid: TickGrid) -> int:
        if grid.tick == 70:
            time.sleep(0.1)
        return wait(grid)

    monkeypatch.setattr(TickGrid, "wait", stalling)
    diagnosis = doctor.diagnose(LoopSettings(rate_hz=100.0), NetworkSettings())
    assert not diagnosis.holds
    assert diagnosis.skipped > 0
    assert not diagnosis.findings[-1].good


def test_it_says_of_each_configured_place_whether_a_process_answers_and_which_certificate_is_refused(
    tmp_path: Path,
) -> None:
    ours, foreign = Authority(tmp_path / "ours"), Authority(tmp_path / "foreign")
    for authority in (ours, foreign):
        authority.issue("operator")
        authority.issue("plant", "aero")
    settings = NetworkSettings(rendezvous=[free_rendezvous("tls")])

    def of(authority: Authority) -> NetworkSettings:
        security = SecuritySettings(directory=str(authority.folder), vehicles=["aero"])
        return settings.model_copy(update={"security": security})

    with join(of(ours), Identity(("plant",), "aero")):
        (fine,) = doctor.network_findings(of(ours))
        assert (fine.good, fine.found) == (True, "answers, and refuses none of 2 certificates")
        findings = list(doctor.network_findings(of(foreign)))
    assert [finding.what for finding in findings] == ["operator.pem", "plant.aero.pem"]
    assert all("refused at tls/" in finding.found for finding in findings)
    assert all("issuer certificate" in finding.advice for finding in findings)
    (silent,) = doctor.network_findings(of(ours))
    assert (silent.good, silent.found) == (False, "no process answers")

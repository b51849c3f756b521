"""A loop whose links are all mutual TLS: it runs and is operated, and nobody without a certificate links to it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from aeroloop.service.testing.hil import Hil
from aeroloop.service.testing.process_group import free_rendezvous
from tests.hil.test_faults import PATIENT
from tests.support.certificates import Authority
from tests.support.zenoh_network import eventually


@pytest.mark.smoke
def test_a_secured_loop_runs_and_is_operated_with_certificates_only(hil: Hil, tmp_path: Path) -> None:
    ours, foreign = Authority(tmp_path / "ours"), Authority(tmp_path / "foreign")
    ours.issue("plant", "aero")
    ours.issue("controller", "aero")
    for role in ("recorder", "operator"):
        ours.issue(role)
        foreign.issue(role)
    secured = free_rendezvous("tls")
    keys = {"network.security.directory": str(ours.folder), "network.rendezvous": secured}
    hil.start(settings={**PATIENT, **keys})
    hil.run(3.0)  # beyond the first look at the places, which must not disturb the loop

    def op(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-P", "-m", "aeroloop", "op", *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    def keyed(folder: Path) -> list[str]:
        return ["--set", f"network.security.directory={folder}", "--set", f"network.rendezvous={secured}"]

    states = {"controller": "running", "plant": "driven", "recorder": "recording"}

    def well() -> bool:
        found = json.loads(op("status", "--json", *keyed(ours.folder)).stdout or "{}").get("aero", {})
        assert all(status["certificate_until"] for status in found.values())
        return {role: status["state"] for role, status in found.items()} == states

    eventually("the status of all", well)  # on a busy machine a link may take longer than a command waits, 0.5 s
    strangers = {
        "foreign": keyed(foreign.folder),
        "none": ["--set", f"network.rendezvous={secured.replace('tls', 'tcp')}"],
    }
    for words in strangers.values():
        refused = op("stop", *words)
        assert refused.returncode == 1
        assert len(refused.stderr.splitlines()) == 1
        assert "Traceback" not in refused.stderr
    assert "not of this authority" in op("status", *strangers["foreign"]).stderr
    assert not hil.happened("tripped", "")
    done = op("stop", *keyed(ours.folder))
    assert done.returncode == 0, done.stderr
    hil.eventually("the stop", lambda: hil.happened("tripped", "stopped by an operator"))

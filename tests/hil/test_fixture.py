"""The `hil` fixture from outside: verbs in lockstep repeat, and a failed test leaves evidence. Lockstep: no slack."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from aeroloop.protocol.messages.operator import Hold
from aeroloop.service.lab.fork import fork
from aeroloop.service.testing.hil import Hil, HilError

pytest_plugins = ["pytester"]

OUTCOMES = """
import pytest

def test_that_passes(hil):
    hil.start()
    hil.run(0.2)

def test_that_fails(hil):
    hil.start()
    hil.run(0.2)
    hil.inject("rate:off")
    hil.run(0.4)
    assert hil.state("plant") == "driven"

@pytest.mark.xfail(reason="this sample shows that an expected failure leaves no page")
def test_that_is_expected_to_fail(hil):
    hil.start()
    raise ValueError

def test_that_fails_before_start(hil):
    hil.run(1)
"""


def test_a_failed_test_names_its_page_events_and_output_and_a_passed_one_has_no_page(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(OUTCOMES)
    result = pytester.runpytest_subprocess("--hil-lockstep", "-n1", "-p", "no:cacheprovider", timeout=300)
    result.assert_outcomes(passed=1, failed=2, xfailed=1)
    said = result.stdout.str()
    # What is wrong, by its public name, at the test's line: not our code.
    assert re.search(r"^E +aeroloop\.HilError: nothing was started", said, re.MULTILINE)
    assert ">       hil.run(1)" in said
    assert "process_group.py:" not in said
    assert "hil.py:" not in said
    named = [Path(path) for path in re.findall(r"^(/\S+): (?:the |\d+ events|output)", said, re.MULTILINE)]
    outputs = [f"hil-0/{role}.txt" for role in ("controller", "plant", "recorder")]
    assert [path.name for path in named] == ["hil-0.mcap", "hil-0-events.txt", "hil-0.html", *(o[6:] for o in outputs)]
    assert all(path.stat().st_size for path in named)
    folder = named[0].parent
    assert "tripped" in (folder / "hil-0-events.txt").read_text()
    assert "the sensors have had no valid value" in (folder / "hil-0/plant.txt").read_text()
    assert list(folder.parent.rglob("*.html")) == [folder / "hil-0.html"]


def operated(folder: Path) -> tuple[list[object], list[float]]:
    with Hil(folder, lockstep=True) as hil:
        hil.start(settings={"reference": {"kind": "hold"}, "loop": {"rate_hz": 200}})
        hil.goto(0, 0, 0, in_s=1)  # before the first tick
        hil.run(0.5)
        assert "follows roll, pitch, yaw 0°, -10°, 20°" in hil.goto(0, -10, 20, in_s=1)
        hil.run(1.0)
        assert "C2" in hil.set_gains(C2=(0.2, 0.2, 0.2))
        hil.track({"kind": "sinusoid", "amplitude": (0, 5, 5)}, in_s=2)
        hil.run(0.5)
        with pytest.raises(HilError, match="rad/s"):
            hil.goto(0, 0, 170, in_s=0.5)
        with pytest.raises(HilError, match="reference"):
            hil.track({"kind": "nonsense"})
        hil.release()
        hil.eventually("the release", lambda: hil.state("plant") == "idle")
        log = hil.log
        with pytest.raises(HilError, match="the run has ended"):
            hil.run(1)
    changes: list[object] = [change.model_dump(exclude={"session"}) for change in log.changes]
    figures = log.figures
    return changes, [figures.duration_s, figures.z_track, figures.u_total]


def test_verbs_in_lockstep_hold_from_the_next_tick_and_repeat_bit_for_bit(tmp_path: Path) -> None:
    changes, figures = operated(tmp_path / "a")
    assert [(change["tick"], change["reference"] is not None) for change in changes if isinstance(change, dict)] == [
        (0, True), (0, True), (100, True), (300, False), (300, True),
    ]  # fmt: skip
    assert isinstance(changes[2], dict)
    assert Hold.model_validate(changes[2]["reference"]).attitude == (0.0, -10.0, 20.0)
    assert figures[0] == 2.0
    assert operated(tmp_path / "b") == (changes, figures)


@pytest.mark.parametrize("fault", ["delay=0.02@0.1..0.5", "reorder=0.3"])
def test_in_lockstep_measurements_that_a_fault_holds_back_are_all_taken_in_order(tmp_path: Path, fault: str) -> None:
    """So the run repeats: a fork from an instant with frames in flight gives the same frames."""
    with Hil(tmp_path, lockstep=True) as hil:
        hil.start(settings={"plant.faults": [f"measurement:{fault}"]})
        hil.run(0.8)
        log = hil.log
    assert log.trips == []
    again = fork([log.path], 100)
    assert (again.parts, again.differed, again.ended) == (None, None, None)
    assert again.compared > 250

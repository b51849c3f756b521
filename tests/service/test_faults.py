"""Sensor and motor faults in lockstep in one process: the response of the loop, each with its bound.

A fault that the loop cannot ride out ends at 0 V with its cause named. For the others the bound is twice the measured
value, so that another random number does not break it, and far below that of a diverging loop.
"""

from __future__ import annotations

import pytest

from aeroloop.service.config import load
from aeroloop.service.figures import Figures
from aeroloop.service.lab.experiment import run_experiment

ONSET_S = 3.0


def run(fault: str, seconds: float = 20.0) -> Figures:
    return run_experiment(load(overrides=[f'plant.faults=["{fault}"]']), seconds)


@pytest.mark.parametrize(
    ("fault", "cause", "within_s"),
    [
        ("attitude:off", "the sensors have had no valid value for 102 ms", 0.104),
        ("attitude:garble=0.02", "tilted by", 1.0),
        ("motor1:off", "a motor has been at its voltage limit", 5.0),
        ("rate:stuck", "tilted by", 15.0),
    ],
)
def test_what_cannot_be_ridden_out_ends_at_zero_volts_with_its_cause(fault: str, cause: str, within_s: float) -> None:
    with pytest.raises(ValueError, match=cause) as ended:
        run(f"{fault}@{ONSET_S:g}")
    seconds = float(str(ended.value).split("after ")[1].split(" s:")[0])
    assert ONSET_S < seconds <= ONSET_S + within_s


@pytest.mark.parametrize(
    ("fault", "bound"),
    [
        ("attitude:drop=0.2", 62e-4),  # 20e-4 without a fault
        ("rate:garble=0.02", 46e-4),
        ("motor1:bias=5", 67e-4),
        ("motors:delay=0.05", 206e-4),
    ],
)
def test_what_can_be_ridden_out_is(fault: str, bound: float) -> None:
    figures = run(f"{fault}@{ONSET_S:g}")
    assert figures.duration_s == 20.0
    assert figures.z_track is not None
    assert 20e-4 < figures.z_track < bound


def test_a_fault_that_is_over_leaves_the_loop_as_good_as_before() -> None:
    assert (run("rate:bias=0.5@3..5", 10.0).final_error_deg or 99) < 1.0  # 0.5 without, 12 with it


def test_faults_on_frames_are_refused_where_no_network_is() -> None:
    with pytest.raises(ValueError, match="demo --lockstep"):
        run("command:drop=0.1", 1.0)

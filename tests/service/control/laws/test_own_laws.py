"""A user's law in the controller: as expressions and in Python, with its state and gains, and where it fails."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import isnan
from pathlib import Path
from random import Random
from typing import Any, get_args

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.operator import Gains, Hold, Sinusoid
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller, ControllerSnapshot
from aeroloop.service.control.laws.interface import gravity_torque, voltages_for
from tests.service.control.test_tick import frames
from tests.support import failing_laws
from tests.support.failing_laws import FAILING, Failure
from tests.support.own_laws import EXPRESSIONS, HERE, PYTHON

PERIOD = 0.002
CONTINUOUS = WireSpec(actuators=3).with_bits("cont/cont")


def controller(kind: str, *overrides: str, wire: WireSpec = CONTINUOUS, still: bool = False) -> Controller:
    law = load(overrides=[f"law.kind={kind}", *overrides]).law
    return Controller(wire, law, Hold(attitude=(0.0, 0.0, 0.0)) if still else Sinusoid(), PERIOD)


@pytest.mark.parametrize("kind", [EXPRESSIONS, PYTHON])
def test_a_law_gets_what_is_received_and_gives_what_is_sent(kind: str) -> None:
    """A body that has yawed, by hand: e = (cos, 0, 0, sin) of half the angle, and the rate is that of the body."""
    one = controller(kind, "law.kp=10", "law.ki=4", still=True)
    half, rate = 0.1, (0.01, -0.02, 0.03)
    codes = [*(CONTINUOUS.attitude.quantizer().encode(x) for x in (0.0, 0.0, np.sin(half)))]
    codes += [CONTINUOUS.rate.quantizer().encode(x) for x in rate]
    sums = 0.0
    for k in range(5):
        frame = one.tick(CONTINUOUS.measurement.pack(k, codes), k)
        sums += PERIOD * np.sin(half)
        expected = -5.0 * rate[0], -6.0 * rate[1], -10 * np.sin(half) - 7.0 * rate[2] - 4 * sums
        assert one.voltages == pytest.approx(expected, rel=1e-14)  # a dozen operations
        assert frame is not None
        read = CONTINUOUS.command.unpack(frame)
        assert read is not None
        assert read == (k, one.voltages)
    assert one.law_state == {"sum": (0.0, 0.0, pytest.approx(sums)), "sign": (1.0,)}


@settings(max_examples=15)
@given(
    bits=st.sampled_from([None, 6, 12]),
    actuators=st.sampled_from([2, 3]),
    pair=st.sampled_from([(EXPRESSIONS, PYTHON), (f"{HERE}:Bare", f"{HERE}:BarePython")]),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_law_in_python_has_the_bytes_of_the_same_law_of_expressions(
    bits: int | None, actuators: int, pair: tuple[str, str], seed: int
) -> None:
    """Also with gains that change, and where its state goes through JSON into another controller."""
    random = Random(seed)
    wire = WireSpec(actuators=actuators, voltage=SignalSpec(bits=bits, limit=24.0))
    both = [controller(kind, wire=wire) for kind in pair]
    for k, frame in enumerate(frames(wire, random, 80)):
        if random.random() < 0.1 and both[0].gains.named:
            given = Gains(kp=random.uniform(0, 20)) if random.random() < 0.5 else Gains(kd=(1.0, 2.0, 3.0), ki=0.5)
            for one in both:
                one.set_gains(given)
        if random.random() < 0.1:
            state = ControllerSnapshot.model_validate_json(both[0].state.model_dump_json())
            fresh = controller(pair[1], wire=wire)
            fresh.set_gains(both[0].gains)
            fresh.restore(state)
            both[1] = fresh
        expressed, plain = (one.tick(frame, k) for one in both)
        assert expressed == plain
        assert both[0].state == both[1].state
        assert both[0].gains == both[1].gains


def test_a_state_that_is_not_the_laws_is_not_taken() -> None:
    one = controller(EXPRESSIONS)
    one.restore(ControllerSnapshot(law={"sum": (1.0,), "sign": (-1.0,), "damping_estimate": (1.0, 2.0, 3.0)}))
    assert one.law_state == {"sum": (0.0, 0.0, 0.0), "sign": (-1.0,)}


# Laws that fail

WHY = {
    "raises": f"law {FAILING}:Failing: RuntimeError: the estimator diverged (failing_laws.py, line {{line}})",
    "gives NaN": f"law {FAILING}:Failing gave no number (failing_laws.py, line {{step}})",
    "gives one voltage": "it gives 1 voltages for 3 actuators",
    "another shape": "its state after a tick is ticks of 2, and its first state is ticks of 1",
    "another name": "its state after a tick is tocks of 1, and its first state is ticks of 1",
    "gives no number": "ValueError: could not convert string to float: 'much'",
}


@pytest.mark.parametrize("failure", get_args(Failure))
def test_a_law_that_fails_commands_no_valid_value_and_says_why_in_one_line(failure: Failure) -> None:
    lines = Path(failing_laws.__file__).read_text().splitlines()
    line = 1 + next(i for i, text in enumerate(lines) if "raise RuntimeError" in text)
    one = controller(f"{FAILING}:Failing", f"law.failure={failure}")
    for k in range(6):
        frame = one.tick(CONTINUOUS.measurement.pack(k, [0.0] * 6), k)
        assert frame is not None
        read = CONTINUOUS.command.unpack(frame)
        assert read is not None
        assert read[0] == k
        # What raises has not counted the tick, so it is there again.
        assert [isnan(u) for u in read[1]] == [k == 3 if failure == "gives NaN" else k >= 3] * 3
        assert (one.fault is not None) == (k >= 3)
    assert one.fault is not None
    step = failing_laws.Failing.step.__code__.co_firstlineno
    assert WHY[failure].format(line=line, step=step) in one.fault
    assert len(one.fault.splitlines()) == 1


def test_helpers_of_a_law_give_arrays_for_numbers_and_expressions_for_expressions() -> None:
    """Whether the numbers are an array or a list, and for as many motors as there are."""
    law, q, torque = Settings().law, [0.8, -0.2, 0.4, 0.4], [0.0, 0.004, -0.003]
    helpers: list[tuple[Callable[[Any], Any], list[float]]] = [(partial(gravity_torque, law), q)]
    helpers += [(partial(voltages_for, law, actuators=motors), torque) for motors in (2, 3)]
    for helper, numbers in helpers:
        x = ca.SX.sym("x", len(numbers))
        expected = np.asarray(ca.Function("helper", [x], [helper(x)])(numbers)).ravel()
        for argument in (numbers, np.array(numbers)):
            assert isinstance(helper(argument), np.ndarray)
            assert helper(argument) == pytest.approx(expected, rel=1e-12)  # of B: another way to solve

"""A user's law: found by its name, its settings checked, its gains bounded, its state kept; and where it fails."""

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
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller, ControllerSnapshot
from aeroloop.service.control.laws.interface import gravity_torque, voltages_for
from aeroloop.service.control.laws.registry import LawError, gains_of, law_of, with_gains
from aeroloop.service.lab.experiment import experiment
from tests.support import failing_laws, own_laws
from tests.support.failing_laws import FAILING, Failure
from tests.support.own_laws import EXPRESSIONS, HERE, PYTHON, Expressions

PERIOD = 0.002
CONTINUOUS = WireSpec(actuators=3).with_bits("cont/cont")


def law(kind: str, *overrides: str) -> Any:
    settings = load(overrides=[f"law.kind={kind}", *overrides])
    return law_of(settings.law, PERIOD, settings.wire.actuators)


def refused(kind: str, *overrides: str) -> str:
    with pytest.raises((LawError, PluginError)) as error:
        law(kind, *overrides)
    (line,) = str(error.value).splitlines()
    return line


def controller(kind: str, *overrides: str, wire: WireSpec = CONTINUOUS, still: bool = False) -> Controller:
    law = load(overrides=[f"law.kind={kind}", *overrides]).law
    return Controller(wire, law, Hold(attitude=(0.0, 0.0, 0.0)) if still else Sinusoid(), PERIOD)


def measurement(wire: WireSpec, k: int, *values: float) -> bytes:
    quantizers = [signal.quantizer() for signal in (wire.attitude, wire.rate) for _ in range(3)]
    codes = [quantizer.encode(value) for quantizer, value in zip(quantizers, values, strict=True)]
    return wire.measurement.pack(k % wire.measurement.counters, codes)


def test_a_users_law_has_its_own_settings_checked_by_its_own_model() -> None:
    found = law(EXPRESSIONS, "law.kp=7", "law.mass=2")
    assert type(found) is Expressions
    assert (found.settings.kp, found.settings.kd, found.settings.mass) == (7.0, (5.0, 6.0, 7.0), 2.0)
    assert gains_of(found.settings) == Gains(kp=7, kd=(5, 6, 7), ki=3)
    for override, key in (("kpp=1", "did you mean law.kp"), ("kp=20.5", "law.kp"), ("kd=[1, 2]", "law.kd")):
        assert key in refused(EXPRESSIONS, f"law.{override}")


def test_a_laws_keys_hold_whether_they_are_given_before_or_after_its_kind() -> None:
    given = ["law.kind=pd", "law.damping_bound=0.02", "law.kp=[1, 2, 3]"]
    assert load(overrides=given).law == load(overrides=given[::-1]).law
    assert load(overrides=given[::-1]).law.model_dump()["kp"] == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("adaptve", "law.kind = 'adaptve' is not known: it is one of adaptive, "),
        (f"{HERE}:Pd", f"{HERE} has no Pd; its classes of aeroloop.Law are Expressions, "),
        (f"{FAILING}:NoLaw", "does not derive from aeroloop.Law"),
        ("their_lab.laws:PD", "there is no module their_lab here; install it, or add its folder to PYTHONPATH"),
        (f"{FAILING}:Picky", f"law {FAILING}:Picky: ValueError: flies with eight motors only (failing_laws.py, line "),
    ],
)
def test_a_law_that_is_not_there_or_is_none_is_refused_in_one_line(kind: str, why: str) -> None:
    assert why in refused(kind)


@pytest.mark.parametrize(
    ("mistake", "why", "at"),
    [
        ("width", "ValueError: it gives 1 voltages for 2 actuators", "def expressions"),
        ("state", "ValueError: its state after a tick is sum of 3, and its first state is sum of 2", "def expressions"),
        ("no such vector", "AttributeError: 'Now' object has no attribute 'speed'", "# no such vector"),
    ],
)
def test_a_first_mistake_in_expressions_is_one_line_with_class_file_and_line(mistake: str, why: str, at: str) -> None:
    """Before the first tick, in the controller and in an experiment that compiles the whole loop."""
    own = load(overrides=[f"law.kind={FAILING}:Mistaken", f"law.mistake={mistake}"])
    lines = Path(failing_laws.__file__).read_text().splitlines()
    begins = lines.index("class Mistaken(ExpressionLaw[MistakenSettings]):")
    line = 1 + next(i for i in range(begins, len(lines)) if at in lines[i])
    for start in (lambda: Controller(own.wire, own.law, own.reference, PERIOD), lambda: experiment(own, 0.1)):
        with pytest.raises(LawError) as error:
            start()
        assert str(error.value).startswith(f"law {FAILING}:Mistaken: {why}")
        assert str(error.value).endswith(f"(failing_laws.py, line {line})")
        assert len(str(error.value).splitlines()) == 1


def test_gains_are_bounded_by_the_law_and_it_has_no_others() -> None:
    section = load(overrides=[f"law.kind={PYTHON}"]).law
    assert gains_of(with_gains(section, Gains(kp=0, kd=None))) == Gains(kp=0, kd=(5, 6, 7), ki=3)
    for law, gains, why in (
        (section, Gains(mass=1), "has no gain mass; it has kp, kd, ki"),
        (section, Gains(kp=21), r"law\.kp"),
        (section, Gains(kd=(1, 1, -1)), r"law\.kd"),
        (load(overrides=[f"law.kind={HERE}:Bare"]).law, Gains(kp=1), "none that may change while it runs"),
        (load().law, Gains(C1=(0.3, 0.0, 0.3)), r"law\.C1\[1\]: should be greater than 0"),
    ):
        with pytest.raises(LawError, match=why):
            with_gains(law, gains)


SOURCE = """from aeroloop import LawSettings, PythonLaw
class Lab(PythonLaw[LawSettings]):
    Settings = LawSettings
    def reset(self): self.state = {}
    def step(self, now): return [0.0, 0.0]
"""


def test_a_module_of_the_current_folder_is_found_and_its_faults_are_in_its_own_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [path for path in __import__("sys").path if path])
    (tmp_path / "lab_lab.py").write_text(SOURCE)
    assert type(law("lab_lab:Lab")).__name__ == "Lab"
    (tmp_path / "lab_raises.py").write_text("\n\nraise OSError('no licence')\n")
    assert "its module raised OSError: no licence (lab_raises.py, line 3)" in refused("lab_raises:Lab")
    (tmp_path / "lab_needs.py").write_text("import lab_not_installed\n")
    assert "there is no module lab_not_installed here; install it" in refused("lab_needs:Lab")


def test_a_law_gets_what_is_received_and_gives_what_is_sent() -> None:
    """A body that has yawed, by hand: e = (cos, 0, 0, sin) of half the angle, and the rate is that of the body."""
    one = controller(EXPRESSIONS, "law.kp=10", "law.ki=4", still=True)
    half, rate = 0.1, (0.01, -0.02, 0.03)
    sums = 0.0
    for k in range(5):
        frame = one.tick(measurement(CONTINUOUS, k, 0.0, 0.0, np.sin(half), *rate), k)
        sums += PERIOD * np.sin(half)
        expected = -5.0 * rate[0], -6.0 * rate[1], -10 * np.sin(half) - 7.0 * rate[2] - 4 * sums
        assert one.voltages == pytest.approx(expected, rel=1e-14)  # a dozen operations
        assert frame is not None
        assert CONTINUOUS.command.unpack(frame) == (k, one.voltages)
    assert one.law_state == {"sum": (0.0, 0.0, pytest.approx(sums)), "sign": (1.0,)}


@settings(max_examples=15)
@given(bits=st.sampled_from([None, 6, 12]), actuators=st.sampled_from([2, 3]), seed=st.integers(0, 2**32 - 1))
def test_a_law_in_python_has_the_bytes_of_the_same_law_of_expressions(
    bits: int | None, actuators: int, seed: int
) -> None:
    """Also with gains that change, and where its state goes through JSON into another controller."""
    random = Random(seed)
    wire = WireSpec(actuators=actuators, voltage=SignalSpec(bits=bits, limit=24.0))
    both = [controller(kind, wire=wire) for kind in (EXPRESSIONS, PYTHON)]
    for k in range(40):
        if random.random() < 0.06:
            given = Gains(kp=random.uniform(0, 20)) if random.random() < 0.5 else Gains(kd=(1.0, 2.0, 3.0), ki=0.5)
            for one in both:
                one.set_gains(given)
        if random.random() < 0.06:
            state = ControllerSnapshot.model_validate_json(both[0].state.model_dump_json())
            fresh = controller(PYTHON, wire=wire)
            fresh.set_gains(both[0].gains)
            fresh.restore(state)
            both[1] = fresh
        frame = measurement(wire, k, *(random.choice([random.uniform(-0.6, 0.6), 0.0, -0.0, 1.0]) for _ in range(6)))
        expressed, plain = (one.tick(frame, k) for one in both)
        assert expressed == plain
        assert both[0].state == both[1].state
        assert both[0].gains == both[1].gains


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


def test_a_law_that_fails_keeps_the_state_that_it_had() -> None:
    """That of a log it continues, even at the first tick."""
    one = controller(f"{FAILING}:Failing", "law.failure=raises", "law.at=7")
    one.restore(one.state.model_copy(update={"law": {"ticks": (7.0,)}}))
    one.tick(measurement(CONTINUOUS, 0, *[0.0] * 6), 0)
    assert one.fault is not None
    assert one.law_state == {"ticks": (7.0,)}


WHY = {
    "raises": f"law {FAILING}:Failing: RuntimeError: the estimator diverged (failing_laws.py, line {{line}})",
    "gives NaN": f"law {FAILING}:Failing gave no number (failing_laws.py, line {{step}})",
    "gives one voltage": "it gives 1 voltages for 3 actuators",
    "another shape": "its state after a tick is ticks of 2, and its first state is ticks of 1",
}


@pytest.mark.parametrize("failure", get_args(Failure))
def test_a_law_that_fails_commands_no_valid_value_and_says_why_in_one_line(failure: Failure) -> None:
    lines = Path(failing_laws.__file__).read_text().splitlines()
    line = 1 + next(i for i, text in enumerate(lines) if "raise RuntimeError" in text)
    one = controller(f"{FAILING}:Failing", f"law.failure={failure}")
    for k in range(6):
        frame = one.tick(measurement(CONTINUOUS, k, *[0.0] * 6), k)
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


def test_a_law_that_fails_keeps_the_state_that_it_had_in_a_session_that_is_continued_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ran, continued = controller(PYTHON, still=True), controller(PYTHON, still=True)
    for k in range(5):
        ran.tick(measurement(CONTINUOUS, k, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0), k)
    assert any(ran.law_state["sum"])
    continued.restore(ran.state)

    def fails(law: Any, _: Any) -> None:
        law.state["sum"] = law.state["sum"] + 1.0
        raise RuntimeError("the estimator diverged")

    monkeypatch.setattr(own_laws.Python, "step", fails)
    continued.tick(measurement(CONTINUOUS, 5, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0), 5)
    assert "the estimator diverged" in (continued.fault or "")
    assert continued.law_state == ran.law_state
    assert continued.tick_index == 5

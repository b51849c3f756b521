"""Which law a configuration names: found, its settings checked, its gains bounded; and what is said where it is not."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from aeroloop.protocol import plugins
from aeroloop.protocol.messages.operator import Gains
from aeroloop.protocol.plugins import PluginError
from aeroloop.service.config import load
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.adaptive import Adaptive
from aeroloop.service.control.laws.registry import LawError, gains_of, law_of, law_settings, with_gains
from aeroloop.service.lab.experiment import experiment
from tests.support import failing_laws
from tests.support.failing_laws import FAILING
from tests.support.own_laws import EXPRESSIONS, HERE, PYTHON, Expressions


def law(kind: str, *overrides: str) -> Any:
    settings = load(overrides=[f"law.kind={kind}", *overrides])
    return law_of(settings.law, 0.002, settings.wire.actuators)


def refused(kind: str, *overrides: str) -> str:
    """The one line that a user gets."""
    with pytest.raises((LawError, PluginError)) as error:
        law(kind, *overrides)
    (line,) = str(error.value).splitlines()
    return line


def test_a_users_law_has_its_own_settings_checked_by_its_own_model() -> None:
    found = law(EXPRESSIONS, "law.kp=7", "law.mass=2")
    assert type(found) is Expressions
    assert (found.settings.kp, found.settings.kd, found.settings.mass) == (7.0, (5.0, 6.0, 7.0), 2.0)
    assert gains_of(found.settings) == Gains(kp=7, kd=(5, 6, 7), ki=3)
    for override, key in (("kpp=1", "did you mean law.kp"), ("kp=20.5", "law.kp"), ("kd=[1, 2]", "law.kd")):
        assert key in refused(EXPRESSIONS, f"law.{override}")


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("adaptve", "law.kind = 'adaptve' is not known: it is one of adaptive, "),
        (f"{HERE}:Pd", f"{HERE} has no Pd; its classes of aeroloop.Law are Expressions, "),
        (f"{FAILING}:NoLaw", "does not derive from aeroloop.Law"),
        (f"{FAILING}:NoSettings", "has no Settings that derive from aeroloop.LawSettings (failing_laws.py, line "),
        (f"{HERE}:", "does not name a class"),
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
        ("one value", "TypeError: it gives one value, not two: the voltages, and the state", "def expressions"),
        ("iterates", "TypeError: CasADi matrices are not iterable by design", "# iterates"),
        ("no such setting", "'MistakenSettings' object has no attribute 'kz'", "# no such setting"),
        ("no such vector", "AttributeError: 'Now' object has no attribute 'speed'", "# no such vector"),
        ("initial", "TypeError: 'float' object is not iterable", "def initial"),
        ("gain", "LawSettings' object has no attribute 'kz'", "class NoSuchGain"),
    ],
)
def test_a_first_mistake_in_expressions_is_one_line_with_class_file_and_line(mistake: str, why: str, at: str) -> None:
    """Before the first tick, in the controller and in an experiment that compiles the whole loop."""
    kind = f"{FAILING}:{'NoSuchGain' if mistake == 'gain' else 'Mistaken'}"
    own = load(overrides=[f"law.kind={kind}", *([] if mistake == "gain" else [f"law.mistake={mistake}"])])
    lines = Path(failing_laws.__file__).read_text().splitlines()
    begins = lines.index("class Mistaken(ExpressionLaw[MistakenSettings]):")
    line = 1 + next(i for i in range(begins, len(lines)) if at in lines[i])
    for start in (lambda: Controller(own.wire, own.law, own.reference, 0.002), lambda: experiment(own, 0.1)):
        with pytest.raises(LawError) as error:
            start()
        assert f"law {kind}: " in str(error.value)
        assert why in str(error.value)
        assert str(error.value).endswith(f"(failing_laws.py, line {line})")
        assert len(str(error.value).splitlines()) == 1


def test_gains_are_bounded_by_the_law_and_it_has_no_others() -> None:
    section = load(overrides=[f"law.kind={PYTHON}"]).law
    assert gains_of(with_gains(section, Gains(kp=0, kd=None))) == Gains(kp=0, kd=(5, 6, 7), ki=3)
    paper, bare = load().law, load(overrides=[f"law.kind={HERE}:Bare"]).law
    for law, gains, why in (
        (section, Gains(kq=1), "has no gain kq; it has kp, kd, ki"),
        (section, Gains(mass=1), "has no gain mass"),
        (section, Gains(kp=21), r"law\.kp"),
        (section, Gains(kp=(1, 1)), r"law\.kp"),
        (section, Gains(kd=1), r"law\.kd"),
        (section, Gains(kd=(1, 1, -1)), r"law\.kd"),
        (bare, Gains(kp=1), "none that may change while it runs"),
        (paper, Gains(C1=(0.3, 0.0, 0.3)), r"law\.C1\[1\]: should be greater than 0"),
        (paper, Gains(Gamma=(20.001, 1.0, 1.0)), r"law\.Gamma\[0\]: should be less than or equal to 20"),
    ):
        with pytest.raises(LawError, match=why):
            with_gains(law, gains)


def test_an_entry_point_of_the_group_is_found_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def installed(*, group: str) -> list[EntryPoint]:
        return [EntryPoint("ours", EXPRESSIONS, group)] if group == "aeroloop.laws" else []

    monkeypatch.setattr(plugins, "entry_points", installed)
    assert type(law("ours")) is Expressions
    assert ", ours, " in refused("theirs")
    assert type(law("adaptive")) is Adaptive
    assert law_settings(load(overrides=["law.kind=ours"]).law).kind == "ours"


SOURCE = """from aeroloop.service.control.laws.interface import LawSettings, PythonLaw
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
    (tmp_path / "lab_syntax.py").write_text("x = (\n")
    assert "SyntaxError: '(' was never closed (lab_syntax.py, line 1)" in refused("lab_syntax:Lab")
    (tmp_path / "lab_needs.py").write_text("import lab_not_installed\n")
    assert "there is no module lab_not_installed here; install it" in refused("lab_needs:Lab")

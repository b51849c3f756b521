"""Files of a user: fields applied and refused when a configuration is reloaded, errors in a table of set-points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Points
from aeroloop.protocol.runtime.role import Action, Role
from aeroloop.service.config import Settings, load
from aeroloop.service.daemon.reload import LIVE, differences, reload_on_hangup
from aeroloop.service.points_file import PointsError, read_points
from aeroloop.service.theorem.configured import with_theorem

ROLES = ("controller", "plant", "recorder")


def changed(role: str, *overrides: str, before: tuple[str, ...] = ()) -> list[str]:
    """What a role says of a configuration that differs by some overrides."""
    return differences(load(overrides=before), load(overrides=[*before, *overrides]), role)


@pytest.mark.parametrize("role", ROLES)
def test_a_configuration_that_is_the_same_reports_nothing(role: str) -> None:
    assert changed(role) == []
    assert changed(role, "law.C1=[0.3, 0.3, 0.3]", "loop.rate_hz=500") == []


@pytest.mark.parametrize(
    ("role", "override", "line"),
    [
        ("controller", "law.C1=[1.0, 1.0, 1.0]", "law.C1: [0.3, 0.3, 0.3] → [1.0, 1.0, 1.0]"),
        ("controller", "law.C2=[1.0, 1.0, 1.0]", "law.C2: [0.15, 0.15, 0.15] → [1.0, 1.0, 1.0]"),
        ("controller", "law.Gamma=[1.0, 1.0, 1.0]", "law.Gamma: [0.02, 0.02, 0.02] → [1.0, 1.0, 1.0]"),
        (
            "controller",
            "reference.amplitude=[0.0, 0.0, 1.0]",
            "reference.amplitude: [0.0, 40.0, 100.0] → [0.0, 0.0, 1.0]",
        ),
        ("controller", "controller.stale_s=0.2", "controller.stale_s: 0.1 → 0.2"),
        ("controller", "controller.telemetry_rate_hz=5", "controller.telemetry_rate_hz: 10.0 → 5.0"),
        ("controller", "controller.max_reference_rate=2", "controller.max_reference_rate: 1.0 → 2.0"),
        ("controller", "controller.max_reference_tilt_deg=9", "controller.max_reference_tilt_deg: 60.0 → 9.0"),
        ("controller", "controller.auto_arm=true", "controller.auto_arm: False → True"),
        (
            "controller",
            "controller.require_certificate=true",
            "controller.require_certificate: False → True",
        ),
        ("plant", "plant.limits.max_tilt_deg=10", "plant.limits.max_tilt_deg: 75.0 → 10.0"),
        ("plant", "plant.watchdog_s=0.2", "plant.watchdog_s: 0.1 → 0.2"),
        ("plant", "plant.truth_rate_hz=5", "plant.truth_rate_hz: 10.0 → 5.0"),
        ("recorder", "recorder.chunk_s=2", "recorder.chunk_s: 1.0 → 2.0"),
    ],
)
def test_what_takes_effect_at_once_is_reported_with_old_and_new_value(role: str, override: str, line: str) -> None:
    assert changed(role, override) == [line]


@pytest.mark.parametrize(
    ("role", "override", "line"),
    [
        ("controller", "law.mass=2", "law.mass: 1.075 → 2.0, after a restart"),
        ("controller", "loop.rate_hz=100", "loop.rate_hz: 500.0 → 100.0, after a restart"),
        ("controller", "wire.rate.bits=10", "wire.rate.bits: 8 → 10, after a restart"),
        ("controller", 'wire.rate.bits="cont"', "wire.rate.bits: 8 → None, after a restart"),
        ("controller", "vehicle=other", "vehicle: aero → other, after a restart"),
        ("controller", "network.lease_ms=500", "network.lease_ms: 1000 → 500, after a restart"),
        ("controller", "controller.duration_s=5", "controller.duration_s: None → 5.0, after a restart"),
        ("plant", "plant.substeps=7", "plant.substeps: {} → 7, after a restart"),
        ("plant", "plant.aero.mass=2", "plant.aero.mass: {} → 2.0, after a restart"),
        ("recorder", "recorder.directory=elsewhere", "recorder.directory: logs → elsewhere, after a restart"),
    ],
)
def test_what_does_not_is_reported_to_need_a_restart(role: str, override: str, line: str) -> None:
    (reported,) = changed(role, override)
    start, _, end = line.partition("{}")
    assert reported.startswith(start)
    assert reported.endswith(end)


@pytest.mark.parametrize(
    ("override", "concerns"),
    [
        ("vehicle=other", {"controller", "plant", "recorder"}),
        ("network.lease_ms=500", {"controller", "plant", "recorder"}),
        ("loop.rate_hz=100", {"controller", "plant"}),
        ("wire.rate.bits=10", {"controller", "plant"}),
        ("law.C1=[1.0, 1.0, 1.0]", {"controller"}),
        ("reference.kind=hold", {"controller"}),
        ("controller.stale_s=0.2", {"controller"}),
        ("plant.watchdog_s=0.2", {"plant"}),
        ("recorder.chunk_s=2", {"recorder"}),
    ],
)
def test_a_role_reports_only_what_concerns_it(override: str, concerns: set[str]) -> None:
    assert {role for role in ROLES if changed(role, override)} == concerns


def test_another_kind_of_reference_is_reported_key_by_key_and_takes_effect_at_once() -> None:
    lines = changed("controller", "reference.kind=hold", "reference.attitude=[0.0, 1.0, 2.0]")
    assert "reference.kind: sinusoid → hold" in lines
    assert "reference.attitude: None → [0.0, 1.0, 2.0]" in lines
    assert {line.split(":")[0] for line in lines} == {
        "reference.kind",
        "reference.attitude",
        "reference.amplitude",
        "reference.frequency",
    }
    assert not any("restart" in line for line in lines)


def test_the_points_of_a_reference_are_counted_not_listed() -> None:
    times, attitudes = list(range(9)), [[0, 0, 0]] * 9
    lines = changed(
        "controller", "reference.kind=points", f"reference.times={times}", f"reference.attitudes={attitudes}"
    )
    assert "reference.times: None → 9 values" in lines


def test_several_differences_are_reported_a_line_each_in_order_and_each_for_itself() -> None:
    lines = changed("controller", "law.mass=2", "law.C1=[1.0, 1.0, 1.0]", "controller.stale_s=0.2")
    assert lines == [
        "controller.stale_s: 0.1 → 0.2",
        "law.C1: [0.3, 0.3, 0.3] → [1.0, 1.0, 1.0]",
        "law.mass: 1.075 → 2.0, after a restart",
    ]


@pytest.mark.parametrize("role", ROLES)
def test_every_key_that_is_said_to_take_effect_at_once_is_there(role: str) -> None:
    for name in LIVE[role]:
        tree: object = Settings().description()
        for part in name.split("."):
            assert isinstance(tree, dict)
            tree = tree[part]


class Hangup:
    """A role whose SIGHUP the test triggers."""

    role = "controller"

    def __init__(self) -> None:
        self.reload: Callable[[], Action] | None = None
        self.description: dict[str, Any] = {}
        self.certificate: dict[str, Any] | None = None
        self.reported: list[tuple[str, str]] = []

    def on_hangup(self, reload: Callable[[], Action]) -> None:
        """Keep it."""
        self.reload = reload

    def publish_description(self, config: dict[str, Any], certificate: dict[str, Any] | None) -> None:
        """Keep it."""
        self.description, self.certificate = config, certificate

    def event(self, kind: str, text: str) -> None:
        """Keep it."""
        self.reported.append((kind, text))

    def hang_up(self) -> None:
        """SIGHUP, and the time between two ticks after it."""
        assert self.reload is not None
        self.reload()()


def test_what_was_read_again_takes_effect_between_ticks_and_is_reported() -> None:
    role, taken = Hangup(), list[Settings]()
    reload_on_hangup(cast(Role, role), load(), lambda: load(overrides=["law.C1=[1.0, 1.0, 1.0]"]), taken.append)
    assert role.reload is not None
    act = role.reload()
    assert (taken, role.reported) == ([], [])  # reading takes time, so it is done elsewhere
    act()
    assert [with_theorem(settings).law.C1 for settings in taken] == [(1.0, 1.0, 1.0)]
    assert role.description["law"]["C1"] == [1.0, 1.0, 1.0]
    role.hang_up()
    assert role.reported == [
        ("changed", "configuration read again: law.C1: [0.3, 0.3, 0.3] → [1.0, 1.0, 1.0]"),
        ("changed", "configuration read again: nothing has changed"),
    ]


def test_what_needs_a_restart_is_not_in_the_description_before_it() -> None:
    role = Hangup()
    reload_on_hangup(cast(Role, role), load(), lambda: load(overrides=["law.mass=2"]), lambda _: None)
    role.hang_up()
    assert role.reported == [("changed", "configuration read again: law.mass: 1.075 → 2.0, after a restart")]
    assert role.description["law"]["mass"] == 1.075


def test_the_certificate_is_of_the_new_gains_and_computed_before_the_tick() -> None:
    role = Hangup()
    promised: list[float] = []

    def certificate_of(config: dict[str, Any]) -> dict[str, Any]:
        promised.append(config["law"]["C1"][0])
        return {"holds": False}

    reload_on_hangup(
        cast(Role, role), load(), lambda: load(overrides=["law.C1=[1.0, 1.0, 1.0]"]), lambda _: None, certificate_of
    )
    assert role.reload is not None
    act = role.reload()
    assert promised == [1.0]
    act()
    assert (promised, role.certificate) == ([1.0], {"holds": False})


def test_what_the_certificate_refuses_changes_nothing_and_may_be_read_again() -> None:
    role, taken = Hangup(), list[Settings]()

    def certificate_of(config: dict[str, Any]) -> None:
        if config["law"]["C1"][0] > 2:
            raise AeroloopError("no")

    configurations = iter((["law.C1=[3.0, 3.0, 3.0]"], ["law.C1=[1.0, 1.0, 1.0]"]))
    reload_on_hangup(
        cast(Role, role), load(), lambda: load(overrides=next(configurations)), taken.append, certificate_of
    )
    with pytest.raises(AeroloopError):
        role.hang_up()
    role.hang_up()
    assert [with_theorem(settings).law.C1[0] for settings in taken] == [1.0]
    assert role.reported == [("changed", "configuration read again: law.C1: [0.3, 0.3, 0.3] → [1.0, 1.0, 1.0]")]


# Points out of a file

ROWS = "0,0,0,0\n1.5,0,10,-20.5\n3e0,0,0,1\n"
POINTS = Points(times=[0.0, 1.5, 3.0], attitudes=[(0.0, 0.0, 0.0), (0.0, 10.0, -20.5), (0.0, 0.0, 1.0)])

File = Callable[[str | bytes], Path]


@pytest.fixture
def file(tmp_path: Path) -> File:
    """Write a file, to the byte."""

    def write(content: str | bytes) -> Path:
        path = tmp_path / "points.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize(
    "content",
    [
        ROWS,
        f"time,roll,pitch,yaw\n{ROWS}",
        f'"time [s]","roll [deg]","pitch [deg]","yaw [deg]"\n{ROWS}',
        f"t\n{ROWS}",
        ROWS.replace("\n", "\r\n"),
        ROWS.rstrip("\n"),
        ROWS.replace("\n", "\n\n"),
        ROWS.replace(",", ", "),
        ROWS.replace("1.5", '"1.5"'),
    ],
    ids=["bare", "heading", "quoted heading", "short heading", "CRLF", "no last newline", "gaps", "spaces", "quotes"],
)
def test_a_table_of_points_is_read_with_or_without_a_heading(file: File, content: str) -> None:
    assert read_points(file(content)) == POINTS


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("0,0,0,0\n1,0,0\n", 2),
        ("0,0,0,0\n1,0,0,0,0\n", 2),
        ("0,0,0,0\n1,0,up,0\n2,0,0,0\n", 2),
        ("time,roll,pitch,yaw\n0,0,0,0\n\n1,0,,0\n", 4),
        ("time,roll,pitch,yaw\nseconds,degrees,degrees,degrees\n0,0,0,0\n", 2),
        ("0;0;0;0\n1;0;0;0\n", 2),
        ("0,0,0\n1,0,0,0\n", 1),
        ("0,0,0,0\n   \n1,0,0,0\n", 2),
        ("0,0,0,0\n1,0,0,1'234\n", 2),
    ],
)
def test_a_row_that_is_none_is_reported_with_file_and_line(file: File, content: str, line: int) -> None:
    path = file(content)
    with pytest.raises(PointsError) as refused:
        read_points(path)
    text = str(refused.value)
    assert text.startswith(f"{path}, line {line}: expected four numbers (time [s], roll, pitch, yaw [deg])")
    assert len(text.splitlines()) == 1


BAD_TABLES = [
    pytest.param("", "has 0 points, and a reference 2 to", None, id="empty"),
    pytest.param("time,roll,pitch,yaw\n", "has 0 points, and a reference 2 to", None, id="a heading and no more"),
    pytest.param("0,0,0,0\n", "has 1 points, and a reference 2 to", None, id="one point"),
    pytest.param("1,0,0,0\n2,0,0,0\n", "the first time must be 0", 1, id="begins later"),
    pytest.param("0,0,0,0\n2,0,0,0\n1,0,0,0\n", "must rise", 3, id="falls"),
    pytest.param("0,0,0,0\n0,0,0,0\n", "must rise", 2, id="stands still"),
    pytest.param("0,0,0,0\nnan,0,0,0\n", "number", 2, id="a time that is no number"),
    pytest.param("0,0,0,0\n1,0,inf,0\n", "number", 2, id="an angle that is none"),
    pytest.param(
        "".join(f"{n},0,0,0\n" for n in range(10_001)),
        "has 10001 points, and a reference 2 to 10000",
        None,
        id="too many",
    ),
]


@pytest.mark.parametrize(("content", "why", "_line"), BAD_TABLES)
def test_a_table_that_makes_no_sense_is_reported_with_file_and_reason(
    file: File, content: str, why: str, _line: int | None
) -> None:
    path = file(content)
    with pytest.raises(PointsError, match=why) as refused:
        read_points(path)
    assert str(path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(("content", "why", "line"), [case for case in BAD_TABLES if case.values[2] is not None])
def test_a_table_that_makes_no_sense_is_reported_with_its_line(file: File, content: str, why: str, line: int) -> None:
    with pytest.raises(PointsError, match=f"line {line}: .*{why}"):
        read_points(file(content))


def test_a_file_that_is_not_there_or_cannot_be_read_is_named(tmp_path: Path, file: File) -> None:
    missing = tmp_path / "missing.csv"
    for path, why in [(missing, "No such file"), (tmp_path, "directory"), (file(b"0,0,0,0\n\xff\xfe,0,0,0\n"), "text")]:
        with pytest.raises(PointsError, match=why) as refused:
            read_points(path)
        assert str(path) in str(refused.value)
        assert len(str(refused.value).splitlines()) == 1


def test_a_cell_without_end_is_reported(file: File) -> None:
    with pytest.raises(PointsError, match="line 2"):
        read_points(file("0,0,0,0\n1,0,0," + "1" * 200_000 + "\n"))


def test_a_row_is_named_by_its_line_in_the_file(file: File) -> None:
    with pytest.raises(PointsError, match="line 4"):
        read_points(file('"time\n[s]",roll,pitch,yaw\n0,0,0,0\n1,0,0\n'))


def test_a_table_saved_by_a_spreadsheet_is_read(file: File) -> None:
    assert read_points(file("\ufeff" + ROWS)) == POINTS

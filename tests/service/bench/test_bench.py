"""Bench, with made items: figures as JSON and tables; a ratio beyond its margin, and nothing else, fails."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.bench.item import Figure, Item, Margin, NotMeasuredError, in_turns
from aeroloop.service.bench.items import ITEMS
from aeroloop.service.bench.results import Change, Results, chosen
from aeroloop.service.bench.tick import bare_tick
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load

MARGIN = Margin(1.5, "made")
Made = Callable[..., tuple[int, str, str]]


def item(name: str, ours: float, floor: float = 1.0, *, quick: bool = True) -> Item:
    return Item(name, "µs", 2.0, MARGIN, lambda _: Figure(ours, floor), f"{name}, made", quick)


def lacking(name: str) -> Item:
    def measure(_: bool) -> Figure:
        raise NotMeasuredError("no cyclictest")

    return item(name, 0)._replace(measure=measure)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Made:
    """`aeroloop host bench` with made items: exit code, stdout, stderr."""

    def run(items: list[Item], *words: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr("aeroloop.service.bench.items.ITEMS", tuple(items))
        code = execute(["host", "bench", *map(str, words)])
        return code, *capfd.readouterr()

    return run


def test_an_item_that_fails_or_gives_no_number_costs_no_other_item(bench: Made) -> None:
    def fail(_: bool) -> Figure:
        raise AeroloopError("the plant ended with exit code 1")

    def vanish(_: bool) -> Figure:
        raise FileNotFoundError("no process 7")

    failing = [item(name, 0)._replace(measure=measure) for name, measure in (("fails", fail), ("vanishes", vanish))]
    code, out, _ = bench([item("zero", 1.0, 0.0), item("nan", float("nan")), *failing, item("a", 1.0)], "--json")
    assert code == 0
    assert [line.get("reason") for line in json.loads(out).values()] == [
        "1 over 0",
        "nan over 1",
        "the plant ended with exit code 1",
        "no process 7",
        None,
    ]


def test_an_interrupt_keeps_what_was_measured_and_measures_nothing_more(bench: Made, tmp_path: Path) -> None:
    def interrupt(_: bool) -> Figure:
        raise KeyboardInterrupt

    items = [item("a", 3.0), item("b", 0)._replace(measure=interrupt), item("c", 1.0), item("d", 1.0, quick=False)]
    code, out, err = bench(items, "--json", "--quick")
    assert code == 130
    found = json.loads(out)
    assert found["a"]["ratio"] == 3.0
    assert [line.get("reason") for line in found.values()] == [None, *["interrupted"] * 3]
    assert "c" not in err
    before = tmp_path / "before.json"
    before.write_text(out)
    code, out, err = bench([item("a", 9.0), *items[1:]], "--compare", before)
    assert code == 130
    assert "not measured (interrupted): b, c, d" in out
    assert "a is worse" in err


def test_json_holds_the_five_figures_of_each_item_and_a_reason_where_there_are_none(bench: Made) -> None:
    code, out, err = bench([item("a", 3.00049, 1.5), lacking("b"), item("c", 1, quick=False)], "--json", "--quick")
    assert code == 0
    assert json.loads(out) == {
        "a": {"ours": 3.0, "floor": 1.5, "ratio": 2.0, "aim": 2.0, "unit": "µs"},
        "b": {"ours": None, "floor": None, "ratio": None, "aim": 2.0, "unit": "µs", "reason": "no cyclictest"},
        "c": {"ours": None, "floor": None, "ratio": None, "aim": 2.0, "unit": "µs", "reason": "full runs only"},
    }
    assert err.splitlines() == ["a: a, made", "  3 / 1.5 µs = 2", "b: b, made"]  # what ^C would otherwise lose


@pytest.mark.parametrize("form", [(), ("--markdown",)], ids=["terminal", "markdown"])
def test_the_table_says_of_each_item_whether_its_aim_is_met(bench: Made, form: tuple[str, ...]) -> None:
    noted = item("e", 1.0)._replace(measure=lambda _: Figure(1.0, 1.0, "at most so"), aim=None)
    code, out, _ = bench([item("a", 3.0, 1.5), item("b", 2.1), lacking("c"), lacking("d"), noted], *form)
    assert code == 0
    rows = {words[0]: words[1:] for line in out.splitlines() if (words := line.replace("|", " ").split())}
    assert rows["a"] == ["3", "µs", "1.5", "µs", "2.00", "2", "met"]
    assert rows["b"] == ["2.1", "µs", "1", "µs", "2.10", "2", "missed"]
    assert "not measured (no cyclictest): c, d\n" in out
    assert "c" not in rows
    assert rows["e"] == ["1", "µs", "1", "µs", "1.00", "–"]
    assert "e: at most so\n" in out
    assert "CPUs" in out.splitlines()[-1]  # the machine


def test_a_ratio_beyond_its_margin_fails_and_both_ratios_are_shown(bench: Made, tmp_path: Path) -> None:
    before = tmp_path / "before.json"
    before.write_text(bench([item("a", 1.0), item("b", 1.0), lacking("c"), item("d", 1.0)], "--json")[1])
    now = [item("a", 1.5), item("b", 1.51), item("c", 9.0), lacking("d"), item("e", 9.0)]
    code, out, err = bench(now, "--compare", before)
    assert code == 1
    rows = {words[0]: words[1:] for line in out.splitlines() if (words := line.split())}
    assert rows["a"][4:] == ["1.50", "1.00", "1.50", "2", "met"]
    assert rows["b"][4:] == ["1.51", "1.00", "1.50", "2", "worse"]
    assert "not measured (no cyclictest): d\n" in out
    assert "not measured before: c, e\n" in out
    assert err.splitlines()[-1] == "aeroloop: b is worse: its ratio is 1.51, was 1.00, and may be 1.50 (made)"
    assert bench([now[0], *now[2:]], "--compare", before)[0] == 0  # items that one of them lacks are no failure
    code, out, err = bench(now, "--json", "--compare", before)
    assert (code, list(json.loads(out))) == (1, ["a", "b", "c", "d", "e"])
    assert "b is worse" in err


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(1, 5), st.floats(0, 1))
def test_worse_is_what_exceeds_factor_and_slack(before: float, now: float, factor: float, slack: float) -> None:
    assert Change("a", before, now, Margin(factor, "made", slack)).worse == (now > factor * before + slack)
    assert not Change("a", None, now, MARGIN).worse
    assert not Change("a", before, None, MARGIN).worse


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot read {}: No such file or directory"),
        ("hello", "{} is not what `aeroloop host bench --json` prints"),
        ('{"a": {"ratio": 1}}', "{} is not what `aeroloop host bench --json` prints"),
    ],
)
def test_a_wrong_file_ends_before_anything_is_measured(
    bench: Made, tmp_path: Path, content: str | None, says: str
) -> None:
    path = tmp_path / "before.json"
    if content is not None:
        path.write_text(content)
    assert bench([item("a", 1.0)], "--compare", path) == (2, "", f"aeroloop: {says.format(path)}\n")


def test_an_unknown_item_is_named_with_one_that_is_like_it(bench: Made) -> None:
    items = [item("loop-tcp", 1.0), item("tick", 1.0)]
    says = "aeroloop: no item of the bench is called 'lop'; did you mean loop?\n"
    assert bench(items, "--only", "lop") == (2, "", says)
    assert bench(items, "--only", "x")[2].endswith("there are loop-tcp, tick\n")


def test_only_takes_items_and_groups() -> None:
    items = [item(name, 1.0) for name in ("loop-tcp-p50", "loop-tcp-p99", "loop-unix-p50", "looping")]
    assert [found.name for found in chosen(items, ["loop-tcp"])] == ["loop-tcp-p50", "loop-tcp-p99"]
    assert [found.name for found in chosen(items, ["looping"])] == ["looping"]
    assert [found.name for found in chosen(items, ["loop"])] == [made.name for made in items[:3]]


@pytest.mark.parametrize(("of", "expected"), [(min, Figure(1, 10)), (median, Figure(2, 20))])
def test_ours_and_the_floor_are_measured_in_turns(of: Any, expected: Figure) -> None:
    calls: list[float] = []

    def measured(values: list[float]) -> Callable[[], float]:
        def one() -> float:
            calls.append(values.pop(0))
            return calls[-1]

        return one

    assert in_turns(measured([3, 1, 2]), measured([10, 20, 30]), 3, of) == expected
    assert calls == [3, 10, 1, 20, 2, 30]


def test_the_floor_of_a_tick_answers_a_measurement_with_a_command() -> None:
    wire = load().wire
    command = bare_tick(load())(wire.measurement.pack(7, [1, 2, 3, 4, 5, 6]), 0)
    assert isinstance(command, bytes)
    assert len(command) == wire.command.size
    assert wire.command.counter(command) == 7


def test_the_reference_of_ci_is_of_items_that_exist() -> None:
    (reference,) = (Path(__file__).parents[3] / ".ci").glob("bench-*.json")
    assert set(Results.model_validate_json(reference.read_bytes()).root) <= {made.name for made in ITEMS}

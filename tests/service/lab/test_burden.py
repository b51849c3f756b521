"""Grid of `lab burden`: cells, Pareto front, command."""

from __future__ import annotations

import contextlib
import io
import json
from io import StringIO
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread
from rich.console import Console

from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.lab import burden_table
from aeroloop.service.lab.burden import Burden, measure_burden, pareto_front
from aeroloop.service.lab.burden_figure import draw_burden
from aeroloop.service.lab.burden_grid import BITS, QUANTIZERS, SENSORS, BurdenError, cell_settings, grid
from aeroloop.service.lab.burden_table import HEADER, markdown
from aeroloop.service.logs.outputs import OutputError
from tests.support.in_this_process import InThisProcess

BENCH = load()
COSTS = st.lists(st.tuples(st.integers(0, 9).map(float), st.integers(0, 9).map(float)), max_size=30)


def test_the_front_of_a_made_up_set() -> None:
    costs = [(1.0, 9.0), (2.0, 5.0), (2.0, 6.0), (3.0, 5.0), (4.0, 1.0), (9.0, 1.0), (4.0, 1.0)]
    assert pareto_front(costs) == [True, True, False, False, True, False, True]


@given(COSTS)
def test_nothing_on_the_front_is_beaten_and_everything_off_it_is_beaten_by_something_on_it(
    costs: list[tuple[float, float]],
) -> None:
    def beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
        return one != other and one[0] <= other[0] and one[1] <= other[1]

    best = [cost for cost, on_it in zip(costs, pareto_front(costs), strict=True) if on_it]
    rest = [cost for cost, on_it in zip(costs, pareto_front(costs), strict=True) if not on_it]
    assert not any(beats(cost, other) for cost in costs for other in best)
    assert all(any(beats(other, cost) for other in best) for cost in rest)


def test_the_grid_is_every_combination_and_float64_once_for_each_of_the_sensors() -> None:
    cells = grid(BENCH)
    assert len(cells) == len(set(cells)) == len(SENSORS) * (len(BITS) * len(QUANTIZERS) + 1)
    assert [cell.sensors for cell in cells if cell.quantizer is None] == list(SENSORS)


def test_a_cell_is_the_configuration_with_its_own_wire_and_sensors() -> None:
    wire_overrides = [
        "wire.rate.limit=2.5", "wire.rate.deadzone=0.01", "wire.transmit=on_change", "wire.counter_bits=10"
    ]  # fmt: skip
    mine = load(overrides=[*wire_overrides, "plant.sensors.gyro_bias=[0.1, 0, 0]"])
    cell = next(cell for cell in grid(mine, ["9/7"], ["uniform"], ["gyro"]) if cell.quantizer)
    settings = cell_settings(mine, cell)
    wire, sensors = settings.wire, settings.plant.sensors
    assert (wire.attitude.bits, wire.rate.bits, wire.voltage.bits) == (9, 9, 7)
    assert (wire.rate.limit, wire.rate.deadzone, wire.counter_bits) == (2.5, 0.01, 10)
    assert (wire.transmit.measurement, wire.transmit.command) == ("periodic", "periodic")
    assert (sensors.rate, sensors.gyro_noise, sensors.gyro_bias) == ("gyro", 0.002, (0.1, 0.0, 0.0))
    assert settings.law == mine.law


def test_parameters_of_one_quantizer_are_not_anothers() -> None:
    mine = load(overrides=["wire.rate.kind=hysteresis-uniform", "wire.rate.hysteresis=0.02"])
    for cell in grid(mine, ["8/6"], sensors=["perfect"]):
        rate = cell_settings(mine, cell).wire.rate
        assert rate.kind == (QUANTIZERS[cell.quantizer][1] if cell.quantizer else "hysteresis-uniform")
        assert rate.hysteresis == (0.02 if rate.kind == "hysteresis-uniform" else None)


def test_hysteresis_on_the_rate_leaves_the_other_signals_uniform() -> None:
    [cell] = [c for c in grid(load(), ["8/6"], ["hysteresis-rate"], ["perfect"]) if c.quantizer]
    wire = cell_settings(load(), cell).wire
    assert [signal.kind for signal in (wire.attitude, wire.rate, wire.voltage)] == list(QUANTIZERS["hysteresis-rate"])
    assert wire.rate.kind == "hysteresis-uniform"
    assert wire.attitude.kind == wire.voltage.kind == "uniform"


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("--bits", "8/1"), "8/1"),
        (("--bits", "8/6/4"), "8/6/4"),
        (("--bits", "8"), "'8'"),
        (("--quantizer", "round"), "round"),
        (("--sensors", "ear"), "ear"),
        (("--bits", "2/2"), "3 bits"),
        (("--set", "plant.ideal=true"), "plant.ideal"),
        (("--figure", "a.txt"), "a.txt"),
        (("--figure", "no/such/folder/a.png"), "no/such/folder"),
    ],
    ids=lambda value: value[-1] if isinstance(value, tuple) else "",
)
def test_what_there_is_not_is_refused_in_one_line_before_anything_runs(
    capfd: pytest.CaptureFixture[str], arguments: tuple[str, ...], names: str
) -> None:
    assert execute(["lab", "burden", *arguments]) == 2
    captured = capfd.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert names in captured.err


def test_where_float64_makes_no_error_there_is_nothing_to_stand_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aeroloop.service.lab.burden.Workers", InThisProcess)
    still = load(overrides=["reference.kind=hold"])
    with pytest.raises(BurdenError, match=r"^float64 makes no error, sensors perfect"):
        measure_burden(still, grid(still, ["cont"], sensors=["perfect"]), 0.1)


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A grid of three cells, 4 s each, by the command: what it prints as JSON, and the figure that it draws."""
    figure = tmp_path_factory.mktemp("burden") / "burden.png"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.MonkeyPatch.context() as patched:
        patched.setattr("aeroloop.service.lab.burden.Workers", InThisProcess)
        arguments = ["--bits", "8/6", "--bits", "2/2", "--quantizer", "uniform", "--sensors", "encoders"]
        assert execute(["lab", "burden", *arguments, "--duration", "4", "--figure", str(figure), "--json"]) == 0
    return printed.getvalue(), figure


def test_the_command_prints_every_point_beside_float64(document: tuple[str, Path]) -> None:
    output = json.loads(document[0])
    assert [output[name] for name in ("duration_s", "rate_hz", "heartbeat_s", "counter_bits")] == [4.0, 500.0, 0.03, 8]
    assert list(output["sensors"]) == ["encoders"]
    points = {(point["bits_out"], point["transmit"]): point for point in output["points"]}
    assert len(points) == len(output["points"]) == 6

    always, changed = points[8, "periodic"], points[8, "on_change"]
    baseline = points[None, "periodic"]
    assert always["z_track"] == changed["z_track"] > baseline["z_track"] > 0
    assert always["measurement"]["bits_per_s"] == 28000
    assert always["command"]["can_bits_per_s"] == 500 * 85
    assert always["can_load"] == pytest.approx(0.105)
    assert changed["bits_per_s"] < always["bits_per_s"]
    assert changed["against_float64"]["bits_per_s"] == pytest.approx(changed["bits_per_s"] / 264000)
    assert set(baseline["against_float64"].values()) == {1.0}
    assert changed["pareto"]
    assert not always["pareto"]


def test_a_loop_that_ends_early_has_no_figures_and_the_reason_is_reported(document: tuple[str, Path]) -> None:
    for point in json.loads(document[0])["points"]:
        ended = point["bits_out"] == 2
        assert (point["z_track"] is None) == (point["against_float64"] is None) == ended
        assert not (ended and point["pareto"])
        assert ("voltage limit" in (point["reason"] or "")) == ended


def test_the_figure_is_an_image(document: tuple[str, Path], tmp_path: Path) -> None:
    pixels = imread(document[1])
    assert pixels.shape[0] > 300
    assert pixels.std() > 0.05
    burden = Burden.model_validate_json(document[0])
    draw_burden(burden, tmp_path / "burden.svg")
    text = (tmp_path / "burden.svg").read_text()
    assert "<svg" in text
    with pytest.raises(OutputError, match="folder"):
        draw_burden(burden, tmp_path / "none" / "burden.svg")


def test_the_markdown_is_a_table_with_a_row_for_each_experiment(document: tuple[str, Path]) -> None:
    lines = markdown(Burden.model_validate_json(document[0])).splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert len(rows) == 2 + 3
    assert {line.count("|") for line in rows} == {len(HEADER) + 1}
    assert "★" in rows[2]
    assert any("voltage limit" in line for line in lines)


def test_at_80_columns_every_figure_stands_whole_in_a_block_for_each_policy(
    document: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Console(width=80, force_terminal=True, color_system=None, file=StringIO())
    monkeypatch.setattr(burden_table, "Console", lambda: screen)
    burden = Burden.model_validate_json(document[0])
    burden_table.burden_table(burden)
    assert isinstance(screen.file, StringIO)
    lines = screen.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.strip("| ").split(" | ") for line in markdown(burden).splitlines() if line.startswith("| ")][1:]
    blocks = "\n".join(lines).partition("every tick\n")[2].partition("on change\n")
    for shown, columns in ((blocks[0], (0, 1, 2, 3, 5, 6)), (blocks[2], (0, 1, 7, 8, 10, 11))):
        for row in rows:
            assert any(line.split() == " ".join(row[i] for i in columns).split() for line in shown.splitlines()), row


def test_the_table_states_what_the_counter_costs(document: tuple[str, Path]) -> None:
    burden = Burden.model_validate_json(document[0])
    for bits, line in (
        (8, "500 + 500 frames/s carry 8 kbit/s of it; 4 bits would carry 4, padding apart."),
        (10, "500 + 500 frames/s carry 10 kbit/s of it; 4 bits would carry 4, padding apart."),
        (4, "500 + 500 frames/s carry 4 kbit/s of it, padding apart."),
    ):
        text = markdown(burden.model_copy(update={"counter_bits": bits}))
        assert f"The counter has {bits} bits: at every tick {line}" in text

"""Grid of `lab burden`: cells, Pareto front, traffic of one direction, frames on a CAN bus, command."""

from __future__ import annotations

import contextlib
import io
import json
from math import nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.transmit import Sender
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.lab.burden import (
    BITS,
    POLICIES,
    QUANTIZERS,
    SENSORS,
    Burden,
    GridError,
    cell_settings,
    classic_frame_bits,
    draw_burden,
    grid,
    measure_burden,
    observe,
    pareto_front,
    sheets,
    traffic,
)
from aeroloop.service.lab.experiment import experiment, heartbeat_of, run_experiment, sent_ticks
from aeroloop.service.logs.outputs import OutputError
from tests.support.in_this_process import run_here

BENCH = load()
COSTS = st.lists(st.tuples(st.integers(0, 9).map(float), st.integers(0, 9).map(float)), max_size=30)


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


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("--bits", "8/1"), "8/1"),
        (("--bits", "8/6/4/2"), "8/6/4/2"),
        (("--bits", "8"), "'8'"),
        (("--quantizer", "round"), "round"),
        (("--sensors", "ear"), "ear"),
        (("--bits", "2/2"), "3 bits"),
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
    run_here(monkeypatch)
    still = load(overrides=["reference.kind=hold"])
    with pytest.raises(GridError, match=r"^float64 makes no error, sensors perfect"):
        measure_burden(still, grid(still, ["cont"], sensors=["perfect"]), 0.1)


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A grid of three cells, 4 s each, by the command: what it prints as JSON, and the figure that it draws."""
    figure = tmp_path_factory.mktemp("burden") / "burden.png"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.MonkeyPatch.context() as patched:
        run_here(patched)
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


def test_there_is_a_row_for_each_experiment_and_a_reason_for_each_without_figures(document: tuple[str, Path]) -> None:
    (title, rows), (reason, _), *notes = sheets(Burden.model_validate_json(document[0]))
    assert title.startswith("sensors encoders: ")
    assert [(row["bits out/in"], row["quantizer"]) for row in rows] == [
        ("8/6", "uniform"),
        ("2/2", "uniform"),
        ("cont/cont", "float64"),
    ]
    assert rows[0]["on change: kbit/s"].startswith("★ ")
    assert set(list(rows[1].values())[2:]) == {"–"}
    assert reason.startswith("2/2 uniform: ")
    assert "voltage limit" in reason
    assert not any(rows for _, rows in notes)


# ── traffic ──

KIND = FrameFormat([6, 6], 4)
CODES = np.array([(0, 0), (0, 0), (0, 1), (2, 0), (2, 0), (2, 0), (2, 0), (2, 0), (2, 0), (2, 0)], float)
PERIOD = 0.01


def test_rates_are_over_all_ticks_and_intervals_between_frames_sent() -> None:
    seen = traffic(CODES, KIND, np.array([0, 2, 3, 7]), PERIOD)
    assert seen["frames_per_s"] == pytest.approx(40)
    assert seen["bits_per_s"] == pytest.approx(40 * 16)
    assert seen["component_changes_per_s"] == pytest.approx([10, 20])  # 0→2, and 0→1→0
    assert seen["changes_per_s"] == pytest.approx(30)
    assert seen["mean_interval_ms"] == pytest.approx(70 / 3)
    assert seen["least_interval_ms"] == pytest.approx(10)
    assert seen["can_frames"] == 1
    assert seen["can_bits_per_s"] == pytest.approx(40 * 75)
    assert seen["can_load"] == pytest.approx(0.003)


def test_a_frame_longer_than_a_classic_one_counts_as_several() -> None:
    floats = FrameFormat([None, None], 4)
    seen = traffic(np.array([(0.0, 1.0)] * 4), floats, np.arange(4), PERIOD)
    assert floats.size == 17
    assert seen["can_frames"] == 3
    assert seen["can_bits_per_s"] == pytest.approx(100 * (135 + 135 + 65))


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("wire.attitude.kind=hysteresis-uniform", "wire.voltage.kind=logarithmic-uniform"),
        ('wire.rate.bits="cont"', "wire.transmit.heartbeat_s=0.01"),
    ],
    ids=["uniform", "other quantizers", "float64 rates"],
)
def test_a_loop_that_sends_on_change_sends_those_frames_and_no_others(overrides: tuple[str, ...]) -> None:
    """The last bit included: the course, figures, ticks and sizes of frames."""
    settings = load(overrides=overrides)
    policy = {"measurement": "on_change", "command": "on_change"}
    wire = settings.wire.model_copy(update={"transmit": settings.wire.transmit.model_copy(update=policy)})
    received: list[tuple[bytes, bytes]] = []
    changed = settings.model_copy(update={"wire": wire})
    figures = run_experiment(changed, 3.0, watch=lambda _k, *frames: received.append(frames))
    course, seen = experiment(settings, 3.0).course, observe(settings, 3.0)
    assert [row["transmit"] for row in seen] == list(POLICIES)
    for row in seen:
        assert (row["z_track"], row["u_total"]) == (figures.z_track, figures.u_total)
    for i, (codes, measured) in enumerate(
        ((course.measured, figures.measurement), (course.commanded, figures.command))
    ):
        sent = sent_ticks(codes, "on_change", heartbeat_of(settings)).tolist()
        assert [k for k, frames in enumerate(received) if frames[i]] == sent
        reckoned = seen[-1][("measurement", "command")[i]]
        assert (reckoned["frames_per_s"], reckoned["bits_per_s"]) == (measured.frames_per_s, measured.bits_per_s)
        assert 0 < len(sent) < len(received)


@given(
    st.lists(st.sampled_from([(0.0, 1.0), (-0.0, 1.0), (nan, 1.0), (2.0, 1.0)]), min_size=1, max_size=40),
    st.integers(1, 7),
)
def test_ticks_sent_are_those_of_a_sender(codes: list[tuple[float, float]], heartbeat: int) -> None:
    sender = Sender("on_change", heartbeat, 16)
    sent = [k for k, each in enumerate(codes) if sender.due(k, each)]
    assert sent_ticks(np.array(codes), "on_change", heartbeat).tolist() == sent


# ── frames on a classic CAN bus ──


def stuffed_length(identifier: int, data: bytes) -> int:
    """Bits on the bus of a classic data frame, from the start of frame to the end of the interframe space."""
    head = f"0{identifier:011b}000{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    crc = 0
    for bit in head:
        crc = (crc << 1) ^ (0x4599 if int(bit) ^ (crc >> 14) else 0)
        crc &= 0x7FFF
    stuffed, run, last = 0, 0, ""
    for bit in f"{head}{crc:015b}":
        run = run + 1 if bit == last else 1
        stuffed, last = stuffed + 1, bit
        if run == 5:
            stuffed, run, last = stuffed + 1, 1, "1" if bit == "0" else "0"
    return stuffed + 1 + 2 + 7 + 3  # CRC delimiter, acknowledgement, end of frame, interframe space


def test_classic_frames_take_the_bits_that_the_literature_has() -> None:
    # Davis, Burns, Bril and Lukkien, Controller Area Network schedulability analysis, 2007: 55 + 10 s bits.
    assert [classic_frame_bits(n) for n in range(9)] == [55, 65, 75, 85, 95, 105, 115, 125, 135]


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_no_frame_takes_more_than_the_worst(identifier: int, data: bytes) -> None:
    assert 47 + 8 * len(data) <= stuffed_length(identifier, data) <= classic_frame_bits(len(data))


@pytest.mark.parametrize("size", range(1, 9))
def test_the_worst_is_nearly_reached(size: int) -> None:
    """Runs of four equal bits after a stuffed one: only the header and the CRC are not as bad as that."""
    worst = max(stuffed_length(0x078, bytes([byte]) * size) for byte in range(256))
    assert worst >= classic_frame_bits(size) - 7

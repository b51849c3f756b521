"""Grid of `lab burden`: cells, Pareto front, traffic sent on change and at every tick, command."""

from __future__ import annotations

import contextlib
import io
import json
from itertools import compress
from math import nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread

from aeroloop.protocol.wire.transmit import Sender
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load, load_over
from aeroloop.service.lab.burden import QUANTIZERS, SENSORS, Burden, GridError, grid, pareto_front, sheets
from aeroloop.service.lab.experiment import run_experiment, sent_ticks
from tests.support.in_this_process import run_here

BENCH = load()
COSTS = st.lists(st.tuples(st.integers(0, 9).map(float), st.integers(0, 9).map(float)), max_size=30)


@given(COSTS)
def test_nothing_on_the_front_is_beaten_and_everything_off_it_is_beaten_by_something_on_it(
    costs: list[tuple[float, float]],
) -> None:
    def beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
        return one != other and one[0] <= other[0] and one[1] <= other[1]

    on_it = pareto_front(costs)
    best = list(compress(costs, on_it))
    assert [any(beats(other, cost) for other in best) for cost in costs] == [not each for each in on_it]
    assert not any(beats(cost, other) for cost in costs for other in best)


def test_a_cell_is_the_configuration_with_its_own_wire_and_sensors() -> None:
    mine = load(overrides=["wire.rate.limit=2.5", "wire.rate.kind=hysteresis-uniform", "wire.rate.hysteresis=0.02"])
    cells = grid(mine, ["9/7"])
    assert len(cells) == len(SENSORS) * (len(QUANTIZERS) + 1)  # float64 once
    for cell, settings in cells.items():
        wire, sensors = settings.wire, settings.plant.sensors
        quantized = cell.quantizer is not None
        assert (wire.attitude.bits, wire.rate.bits, wire.voltage.bits) == ((9, 9, 7) if quantized else (None,) * 3)
        assert wire.rate.kind == (QUANTIZERS[cell.quantizer][1] if cell.quantizer else "hysteresis-uniform")
        # parameters of one quantizer are not another's
        assert wire.rate.hysteresis == (0.02 if wire.rate.kind == "hysteresis-uniform" else None)
        assert (wire.rate.limit, wire.transmit.measurement, wire.transmit.command) == (2.5, "on_change", "on_change")
        assert SENSORS[cell.sensors][1].items() <= sensors.model_dump().items()


@pytest.mark.parametrize(("bits", "quantizers"), [(["8/1"], ["uniform"]), (["8/6"], ["round"])])
def test_what_there_is_not_is_refused(bits: list[str], quantizers: list[str]) -> None:
    with pytest.raises(GridError, match=r"8/1|round"):
        grid(BENCH, bits, quantizers)


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A grid of three cells under each of the sensors, 4 s each, by the command: its JSON and its figure."""
    figure = tmp_path_factory.mktemp("burden") / "burden.png"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.MonkeyPatch.context() as patched:
        run_here(patched)
        arguments = ["--bits", "8/6", "--bits", "2/2", "--quantizer", "uniform"]
        assert execute(["lab", "burden", *arguments, "--duration", "4", "--figure", str(figure), "--json"]) == 0
    return printed.getvalue(), figure


def test_a_point_has_the_figures_of_both_ways_to_send_over_those_of_float64(document: tuple[str, Path]) -> None:
    output = json.loads(document[0])
    assert list(output["sensors"]) == list(SENSORS)
    point, failed, baseline = [each for each in output["points"] if each["sensors"] == "encoders"]
    always = run_experiment(BENCH, 4.0)
    changed = run_experiment(load_over(BENCH, ["wire.transmit=on_change"]), 4.0)
    assert point["z_track"] == always.z_track == changed.z_track
    assert point["every_tick_bits_per_s"] == (always.measurement.bits_per_s or 0) + (always.command.bits_per_s or 0)
    assert point["bits_per_s"] == (changed.measurement.bits_per_s or 0) + (changed.command.bits_per_s or 0)
    assert baseline["every_tick_bits_per_s"] == 264_000  # 49 and 17 bytes, 500 times a second
    assert point["against_float64"] == {
        "z_track": point["z_track"] / baseline["z_track"],
        "every_tick_bits_per_s": 40_000 / 264_000,
        "bits_per_s": point["bits_per_s"] / 264_000,
    }
    assert point["pareto"]
    assert failed["z_track"] is failed["against_float64"] is None
    assert not failed["pareto"]
    assert "voltage limit" in failed["reason"]


def test_the_figure_is_an_image_and_each_table_names_what_has_no_figures(document: tuple[str, Path]) -> None:
    assert imread(document[1]).std() > 0.05
    (title, rows), (reason, _) = list(sheets(Burden.model_validate_json(document[0])))[2:4]
    assert title.startswith("sensors encoders: ")
    assert [row["bits out/in"] for row in rows] == ["8/6", "2/2", "cont/cont"]
    assert rows[0]["on change: kbit/s"].startswith("★ ")
    assert rows[1]["z_track, 10⁻⁴ s"] == "–"
    assert reason.startswith("2/2 uniform: ")


@given(
    st.lists(st.sampled_from([(0.0, 1.0), (-0.0, 1.0), (nan, 1.0), (2.0, 1.0)]), min_size=1, max_size=40),
    st.integers(1, 7),
)
def test_ticks_sent_are_those_of_a_sender(codes: list[tuple[float, float]], heartbeat: int) -> None:
    sender = Sender("on_change", heartbeat, 16)
    sent = [k for k, each in enumerate(codes) if sender.due(k, each)]
    assert sent_ticks(np.array(codes), "on_change", heartbeat).tolist() == sent

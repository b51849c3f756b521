"""Export: the same ticks and numbers as the review in every format, null for missing values, and copies of logs."""

from __future__ import annotations

import csv
import errno
import json
from collections.abc import Iterator
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Truth
from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, from_description, load
from aeroloop.service.logs.columns import columns_of
from aeroloop.service.logs.copies import ExportError, copy
from aeroloop.service.logs.export import export
from aeroloop.service.logs.session import Truths
from aeroloop.service.review.review import read, review
from tests.golden.make import HERE as GOLDEN
from tests.support.edited_log import PERIOD_NS, at_rest, by_mcap
from tests.support.made_log import SESSION, START_NS, VEHICLE, made, write

TICKS = 400
SKIPPED = range(100, 148)
"""The plant had no time for them."""
UNANSWERED = range(200, 204)
"""Their measurements were lost."""
SHORT = "s2"
"""A second session, of 50 ticks."""


@pytest.fixture(scope="module")
def settings() -> Settings:
    return load(overrides=["loop.lockstep=false"])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, settings: Settings) -> Path:
    """Two sessions, the first of which skips ticks and leaves some unanswered."""
    long = made(settings, TICKS, truth_every=10, lost=UNANSWERED, skipped=SKIPPED)
    short = made(settings, 50, session=SHORT, at_ns=3_600_000_000_000)
    return write(tmp_path_factory.mktemp("log") / "log.mcap", settings, [*long, *short])


Table = dict[str, list[Any]]


@pytest.fixture(scope="module")
def parquet(log: Path) -> Table:
    out = log.with_name("table.parquet")
    export([log], "parquet", out)
    table: Table = pyarrow.parquet.read_table(out).to_pydict()
    return table


def rows(table: Table) -> Iterator[dict[str, Any]]:
    for values in zip(*table.values(), strict=True):
        yield dict(zip(table, values, strict=True))


def test_the_rows_sum_up_to_the_figures_of_the_review(log: Path, parquet: Table, settings: Settings) -> None:
    """Both add the same 352 numbers, so they differ by rounding alone: by 352 times 1.1e-16 of the sum at the most."""
    figures, period = review(log), settings.loop.period
    all_rows = list(rows(parquet))
    z_track = u_total = 0.0
    for row, after in zip(all_rows, [*all_rows[1:], None], strict=True):
        held = after["tick"] - row["tick"] if after else 1
        z_track += sum(row[f"attitude_error_{axis}"] ** 2 for axis in "xyz") * held * period
    answered = [row for row in all_rows if row["voltage_2_V"] is not None]
    longest = round(settings.plant.watchdog_s / period)
    for row, after in zip(answered, [*answered[1:], None], strict=True):
        held = min(longest, after["tick"] - row["tick"]) if after else 1
        u_total += (row["voltage_2_V"] ** 2 + row["voltage_3_V"] ** 2) * held * period
    assert z_track == pytest.approx(figures.z_track, rel=4e-14)
    assert u_total == pytest.approx(figures.u_total, rel=4e-14)
    assert max(parquet["attitude_error_deg"]) == pytest.approx(figures.max_error_deg, rel=4e-14)


def test_a_gap_stays_a_gap_and_truth_is_the_last_that_was_published_by_then(parquet: Table, settings: Settings) -> None:
    """Every tenth tick has a truth, unless the plant skipped it."""
    ticks = [k for k in range(TICKS) if k not in SKIPPED]
    assert parquet["tick"] == ticks
    assert parquet["time_s"] == [k * 0.002 for k in ticks]
    assert parquet["published_ns"] == [START_NS + k * PERIOD_NS for k in ticks]
    quantizer = settings.wire.rate.quantizer()
    for row in rows(parquet):
        last = max(k for k in range(0, row["tick"] + 1, 10) if k not in SKIPPED)
        assert row["truth_age_s"] == pytest.approx((row["tick"] - last) * 0.002)
        if last == row["tick"]:  # the gyro's noise and its quantizer lie between
            assert row["rate_z_rad_s"] == pytest.approx(row["truth_rate_z_rad_s"], abs=quantizer.limit / 20)


def test_an_event_is_cut_out_of_a_log_with_the_seconds_beside_it(tmp_path: Path) -> None:
    log, half = GOLDEN / "default.mcap", 0.25
    for what, tick in (("fault", 2499), ("trip", 4499)):
        out = tmp_path / f"{what}.parquet"
        exported = export([log], "parquet", out, around=(what, half))
        ticks = pyarrow.parquet.read_table(out).to_pydict()["tick"]
        assert ticks == [k for k in range(tick - 125, tick + 126) if k < 4500]
        assert exported.around[0].startswith({"fault": "fault injected", "trip": "stopped by an operator"}[what])
    with pytest.raises(ExportError, match="has no event 'nothing': name trip, fault, mark, or words of a mark"):
        export([log], "csv", tmp_path / "a.csv", around=("nothing", 1))

    with pytest.raises(ExportError, match="and so do --from and --to: give one of them"):
        export([log], "csv", tmp_path / "a.csv", around=("trip", 1), since_s=1.0)

    settings, at = load(), 1500
    messages = made(settings, 3000)
    for i, text in enumerate(("gust seen", "another")):
        event = Event(role="plant", kind="marked", text=text, session=SESSION, tick=at + i)
        first = next(m for m in messages if m.at_ns >= START_NS + (at + i) * PERIOD_NS)
        key = topics.key("event", VEHICLE, role="plant")
        messages.insert(messages.index(first), first._replace(key=key, payload=event.encode()))
    write(tmp_path / "run.mcap", settings, messages)
    assert len(export([tmp_path / "run.mcap"], "csv", tmp_path / "b.csv", around=("mark", 1)).around) == 2
    exported = copy([tmp_path / "run.mcap"], tmp_path / "cut.mcap", around=("gust", 1))
    assert exported.around == ["gust seen"]
    cut = read(tmp_path / "cut.mcap")  # a log that is whole enough to be judged, and has no more than it must
    assert cut.ticks.k[0] <= at - 500 < at + 450 <= cut.ticks.k[-1] <= at + 500
    assert cut.ticks.k[0] > 100


def test_a_plants_own_signals_reach_the_log_the_table_and_the_page(tmp_path: Path) -> None:
    """One that is never known is an empty column, and no panel; a stranger's add no columns without end."""
    settings = load(overrides=["plant.kind=tests.support.own_plants:Pair", "loop.lockstep=true"])
    messages = made(settings, 60, truth_every=10)
    forged = Truth(tick=0, attitude=(1.0, 0.0, 0.0, 0.0), rate=(0.0,) * 3, voltages=(0.0, 0.0), session=SESSION)
    for i in range(3):
        signals = {f"x{i}_{j}": 1.0 for j in range(7)}
        forged = forged.model_copy(update={"session_tick": 55 + i, "signals": signals})
        messages.append(next(m for m in messages if m.key.endswith("/truth"))._replace(payload=forged.encode()))
    write(tmp_path / "own.mcap", settings, messages)
    exported = export([tmp_path / "own.mcap"], "parquet", tmp_path / "own.parquet")
    assert exported.damages == ["malformed: 1 of truth"]
    table = pyarrow.parquet.read_table(tmp_path / "own.parquet").to_pydict()
    assert len([name for name in table if name.startswith("plant_")]) == 16
    assert table["plant_battery_V"] == [None] * len(table["tick"])
    assert table["plant_angle_deg"][:55] == pytest.approx(table["truth_yaw_deg"][:55])
    assert len(set(table["plant_angle_deg"][:55])) == 6
    assert table["plant_x0_0"] == [None] * 55 + [1.0] + [None] * 4
    assert table["plant_x1_0"] == [None] * 56 + [1.0] * 4
    panels = [panel for panel in read(tmp_path / "own.mcap").report().panels if panel.group == "signals"]
    assert [panel.label for panel in panels] == [
        "angle_deg",
        *sorted(name[6:] for name in table if name[:7] == "plant_x"),
    ]
    drawn = panels[0].lines[0].values
    assert list(drawn[:51:10]) == pytest.approx(table["plant_angle_deg"][:51:10])


def test_saturated_counts_on_either_side_and_is_not_known_of_what_was_scaled_or_not_commanded() -> None:
    settings = load()
    top = {name: getattr(settings.wire, name).quantizer().outermost for name in ("attitude", "rate", "voltage")}
    ticks = at_rest(range(3))
    ticks.attitude[:2] = (0.1, top["attitude"], -top["attitude"], 0.5), (0.0, 1.0, 0.0, 0.0)
    ticks.rate[0] = top["rate"], -top["rate"], 0.99 * top["rate"]
    ticks.voltages[:] = (top["voltage"], -top["voltage"]), (nan, nan), (0.99 * top["voltage"], 0.0)
    truths = Truths(np.arange(3), np.zeros((3, 4)), np.zeros((3, 3)), np.zeros((3, 2)))
    columns = columns_of((VEHICLE, SESSION), ticks, truths, settings)
    found = {column.name[10:]: list(column.values) for column in columns if column.name.startswith("saturated")}
    expected = {
        "attitude_x": [1, nan, 0], "attitude_y": [1, nan, 0], "attitude_z": [0, nan, 0],
        "rate_x": [1, 0, 0], "rate_y": [1, 0, 0], "rate_z": [0, 0, 0],
        "voltage_2": [1, nan, 0], "voltage_3": [1, nan, 0],
    }  # fmt: skip
    np.testing.assert_equal(found, expected)


def test_a_csv_file_holds_the_same_to_the_last_bit_and_nothing_for_null(
    log: Path, tmp_path: Path, parquet: Table
) -> None:
    export([log], "csv", tmp_path / "table.csv")
    text = (tmp_path / "table.csv").read_bytes().decode()
    assert text.count("\r\n") == text.count("\n") == len(parquet["tick"]) + 1  # RFC 4180
    names, *lines = csv.reader(text.splitlines(), strict=True)
    assert names == list(parquet)
    for i, name in enumerate(names):
        # booleans are numbers, too: a blank among words is no number
        exact: type = {"vehicle": str, "session": str, "tick": int, "published_ns": int}.get(name, float)
        assert [exact(line[i]) if line[i] else None for line in lines] == parquet[name]


def test_every_column_names_its_unit_and_the_file_its_configuration(
    log: Path, parquet: Table, settings: Settings
) -> None:
    schema = pyarrow.parquet.read_schema(log.with_name("table.parquet"))
    endings = {"_rad_s": "rad/s", "_Nms_rad": "N·m·s/rad", "_deg": "deg", "_V": "V"}
    endings |= {"_ns": "ns", "_us": "µs", "_s": "s"}
    assert schema.names == list(parquet)
    for field in schema:
        unit, description = field.metadata[b"unit"].decode(), field.metadata[b"description"].decode()
        expected = next((unit for ending, unit in endings.items() if field.name.endswith(ending)), None)
        assert unit == expected if expected else unit in ("", "1"), field.name
        assert len(description) > 5
        assert len(field.name) <= 63
    facts = {key.decode(): json.loads(value) for key, value in schema.metadata.items() if key.startswith(b"aeroloop.")}
    assert from_description(facts["aeroloop.config"]).description() == settings.description()
    assert facts["aeroloop.sessions"] == [f"{VEHICLE}/{SESSION}"]


@pytest.mark.parametrize(("session", "exported", "other"), [("1", SESSION, SHORT), ("2", SHORT, SESSION)])
def test_the_session_that_is_asked_for_is_exported_and_the_others_are_named(
    log: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], session: str, exported: str, other: str
) -> None:
    out, ticks = tmp_path / "a.csv", {SESSION: [k for k in range(TICKS) if k not in SKIPPED], SHORT: list(range(50))}
    assert execute(["log", "export", str(log), "--format", "csv", "--out", str(out), "--session", session]) == 0
    with out.open(newline="") as file:
        found = [(row["session"], int(row["tick"])) for row in csv.DictReader(file)]
    assert found == [(exported, k) for k in ticks[exported]]
    assert f"not exported of this log: {VEHICLE}/{other};" in capfd.readouterr().out


def test_an_export_that_fails_is_one_line_and_leaves_nothing_behind(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pyarrow.parquet.ParquetWriter.write_batch", full)
    for to, out, says in (
        ("parquet", "a", "No space left"),
        ("csv", "no/a", "No such file"),
        ("mcap", "no/a", "No such"),
    ):
        assert execute(["log", "export", str(log), "--format", to, "--out", str(tmp_path / out)]) == 1
        (line,) = capfd.readouterr().err.splitlines()
        assert says in line
    assert list(tmp_path.iterdir()) == []


# Copies of logs


def test_a_copy_of_a_rotated_run_is_one_log_that_reads_the_same_alone_and_beside_it(tmp_path: Path) -> None:
    settings, folder = load(), tmp_path / "run"
    folder.mkdir()
    messages = made(settings, TICKS)
    parts = [write(folder / f"run-{i:04}.mcap", settings, messages[i::2]) for i in range(2)]
    exported = copy([folder])
    assert (exported.out, exported.sessions) == (str(tmp_path / "run-copy.mcap"), None)
    assert sorted(message.data for message in by_mcap(Path(exported.out))) == sorted(
        message.data for part in parts for message in by_mcap(part)
    )
    assert review(Path(exported.out)).z_track == review(folder).z_track
    (folder / "copy.mcap").write_bytes(Path(exported.out).read_bytes())
    unlike = {"log"}
    assert review(folder).model_dump(exclude=unlike) == review(*parts).model_dump(exclude=unlike)
    assert execute(["log", "export", str(folder), "--format", "mcap", "--session", SESSION]) == 2

"""Feed of the console: its columns are the log's, whatever is received in between; a slow page gets what is kept."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status, Telemetry
from aeroloop.protocol.messages.trace import Outcome, PlantRow, Sent, TraceWriter
from aeroloop.service.config import load
from aeroloop.service.console.feed import Feed, Vehicle, panels_of
from aeroloop.service.logs.session import Array
from aeroloop.service.logs.ticks import euler_deg
from aeroloop.service.review.review import read
from aeroloop.service.theorem.certificate import certify
from tests.support.made_log import START_NS, VEHICLE, description, made, write

TICKS = 1000


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Feed, dict[str, Array]]:
    """A loop as a page is given it, and columns of its log by name."""
    settings = load()
    messages, feed = made(settings, TICKS), Feed()
    for role in ("plant", "controller"):
        key = topics.key("description", VEHICLE, role=role)
        feed.take(key, description(settings, role).encode(), 0.0, 0.0)
    for message in messages:
        feed.take(message.key, message.payload, (message.at_ns - START_NS) * 1e-9, 0.0)
    log = read(write(tmp_path_factory.mktemp("feed") / "a.mcap", settings, messages))
    columns = dict[str, Array]()
    for name, values in (("roll", 0), ("pitch", 1), ("yaw", 2)):
        columns[name] = euler_deg(log.ticks.attitude)[:, values]
    columns |= {"u₂": log.ticks.voltages[:, 0], "latency": log.ticks.latency_ns * 1e-6}
    return feed, columns


def test_rows_are_those_of_the_log_at_fifty_a_second(both: tuple[Feed, dict[str, Array]]) -> None:
    feed, logged = both
    vehicle, block = feed.vehicles[VEHICLE], feed.block(VEHICLE, 0, 0, "")
    rows = np.array(block["rows"])
    assert rows[:, 0] == pytest.approx(np.arange(0, TICKS, 10) * 0.002)
    assert block["count"] == len(rows) == 100
    at = {(group, panel, quantity): i + 1 for i, (group, panel, quantity) in enumerate(vehicle.columns)}
    for name in ("roll", "pitch", "yaw"):
        found = rows[:, at["angles", name, "measured"]]
        assert found == pytest.approx(logged[name][::10], abs=1e-5)
    # The voltages of a row are those in force from it on: of the tick before, as a command acts a period later.
    assert rows[1:, at["input", "u₂", "commanded"]] == pytest.approx(logged["u₂"][9:-1:10], abs=1e-6)
    assert rows[1:, at["latency", "latency", "latency"]] == pytest.approx(logged["latency"][9:-1:10], abs=2e-3)
    desired = rows[:, at["angles", "yaw", "desired"]]
    assert np.isfinite(desired[1:]).all()
    assert np.abs(np.diff(desired[1:])).max() < 2  # of telemetry, ten times a second


def test_a_page_gets_what_it_lacks_once_and_of_a_new_session_all(
    both: tuple[Feed, dict[str, Array]],
) -> None:
    feed, _ = both
    whole = feed.block(VEHICLE, 0, 0, "")
    assert [row[0] for row in feed.block(VEHICLE, 90, 0, "s1")["rows"]] == [row[0] for row in whole["rows"][90:]]
    assert feed.block(VEHICLE, whole["count"], whole["numbered"], "s1")["rows"] == []
    assert len(feed.block(VEHICLE, 90, 0, "of before")["rows"]) == 100
    assert feed.block("another", 0, 0, "").get("rows") is None
    event = Event(role="plant", kind="marked", text="here", session="s1", tick=7)
    feed.take(topics.key("event", VEHICLE, role="plant"), event.encode(), 1.0, 1000.0)
    (shown,) = feed.block(VEHICLE, 0, whole["numbered"], "s1")["events"]
    assert (shown["at"], shown["role"], shown["text"], shown["tick"]) == (1000.0, "plant", "here", 7)
    feed.take(topics.key("event", VEHICLE, role="plant"), b"nonsense", 1.0, 1000.0)  # anyone may publish it
    feed.take(topics.key("trace", VEHICLE, role="plant"), b"nonsense", 1.0, 1000.0)
    assert feed.block(VEHICLE, 0, whole["numbered"] + 1, "s1")["events"] == []


def test_nothing_of_the_session_before_is_in_the_rows_of_the_next() -> None:
    """Its first command answers tick 5, which was measured in the session before; what was desired then is not now."""
    settings, feed = load(), Feed()
    feed.take(topics.key("description", VEHICLE, role="plant"), description(settings, "plant").encode(), 0.0, 0.0)
    for message in made(settings, 200):
        feed.take(message.key, message.payload, 0.0, 0.0)
    writer = TraceWriter("plant", settings.wire, 2)
    writer.session = "s2"
    command = bytes(settings.wire.command.size)
    acted = int(Outcome.ACTED)
    row = PlantRow(1000, 200, Sent.NONE, Sent.FRAME, acted, 0, 5, 10**12, 10**12, b"", command, (1.0, 2.0))
    writer.row(row)
    feed.take(topics.key("trace", VEHICLE, role="plant"), writer.take(10**12, 0), 0.0, 0.0)
    columns = feed.vehicles[VEHICLE].columns
    (shown,) = feed.block(VEHICLE, 0, 0, "")["rows"]
    values = dict(zip(columns, shown[1:], strict=True))
    assert values["input", "u₂", "commanded"] == 1.0
    assert np.isnan(values["latency", "latency", "latency"])
    assert np.isnan(values["angles", "yaw", "desired"])


def test_a_bound_is_drawn_only_where_it_is_proven() -> None:
    settings = load()
    assert "theorem" not in {panel.group for panel in panels_of(settings, None)}
    assert [line.label for panel in panels_of(settings, 0.2) if panel.group == "theorem" for line in panel.lines] == [
        "measured",
        "bound",
    ]
    assert "latency" not in {panel.group for panel in panels_of(load(overrides=["loop.lockstep=true"]), None)}


def test_the_error_of_the_theorem_is_that_of_the_measurement_by_its_formula() -> None:
    """z of (C.6): 1 − η, ε̃ and ω_e + C₁ ε̃, worked by hand for ε̃ = (0.6, 0, 0) and ω_e = (0, 0.3, 0)."""
    settings, feed = load(overrides=["law.C1=[0.5,0.5,0.5]"]), Feed()
    certificate = certify(settings).model_copy(update={"holds": True, "plant_radius": 0.2})
    described = description(settings, "controller").model_copy(
        update={"certificate": certificate.model_dump(mode="json")}
    )
    feed.take(topics.key("description", VEHICLE, role="controller"), described.encode(), 0.0, 0.0)
    telemetry = Telemetry(
        session="s1", tick=0, counter=0, attitude_error=(0.6, 0.0, 0.0), rate_error=(0.0, 0.3, 0.0),
        desired=(1.0, 0.0, 0.0, 0.0), state={"sign": (1.0,)}, voltages=(0.0, 0.0),
    )  # fmt: skip
    feed.take(topics.key("telemetry", VEHICLE), telemetry.encode(), 0.0, 0.0)
    for message in made(settings, 100):
        if "/trace/plant" in message.key:
            feed.take(message.key, message.payload, 0.0, 0.0)
    at = 1 + feed.vehicles[VEHICLE].columns.index(("theorem", "‖z‖", "measured"))
    rows = feed.block(VEHICLE, 0, 0, "")["rows"]
    assert rows[0][at] == pytest.approx(sqrt(0.2**2 + 0.6**2 + 0.3**2 + 0.3**2), abs=1e-6)
    assert rows[0][at + 1] == 0.2


def test_of_several_controllers_the_one_with_the_session_is_shown() -> None:
    feed, key = Feed(), topics.key("status", VEHICLE, role="controller")
    spare = Status(role="controller", state="searching", process="spare", uptime_s=1, ticks=0, rate_hz=0, skipped=0)
    own = spare.model_copy(update={"state": "running", "process": "own", "session": "s1"})
    for now_s, status, shown in ((0.0, spare, "spare"), (0.1, own, "own"), (1.0, spare, "own"), (4.2, spare, "spare")):
        feed.take(key, status.encode(), now_s, 0.0)
        assert feed.gathered(now_s).statuses[VEHICLE]["controller"].process == shown


def test_a_controller_that_is_refused_changes_nothing_of_what_is_shown() -> None:
    """Its wire has other levels of the same bits: decoded with those, a pitch of 23.5° was shown as 11.6°."""
    settings, other = load(), load(overrides=["wire.attitude.limit=0.5", "law.C1=[1,1,1]"])
    feed, vehicle = Feed(), Vehicle(VEHICLE)
    feed.vehicles[VEHICLE] = vehicle
    keys = {role: topics.key("description", VEHICLE, role=role) for role in ("plant", "controller")}
    own = Status(
        role="controller", state="running", process="own", session="s1", uptime_s=1, ticks=0, rate_hz=0, skipped=0
    )
    refused = own.model_copy(update={"state": "searching", "process": "refused", "session": None})
    described = {
        "own": description(settings, "controller", process="own"),
        "refused": description(other, "controller", process="refused"),
    }
    for process in ("own", "refused"):
        feed.take(keys["controller"], described[process].encode(), 0.0, 0.0)
    feed.take(keys["plant"], description(settings, "plant", process="plant").encode(), 0.0, 0.0)
    assert vehicle.settings == other  # the newest, as no status is known yet
    feed.take(topics.key("status", VEHICLE, role="controller"), own.encode(), 0.0, 0.0)
    assert vehicle.settings == settings
    messages = [message for message in made(settings, 200) if "/trace/plant" in message.key]
    for message in messages:
        feed.take(message.key, message.payload, 0.0, 0.0)
    generation, rows = vehicle.generation, feed.block(VEHICLE, 0, 0, "")["rows"]
    feed.take(keys["controller"], described["refused"].encode(), 0.1, 0.0)
    feed.take(topics.key("status", VEHICLE, role="controller"), refused.encode(), 0.1, 0.0)
    assert (vehicle.generation, vehicle.settings) == (generation, settings)
    assert str(feed.block(VEHICLE, 0, 0, "")["rows"]) == str(rows) != "[]"
    for number in range(100):
        stranger = description(other, "controller", process=f"stranger {number}")
        feed.take(keys["controller"], stranger.encode(), 0.2, 0.0)
    assert (vehicle.generation, vehicle.settings) == (generation, settings)


def test_frames_are_read_as_the_plant_describes_them() -> None:
    """Whatever a controller says before its status tells whether it has the session."""
    settings, other = load(), load(overrides=["wire.attitude.limit=0.5"])
    messages = [message for message in made(settings, 200) if "/trace/plant" in message.key]
    rows = []
    for controller in (settings, other):
        feed = Feed()
        for role, each in (("plant", settings), ("controller", controller)):
            feed.take(topics.key("description", VEHICLE, role=role), description(each, role).encode(), 0.0, 0.0)
        for message in messages:
            feed.take(message.key, message.payload, 0.0, 0.0)
        rows.append(feed.block(VEHICLE, 0, 0, "")["rows"])
    assert str(rows[0]) == str(rows[1]) != "[]"


def test_the_law_s_state_is_drawn_as_in_a_log() -> None:
    drawn = {panel.label: panel.unit for panel in panels_of(load(), None) if panel.group == "damping_estimate"}
    assert drawn == {"θ̂₁": "N·m·s/rad", "θ̂₂": "N·m·s/rad", "θ̂₃": "N·m·s/rad"}


def test_a_law_that_is_not_installed_here_costs_its_state_alone() -> None:
    feed, role = Feed(), "controller"
    settings = load(overrides=["law.kind=not_installed_here:Law"])
    feed.take(topics.key("description", VEHICLE, role=role), description(settings, role).encode(), 0.0, 0.0)
    assert {group for group, *_ in feed.vehicles[VEHICLE].columns} >= {"angles", "input", "latency"}

"""Prometheus exporter without a network: what it serves, and that rules and README name the same metrics."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from math import radians, sin
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from aeroloop.protocol.messages.models import LATENCY_BOUNDS_US, LatencyCounts, Status, Telemetry
from aeroloop.protocol.messages.operator import Message
from aeroloop.protocol.messages.states import NOT_RECORDING, TripCause
from aeroloop.service import host
from aeroloop.service.cli.main import execute
from aeroloop.service.host.health import SILENT_S
from aeroloop.service.host.metrics import Exporter
from tests.support.clock import FakeClock

UNTIL = datetime(2027, 1, 31, tzinfo=UTC)
COUNTS = LatencyCounts(counts=[*range(len(LATENCY_BOUNDS_US)), 99], sum_us=2.5e6)
TELEMETRY = Telemetry(
    session="s", tick=1, counter=1, attitude_error=(0.0, 0.0, sin(radians(1.0))), rate_error=(0.0, 0.0, 0.0),
    desired=(1.0, 0.0, 0.0, 0.0), state={}, voltages=(0.0, 0.0),
)  # fmt: skip


def status(role: str, state: str, **more: Any) -> Status:
    return Status.model_validate(
        {"role": role, "state": state, "uptime_s": 60, "ticks": 500, "rate_hz": 500, "skipped": 7} | more
    )


PLANT = status("plant", "driven", session="s", latency_counts=COUNTS, trips={TripCause.ENVELOPE: 2})
CONTROLLER = status("controller", "running", session="s", process="first", certificate_until=UNTIL)
RECORDER = status("recorder", "recording", ticks=0, skipped=0, lost=5)


class Scrape:
    """An exporter, and its samples as a scrape gives them."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.exporter = Exporter(self.clock.monotonic)
        self.registry = CollectorRegistry()
        self.registry.register(self.exporter)
        self.receive("status/plant", PLANT)
        self.receive("status/controller", CONTROLLER)
        self.receive("status/recorder", RECORDER)
        self.receive("telemetry", TELEMETRY)

    def receive(self, key: str, message: Message, vehicle: str = "aero") -> None:
        self.exporter.receive(f"aeroloop/{vehicle}/{key}", message.encode())

    def families(self) -> dict[str, list[dict[str, str]]]:
        """Labels of each series by metric, which has the names of Prometheus' documentation and of its queries."""
        found: dict[str, list[dict[str, str]]] = {}
        for family in text_string_to_metric_families(generate_latest(self.registry).decode()):
            for sample in family.samples:
                name = family.name if family.type == "histogram" else sample.name
                found.setdefault(name, []).append(sample.labels)
        return found

    def values(self, name: str, **labels: str) -> list[float]:
        """Values of all series with a name and at least these labels."""
        families = text_string_to_metric_families(generate_latest(self.registry).decode())
        samples = [sample for family in families for sample in family.samples if sample.name == name]
        return [sample.value for sample in samples if labels.items() <= sample.labels.items()]


def test_each_roles_last_status_is_served_in_base_units_by_vehicle_and_role() -> None:
    scrape = Scrape()
    scrape.receive("status/plant", status("plant", "tripped", ticks=3), "other")
    one = {"vehicle": "aero"}
    for name, labels, expected in (
        ("aeroloop_build_info", {}, [1]),
        ("aeroloop_ticks_total", {"role": "plant"}, [500, 3]),
        ("aeroloop_skipped_ticks_total", {**one, "role": "controller"}, [7]),
        ("aeroloop_latency_seconds_bucket", {**one, "le": "0.0002"}, [1]),
        ("aeroloop_latency_seconds_bucket", {**one, "le": "+Inf"}, [99]),
        ("aeroloop_latency_seconds_count", one, [99]),
        ("aeroloop_latency_seconds_sum", one, [2.5]),
        ("aeroloop_trips_total", {**one, "cause": TripCause.ENVELOPE}, [2]),
        ("aeroloop_trips_total", {"cause": TripCause.BUS}, [0, 0]),  # else `increase` would miss the first trip
        ("aeroloop_state", {**one, "role": "plant", "state": "driven"}, [1]),
        ("aeroloop_state", {**one, "role": "plant", "state": "tripped"}, [0]),
        ("aeroloop_state", {"vehicle": "other", "state": "tripped"}, [1]),
        ("aeroloop_certificate_expiry_timestamp_seconds", {}, [UNTIL.timestamp()]),
        ("aeroloop_recorder_lost_messages_total", {}, [5]),
        ("aeroloop_recorder_missing", one, [0, 0]),
    ):
        assert scrape.values(name, **labels) == expected, (name, labels)
    assert scrape.values("aeroloop_attitude_error_radians") == [pytest.approx(radians(2.0))]
    scrape.receive("status/plant", PLANT.model_copy(update={"lacks_recorder": "gone"}))
    scrape.receive("status/recorder", status("recorder", NOT_RECORDING))
    assert scrape.values("aeroloop_recorder_missing", role="plant", **one) == [1]
    assert scrape.values("aeroloop_state", role="recorder", state=NOT_RECORDING) == [1]


def test_silence_makes_the_age_rise_and_nothing_else_change_but_the_error() -> None:
    scrape = Scrape()
    before = scrape.families()
    scrape.clock.advance(SILENT_S + 9)
    scrape.receive("status/recorder", RECORDER)
    for role, age in (("plant", 12), ("controller", 12), ("recorder", 0)):
        assert scrape.values("aeroloop_status_age_seconds", role=role) == [age]
    assert {*before} - {*scrape.families()} == {"aeroloop_attitude_error_radians"}


@pytest.mark.parametrize("session", [None, "t"])
def test_an_error_of_another_session_is_not_served(session: str | None) -> None:
    scrape = Scrape()
    assert scrape.values("aeroloop_attitude_error_radians")
    scrape.receive("status/controller", CONTROLLER.model_copy(update={"session": session}))
    assert not scrape.values("aeroloop_attitude_error_radians")


def test_of_several_controllers_the_one_with_the_session_counts_so_that_no_counter_jumps() -> None:
    scrape = Scrape()
    second = status("controller", "searching", process="second", ticks=3)

    def ticks_after(controller: Status) -> list[float]:
        scrape.receive("status/controller", controller)
        return scrape.values("aeroloop_ticks_total", role="controller")

    assert ticks_after(second) == [500]
    assert ticks_after(second.model_copy(update={"session": "t"})) == [3]
    assert ticks_after(CONTROLLER.model_copy(update={"session": None})) == [3]
    scrape.clock.advance(SILENT_S + 1)
    assert ticks_after(CONTROLLER.model_copy(update={"session": None})) == [500]


@pytest.mark.parametrize("payload", [b"", b"{}", b'{"role": "plant"}', b"\xff", b"[" + b"," * 10_000])
def test_what_is_no_status_changes_nothing(payload: bytes) -> None:
    scrape = Scrape()
    before = generate_latest(scrape.registry)
    for key in ("status/plant", "status/stranger", "telemetry", "event/plant", "nothing"):
        scrape.exporter.receive(f"aeroloop/aero/{key}", payload)
    assert generate_latest(scrape.registry) == before


def test_a_status_with_fields_of_a_later_version_counts() -> None:
    scrape = Scrape()
    later = PLANT.model_copy(update={"ticks": 9}).encode().replace(b"{", b'{"later": 1, ', 1)
    scrape.exporter.receive("aeroloop/aero/status/plant", later)
    assert scrape.values("aeroloop_ticks_total", role="plant") == [9]


def test_every_selector_of_the_rules_finds_a_series(capfd: pytest.CaptureFixture[str]) -> None:
    assert execute(["show", "alerts"]) == 0
    (group,) = yaml.safe_load(capfd.readouterr().out)["groups"]
    served = Scrape().families()
    for rule in group["rules"]:
        selectors = re.findall(r"(aeroloop_\w+)(?:\{(.*?)\})?", rule["expr"])
        assert selectors, rule["alert"]
        for name, matchers in selectors:
            wanted = dict(re.findall(r'(\w+)="([^"]*)"', matchers))
            series = served[name.removesuffix("_bucket")]
            assert any(wanted.items() <= labels.items() for labels in series), (rule["alert"], name, wanted)


def test_the_readme_has_every_metric_and_no_other() -> None:
    text = (Path(host.__file__).parent / "README.md").read_text(encoding="utf-8")
    assert {*re.findall(r"^\| `(aeroloop_\w+)`", text, re.MULTILINE)} == {*Scrape().families()}

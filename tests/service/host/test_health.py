"""Health of the roles on the network, for `op status --check`."""

from __future__ import annotations

import json
from typing import Any

import pytest

from aeroloop.protocol.messages.models import Percentiles, Status, Timing
from aeroloop.protocol.messages.states import NOT_RECORDING, STOPPED
from aeroloop.protocol.runtime.node import Node, RecorderWatch
from aeroloop.service.cli.main import execute as run
from aeroloop.service.host.health import LATE_SHARE, SILENT_S, Trouble, troubles
from aeroloop.service.host.operator import Gathered, gather
from tests.support.clock import FakeClock
from tests.support.zenoh_network import Gathering, eventually

PERIOD = Percentiles(count=5000, p50=2000, p99=2100, p999=2200, max=2300)


def status(role: str, state: str, **more: Any) -> Status:
    timing = Timing(
        wake=None, busy=None, period=None, recent_wake=None, recent_busy=None, recent_period=PERIOD
    )  # fmt: skip
    return Status(role=role, state=state, uptime_s=60, ticks=1, rate_hz=500, skipped=0, timing=timing, **more)


CONTROLLER, PLANT = status("controller", "running"), status("plant", "driven")


def of(controller: Status | None = CONTROLLER, plant: Status | None = PLANT, *silent: str) -> list[Trouble]:
    roles = {role: one for role, one in (("controller", controller), ("plant", plant)) if one is not None}
    return troubles(Gathered({"aero": roles}, list(silent)))


def test_a_loop_that_is_driven_in_time_is_well() -> None:
    assert of() == []
    assert troubles(Gathered({"aero": {"controller": CONTROLLER, "plant": PLANT}}, [])) == []  # without a recorder


def with_recorder(state: str, **more: Any) -> list[Trouble]:
    recorder = status("recorder", state, **more)
    return troubles(Gathered({"aero": {"controller": CONTROLLER, "plant": PLANT, "recorder": recorder}}, []))


SLOW = PERIOD.model_copy(update={"p99": PERIOD.p50 + 1})
LATE = int(LATE_SHARE * PERIOD.count) + 1


@pytest.mark.parametrize(
    ("found", "kind", "role", "says"),
    [
        (of(plant=status("plant", "tripped", cause="no command for 100 ms")), "tripped", "plant", "no command for 100"),
        (of(controller=status("controller", "faulted")), "faulted", "controller", "op arm"),
        (of(plant=status("plant", "driven", age_s=SILENT_S + 1)), "silent", "plant", "no status for 4 s"),
        (of(controller=status("controller", "running", recent_skipped=LATE)), "late", "controller", "51 ticks"),
        (of(plant=status("plant", "driven", recent_latency_us=SLOW)), "late", "plant", "2001 µs"),
        (of(controller=None), "missing", "controller", "aero has no controller"),
        (of(plant=None), "missing", "plant", "aero has no plant"),
        (of(plant=status("plant", "driven", unkept="read-only")), "not kept", "plant", "forget a stop at a restart"),
        (of(plant=status("plant", "tripped", unkept="read-only")), "tripped", "plant", "forget it: read-only"),
        (of(plant=status("plant", "driven", lacks_recorder="gone")), "missing", "recorder", "recorder is gone"),
        (of(status("controller", "searching", lacks_recorder="required")), "missing", "recorder", "requires one"),
        (
            of(
                status("controller", "running", lacks_recorder="required"),
                status("plant", "driven", lacks_recorder="gone"),
            ),
            "missing",
            "recorder",
            "recorder is gone",
        ),
        (
            with_recorder(NOT_RECORDING, cause="the disk is full"),
            "not recording",
            "recorder",
            "nothing: the disk is full",
        ),
        (with_recorder("recording", lost=7), "lossy", "recorder", "lost 7 messages"),
        (of(CONTROLLER, PLANT, "the recorder at x does not answer"), "silent", None, "recorder at x"),
    ],
)
def test_each_trouble_is_named_with_its_role(found: list[Trouble], kind: str, role: str | None, says: str) -> None:
    (trouble,) = found
    assert (trouble.kind, trouble.role) == (kind, role)
    assert says in trouble.text


def test_of_a_role_that_is_silent_nothing_older_is_said() -> None:
    tripped = status("plant", "tripped", age_s=60, recent_skipped=LATE)
    assert [trouble.kind for trouble in of(plant=tripped)] == ["silent"]


def test_what_skips_and_delays_within_the_limits_is_not_late() -> None:
    within = {"recent_skipped": LATE - 1, "recent_latency_us": PERIOD.model_copy(update={"p99": PERIOD.p50})}
    assert of(plant=status("plant", "driven", **within)) == []
    lockstep = CONTROLLER.model_copy(update={"timing": None, "recent_skipped": LATE})
    assert of(controller=lockstep) == []


def test_a_loop_that_hangs_is_known_by_the_age_of_its_status(capfd: pytest.CaptureFixture[str]) -> None:
    """Zenoh's threads answer for it. The node's clock is moved instead of waiting."""
    clock = FakeClock()
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}, clock=clock) as role:
        role.status(status("plant", "driven"))
        assert gather(gathering.settings).statuses["aero"]["plant"].age_s == 0
        clock.advance(10)
        network = f"network.rendezvous={gathering.settings.rendezvous[0]}"
        capfd.readouterr()
        assert run(["op", "status", "--set", network]) == 0
        assert "silent" in capfd.readouterr().out
        assert run(["op", "status", "--check", "--set", network]) == 1
        out = capfd.readouterr().out
        assert "aero's plant: no status for 10 s" in out
        assert "aero has no controller" in out
        assert run(["op", "status", "--check", "--json", "--set", network]) == 1
        judged = json.loads(capfd.readouterr().out)
        assert judged["well"] is False
        assert [trouble["kind"] for trouble in judged["troubles"]] == ["missing", "silent"]
        assert judged["vehicles"]["aero"]["plant"]["state"] == "driven"
        assert run(["op", "status", "--set", network, "--set", "vehicle=beta"]) == 1
        assert capfd.readouterr().err == "aeroloop: no role of beta answers, only of aero\n"


def test_skipped_ticks_are_counted_over_the_last_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    published: list[int] = []
    clock = FakeClock()
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}, clock=clock) as role:
        monkeypatch.setattr(role, "publish", lambda _, message: published.append(message.recent_skipped))
        for at, skipped in ((100, 7), (105, 9), (110, 9), (111, 9), (116, 10)):
            clock.now_ns = at * 10**9
            role.status(PLANT.model_copy(update={"skipped": skipped}))
    assert published == [0, 2, 2, 0, 1]


@pytest.mark.parametrize(("last", "gone"), [("recording", True), (STOPPED, False)])
def test_a_recorder_is_gone_if_it_was_there_and_did_not_stop_in_order(last: str, gone: bool) -> None:
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as plant:
        watch = RecorderWatch(plant)
        assert not watch.gone
        with Node("recorder", "aero", gathering.settings, {}) as role:
            role.announce()
            eventually("a recorder", lambda: watch.present)
            role.status(status("recorder", last))
        eventually("none", lambda: not watch.present)
        eventually("its last status", lambda: watch.gone == gone)

"""Health of the roles on the network, for `op status --check`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import pytest

from aeroloop.protocol.messages.models import Percentiles, Status, Timing
from aeroloop.protocol.messages.states import NOT_RECORDING, STOPPED
from aeroloop.protocol.runtime.node import Node, RecorderWatch
from aeroloop.service.cli.main import execute as run
from aeroloop.service.host.health import LATE_SHARE, SILENT_S, Trouble, troubles
from aeroloop.service.host.operator import Gathered, gather
from aeroloop.service.terminal.roles import role_sheets, status_sheets
from tests.support.clock import FakeClock
from tests.support.zenoh_network import Gathering, eventually

PERIOD = Percentiles(count=5000, p50=2000, p99=2100, p999=2200, max=2300)
SLOW = PERIOD.model_copy(update={"p99": PERIOD.p50 + 1})
LATE = int(LATE_SHARE * PERIOD.count) + 1


def status(role: str, state: str, **more: Any) -> Status:
    timing = Timing(wake=None, busy=None, period=None, recent_wake=None, recent_busy=None, recent_period=PERIOD)
    return Status.model_validate(
        {"role": role, "state": state, "uptime_s": 60, "ticks": 1, "rate_hz": 500, "skipped": 0, "timing": timing}
        | more
    )


def of(*roles: Status, silent: Sequence[str] = ()) -> list[Trouble]:
    """Troubles of a vehicle with these roles; of a controller and a plant that are well where none is given."""
    well = {"controller": status("controller", "running"), "plant": status("plant", "driven")}
    return troubles(Gathered({"aero": well | {each.role: each for each in roles}}, [*silent]))


@pytest.mark.parametrize(
    ("changed", "kind", "says"),
    [
        (status("plant", "tripped", cause="no command for 100 ms"), "tripped", "no command for 100"),
        (status("controller", "faulted"), "faulted", "op arm"),
        (status("plant", "driven", age_s=SILENT_S + 1), "silent", "no status for 4 s"),
        (status("plant", "tripped", age_s=60, recent_skipped=LATE), "silent", "no status"),  # nothing older is said
        (status("controller", "running", recent_skipped=LATE), "late", "51 ticks"),
        (status("plant", "driven", recent_latency_us=SLOW), "late", "2001 µs"),
        (status("plant", "driven", unkept="read-only"), "not kept", "forget a stop at a restart"),
        (status("plant", "tripped", unkept="read-only"), "tripped", "forget it: read-only"),
        (status("plant", "driven", lacks_recorder="gone"), "missing", "recorder is gone"),
        (status("controller", "searching", lacks_recorder="required"), "missing", "requires one"),
        (status("recorder", NOT_RECORDING, cause="the disk is full"), "not recording", "nothing: the disk is full"),
        (status("recorder", "recording", lost=7), "lossy", "lost 7 messages"),
    ],
)
def test_each_trouble_is_named_with_its_role(changed: Status, kind: str, says: str) -> None:
    (trouble,) = of(changed)
    assert trouble.kind == kind
    assert trouble.role == ("recorder" if changed.lacks_recorder else changed.role)
    assert says in trouble.text


@pytest.mark.parametrize(("lacks", "says"), [("gone", "recorder is gone"), ("required", "requires one"), (None, "")])
def test_a_recorder_that_is_missed_stands_among_the_roles_as_missing(lacks: str | None, says: str) -> None:
    roles = {
        "controller": status("controller", "running", lacks_recorder=lacks),
        "plant": status("plant", "driven", lacks_recorder=lacks),
    }
    (_, rows), *notes = role_sheets(roles, "aero")
    shown = {row["role"]: row["state"] for row in rows}
    assert shown.get("recorder") == ("missing" if lacks else None)
    told = [row["note"] for _, lines in notes for row in lines if row["role"] == "recorder"]
    assert [says in note for note in told] == [True] * (lacks is not None)
    other = {"beta": {"recorder": status("recorder", "recording")}}
    titles = [title for title, _ in status_sheets(Gathered({"aero": roles} | other, []))]
    assert ("the recorder under beta records every vehicle of its network" in titles) == (lacks is None)


def test_what_is_missing_or_does_not_answer_is_named_and_what_is_within_the_limits_is_well() -> None:
    assert [each.text for each in troubles(Gathered({"aero": {}}, []))] == [
        "aero has no controller", "aero has no plant",
    ]  # fmt: skip
    assert [each.text for each in of(silent=["the recorder at x does not answer"])] == [
        "the recorder at x does not answer"
    ]
    within = {"recent_skipped": LATE - 1, "recent_latency_us": PERIOD.model_copy(update={"p99": PERIOD.p50})}
    assert of(status("plant", "driven", **within)) == []
    assert of(status("controller", "running", timing=None, recent_skipped=LATE)) == []  # in lockstep
    assert of() == []  # without a recorder


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
            role.status(status("plant", "driven", skipped=skipped))
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

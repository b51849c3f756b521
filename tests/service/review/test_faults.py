"""Faults in a review: their intervals to the tick, their counts, and a verdict that names them."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest

from aeroloop.protocol.messages.models import FaultStatus, Status
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.report.page import verdict
from aeroloop.service.review.report import FaultInterval
from aeroloop.service.review.review import read
from tests.support.edited_log import edited, message_of, rewrite
from tests.support.made_log import START_NS, make_log

TICKS = 500
CONFIGURED = ["command:drop=0.3@0.2..0.6", "rate:noise=0.001@0.8", "attitude:off@5"]


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second at 500 Hz: two configured faults, a third to come, one injected at tick 300, all cleared at 450."""
    path = tmp_path_factory.mktemp("faulty") / "faulty.mcap"
    settings = load(overrides=[f"plant.faults={json.dumps(CONFIGURED)}"])
    make_log(path, TICKS, settings=settings, injected={300: "motor1:bias=0.5@0.05", 450: None})
    return path


def test_every_fault_that_acted_is_listed_with_its_ticks_and_what_it_changed(faulty: Path) -> None:
    """The plant's time starts with its first tick. An injection counts from the tick before it, as does clearing."""
    findings = read(faulty).findings
    withheld = findings.lapses["withheld"]
    assert 30 < withheld < 90  # of 200 commands; the plant's trace counts for itself
    assert findings.faults == [
        FaultInterval(
            fault="command:drop=0.3@0.2..0.6", source="configured", begin_s=0.2, end_s=0.6, changed=withheld,
            effect="commands dropped",
        ),
        FaultInterval(
            fault="motor1:bias=0.5@0.05", source="injected", begin_s=0.648, end_s=0.898, changed=125,
            effect="voltages shifted",
        ),
        FaultInterval(
            fault="rate:noise=0.001@0.8", source="configured", begin_s=0.8, end_s=0.898, changed=50,
            effect="samples made noisy",
        ),
    ]  # fmt: skip


def test_the_verdict_names_the_faults_and_a_review_lists_them_before_the_figures(
    faulty: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = read(faulty).findings
    word, good, because = verdict(findings)
    assert (word, good) == ("Faults", None)
    counts = f"{findings.lapses['withheld']} commands dropped, 125 voltages shifted, 50 samples made noisy"
    assert f"3 faults acted at the plant: {counts}." in because
    assert execute(["log", "review", str(faulty)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert text.index("command:drop=0.3@0.2..0.6 0.200 s 0.600 s") < text.index(" z_track ")


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of 50 ticks without a status, which begins at the plant's tick 100."""

    def later(columns: Any) -> None:
        columns["tick"] += 100

    folder = tmp_path_factory.mktemp("quiet")
    make_log(folder / "plain.mcap", 50, settings=load())
    return rewrite(folder / "plain.mcap", folder / "quiet.mcap", edited("plant", later))


def status(session: str | None, uptime_s: float, changed: int, end_tick: int | None = None) -> Status:
    fault = FaultStatus(
        fault="command:drop=0.1", source="configured", begin_tick=10, end_tick=end_tick, changed=changed, effect="…"
    )
    return Status(
        role="plant", state="driven", session=session, uptime_s=uptime_s, ticks=1, rate_hz=500, skipped=0,
        faults=[fault],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("statuses", "found"),
    [
        # Only what it changed in this session counts, between the statuses of before and after.
        ([status("r", 1, 3), status(None, 2, 5), status("s1", 3, 6), status(None, 4, 9), status("t", 5, 20)],
         [(0.0, None, 9 - 5)]),
        # What another process of the plant counted before is not subtracted.
        ([status(None, 100, 50), status("s1", 3, 6), status(None, 0.5, 0)], [(0.0, None, 6)]),
        ([status("s1", 3, 6, end_tick=100)], []),  # over before the session began, at the plant's tick 100
        ([status("s1", 3, 6, end_tick=101)], [(0.0, 0.002, 6)]),
    ],
)  # fmt: skip
def test_a_fault_counts_for_its_session_alone_in_whatever_order_statuses_were_recorded(
    quiet: Path, tmp_path: Path, statuses: list[Status], found: list[tuple[float, float | None, int]]
) -> None:
    said = [message_of("status", one, START_NS + i, role="plant") for i, one in enumerate(statuses)]
    random.Random(len(said)).shuffle(said)
    more = [one._replace(recorded_ns=START_NS + 10**9 + i) for i, one in enumerate(said)]
    faults = read(rewrite(quiet, tmp_path / "a.mcap", more=more)).findings.faults
    assert [(one.begin_s, one.end_s, one.changed) for one in faults] == found

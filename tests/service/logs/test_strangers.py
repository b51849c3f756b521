"""Foreign and malformed messages in a log: every verb gives what it gives without them, and names them."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Event, Telemetry, Truth
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.logs.copies import copy
from aeroloop.service.logs.export import export
from aeroloop.service.logs.replay import replay
from aeroloop.service.report.page import page
from aeroloop.service.review.report import Findings
from aeroloop.service.review.review import read, read_runs
from tests.support.edited_log import Said, contents, rewrite
from tests.support.every_message import MESSAGES
from tests.support.hostile import TOKENS
from tests.support.made_log import SESSION, START_NS, VEHICLE, description, lockstep, make_log

TICKS = 300
HUGE = 10**400
TRUTH = Truth(tick=1, attitude=(1.0, 0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0), voltages=(), session=SESSION, session_tick=7)
WELL_FORMED: dict[str, list[bytes]] = {
    "event": [
        Event(role="plant", kind="refused", text="no", session=SESSION, tick=HUGE).encode(),
        Event(role="plant", kind="armed", text="yes", session=SESSION, tick=-HUGE).encode(),
    ],
    "telemetry": [
        Telemetry(
            session=SESSION,
            tick=HUGE,
            counter=HUGE,
            attitude_error=(0.0, 0.0, 0.0),
            rate_error=(0.0, 0.0, 0.0),
            desired=(1.0, 0.0, 0.0, 0.0),
            state={},
            voltages=(),
        ).encode()
    ],
    "truth": [TRUTH.encode(), TRUTH.model_copy(update={"session_tick": HUGE, "voltages": (0.0, 0.0)}).encode()],
}
"""Messages that their model accepts and that make no sense all the same."""


def foreign(topic: topics.Topic, role: str) -> Iterator[bytes]:
    """What a stranger may publish on a topic, and its model does not accept."""
    chance = random.Random(f"{topic.name} {role}")
    yield from (b"", b"{}", b"[]", b"null", b"[" * 5000, b'{"a":' * 5000, b'{"tick": 1e999}')
    yield from (chance.randbytes(size) for size in (1, 111, 112, 113, 400))
    yield from TOKENS
    yield from (one.encode() for one in MESSAGES if type(one) is not topic.model)
    if topic.name == "description":
        good = description(lockstep(), role)
        wide = {"rate": {"bits": HUGE}}
        configs: list[dict[str, object]] = [{}, {"lasers": {}}, {"law": 5}, {"wire": wide}, {"plant": []}]
        yield from (good.model_copy(update={"config": config}).encode() for config in configs)
        for wrong in ({"vehicle": "other"}, {"role": "operator"}, {"protocol": HUGE}, {"protocol": 1}):
            yield good.model_copy(update=wrong).encode()


def strangers() -> list[Said]:
    """All of it on every topic of every daemon, at three instants; and well-formed messages of another vehicle."""
    found = []
    for topic in topics.TOPICS.values():
        if topic.kind == "frame":  # which a log only has as evidence beside the traces
            continue
        for role in ("plant", "controller", "recorder") if "{role}" in topic.key else ("plant",):
            key = topics.key(topic.name, VEHICLE, session=SESSION, role=role)
            payloads = [*foreign(topic, role), *WELL_FORMED.get(topic.name, ())]
            for at_ns in (-(10**9), 2 * 10**8, 10**10):
                found += [Said(key, START_NS + at_ns + i, payload) for i, payload in enumerate(payloads)]
            others = [one.encode() for one in MESSAGES if type(one) is topic.model and not isinstance(one, Description)]
            other = topics.key(topic.name, "other", session=SESSION, role=role)
            found += [Said(other, START_NS + i, payload) for i, payload in enumerate(others)]
    return found


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good log in lockstep, with truths, statuses and events."""
    path = tmp_path_factory.mktemp("clean") / "a.mcap"
    settings = load(overrides=["loop.lockstep=true", 'plant.faults=["motor1:bias=0.5@0.2"]'])
    make_log(path, TICKS, settings=settings, truth_every=10)
    return rewrite(path, path.with_name("clean.mcap"))


@pytest.fixture(scope="module")
def dirty(clean: Path) -> Path:
    """The same with everything that strangers may publish."""
    return rewrite(clean, clean.with_name("dirty.mcap"), more=strangers())


def without_names(findings: Findings) -> Findings:
    """Findings less what names a file, and less the marks that a stranger's event makes."""
    marks = [mark for mark in findings.marks if mark.text not in ("no", "yes")]
    return findings.model_copy(update={"damages": [], "log": None, "marks": marks})


READ = ("description", "event", "loss", "status", "trace", "truth")


def named(damages: list[str]) -> set[str]:
    """Topics of which malformed messages are named."""
    return {line.rpartition(" of ")[2] for line in damages if "malformed: " in line}


def test_a_review_a_page_and_a_comparison_are_those_of_the_clean_log(clean: Path, dirty: Path) -> None:
    good, bad = read(clean).findings, read(dirty).findings
    assert without_names(bad) == without_names(good)
    assert good.damages == []
    assert named(bad.damages) == set(READ)
    one, other = read_runs([clean, dirty])
    assert without_names(other.findings) == without_names(one.findings)
    assert len(page([read(dirty).report()])) > 10_000


def test_both_ends_replay_and_it_is_said_what_was_malformed(
    clean: Path, dirty: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = replay([clean]), replay([dirty])
    assert bad.controller == good.controller
    assert bad.plant == good.plant
    assert (bad.sessions, bad.reasons, bad.missing) == (good.sessions, {}, [])
    assert named(bad.damages) == {"description", "trace"}
    assert execute(["log", "replay", str(dirty)]) == 0
    assert "malformed: " in capsys.readouterr().out


def test_every_table_has_the_rows_of_the_clean_log(clean: Path, dirty: Path, tmp_path: Path) -> None:
    a, b = (export([log], "csv", tmp_path / f"{log.stem}.csv") for log in (clean, dirty))
    assert Path(a.out).read_text() == Path(b.out).read_text()
    assert (b.rows, b.columns, b.sessions) == (a.rows, a.columns, a.sessions)
    assert named(b.damages) == {"description", "trace", "truth"}


def test_a_copy_reads_as_the_clean_log(clean: Path, dirty: Path, tmp_path: Path) -> None:
    assert named(copy([dirty], tmp_path / "out.mcap").damages) == {"description", "trace"}
    assert without_names(read(tmp_path / "out.mcap").findings) == without_names(read(clean).findings)
    assert replay([tmp_path / "out.mcap"]).plant == replay([clean]).plant


def test_traces_of_another_vehicle_are_named_and_judged_only_if_it_is_asked_for(
    clean: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No description describes it, so where it is asked for it cannot be compared."""
    ghost = [
        one._replace(key=one.key.replace("/aero/", "/ghost/")) for one in contents(clean)[0] if one.topic == "trace"
    ]
    path = rewrite(clean, tmp_path / "a.mcap", more=ghost)
    both, good = replay([path]), replay([clean])
    assert (both.controller, both.plant) == (good.controller, good.plant)
    assert execute(["log", "replay", str(path)]) == 0
    assert f"not judged: ghost/{SESSION}, {2 * TICKS} rows" in capsys.readouterr().out
    assert execute(["log", "replay", str(path), "--vehicle", "ghost"]) == 1
    assert "no description of ghost's controller or plant" in capsys.readouterr().err


FIELDS = {"sizes": (4, 4), "rows": (8, 4), "run": (16, 8), "first_row": (24, 8), "monotonic_ns": (32, 8)}
"""Where a batch's header has them, and in how many bytes."""


@pytest.mark.parametrize(
    "wrong",
    [
        {"rows": 2**32 - 1},
        {"first_row": 2**63 + 1},
        {"monotonic_ns": 2**62},
        {"first_row": 20, "sizes": 0x0004_0006},
        {"run": 99, "first_row": 2**62 - 1},
    ],
)
def test_batches_that_no_end_publishes_are_malformed_messages(
    clean: Path, tmp_path: Path, wrong: dict[str, int]
) -> None:
    """Of more rows than a batch has, rows that another batch has, or a session that another process claimed."""
    junk = []
    for end in ("controller", "plant"):
        one = next(one for one in contents(clean)[0] if one.key.endswith(f"trace/{end}") and len(one.data) > 1000)
        data = bytearray(one.data)
        for name, value in wrong.items():
            at, size = FIELDS[name]
            data[at : at + size] = value.to_bytes(size, "little")
        junk.append(one._replace(data=bytes(data)))
    path = rewrite(clean, tmp_path / "a.mcap", more=junk)
    found = read(path).findings
    assert without_names(found) == without_names(read(clean).findings)
    assert named(found.damages) == {"trace"}
    assert replay([path]).plants == replay([clean]).plants
    assert replay([path]).sessions == replay([clean]).sessions

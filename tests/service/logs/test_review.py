"""The review puts together what came to the recorder by two links: every frame is judged at its own tick."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

import pytest

from plant_emulator.endpoint import Endpoint
from protocol.messages import Claim, Telemetry
from service.config import Settings, load
from service.controller import Controller
from service.figures import Figures
from service.logs.review import Session
from service.logs.ticks import Tick
from service.telling import telemetry_of

PERIOD_NS = 2_000_000
START_NS = 1_800_000_000_000_000_000
TICKS = 400

Feed = Callable[[Session], None]


def settings(*, lockstep: bool) -> Settings:
    return load(overrides=[f"loop.lockstep={str(lockstep).lower()}"])


@pytest.fixture(scope="module")
def run() -> list[tuple[int, bytes, bytes, Telemetry]]:
    """A closed loop of 400 ticks: (k, measurement, command, telemetry)."""
    config = settings(lockstep=True)
    wire, period = config.wire, config.loop.period
    endpoint = Endpoint(config.plant.build(period), wire, PERIOD_NS, lockstep=True)
    endpoint.claim(
        Claim(controller="test", session="loop", period_ns=PERIOD_NS, lockstep=True, auto_arm=True, wire=wire)
    )
    controller = Controller(wire, config.law, config.reference, period)
    ticks = []
    measurement = endpoint.tick(None, 0)
    for k in range(TICKS):
        assert measurement is not None
        command = controller.tick(measurement, k)
        assert command is not None
        telemetry = telemetry_of(controller, "loop")
        ticks.append((k, measurement, command, telemetry))
        measurement = endpoint.tick(command, k + 1)
    return ticks


def judged(session: Session, messages: Iterator[tuple[int, Feed]]) -> Figures:
    """Feed messages in the order of their arrival, the first of each pair."""
    for _, feed in sorted(messages, key=lambda message: message[0]):
        feed(session)
    session.finish()
    return session.score.figures()


def arrivals(
    run: list[tuple[int, bytes, bytes, Telemetry]],
    measurement_delay: Callable[[int], int] = lambda _k: 0,
    command_delay: Callable[[int], int] = lambda _k: 0,
    answer_ns: int = 300_000,
) -> Iterator[tuple[int, Feed]]:
    """When each message comes to the recorder: its publication plus the delay of its link. A link keeps its order."""
    latest_measurement = latest_command = 0
    for k, measurement, command, telemetry in run:
        published = START_NS + k * PERIOD_NS
        answered = published + answer_ns
        latest_measurement = max(latest_measurement, published + measurement_delay(k))
        latest_command = max(latest_command, answered + command_delay(k))
        yield latest_measurement, lambda s, m=measurement, t=published: s.measurement(m, t)  # type: ignore[misc]
        yield latest_command, lambda s, c=command, t=answered: s.command(c, t)  # type: ignore[misc]
        if k % 10 == 0:
            yield latest_command + 1, lambda s, telemetry=telemetry, t=answered + 1: s.telemetry(telemetry, t)  # type: ignore[misc]


def undisturbed(run: list[tuple[int, bytes, bytes, Telemetry]]) -> Figures:
    return judged(Session(settings(lockstep=False)), arrivals(run))


def test_every_tick_counts_once(run: list[tuple[int, bytes, bytes, Telemetry]]) -> None:
    figures = undisturbed(run)
    assert figures.duration_s == TICKS * PERIOD_NS * 1e-9
    assert figures.skipped_ticks == 0


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("slow", ["measurements", "commands", "either, by turns"])
@pytest.mark.parametrize("delay_ms", [1, 10, 33, 200])
def test_a_link_to_the_recorder_that_lags_changes_nothing(
    run: list[tuple[int, bytes, bytes, Telemetry]], lockstep: bool, slow: str, delay_ms: int
) -> None:
    """Up to a hundred ticks, six times round the counter."""
    rng = random.Random(delay_ms)

    def lag(_k: int) -> int:
        return rng.randrange(delay_ms * 1_000_000)

    measurement_delay = lag if slow != "commands" else lambda _k: 0
    command_delay = lag if slow != "measurements" else lambda _k: 0
    figures = judged(Session(settings(lockstep=lockstep)), arrivals(run, measurement_delay, command_delay))
    assert figures == undisturbed(run)


def test_what_the_recorder_lost_leaves_the_rest_where_it_was(run: list[tuple[int, bytes, bytes, Telemetry]]) -> None:
    """Three times the counter's round is missing in the middle; the ticks after it are still the right ones."""
    ticks: list[Tick] = []
    session = Session(settings(lockstep=False), watch=ticks.append)
    judged(session, arrivals([tick for tick in run if not 100 <= tick[0] < 148]))
    assert [tick.k for tick in ticks] == [*range(100), *range(148, TICKS)]
    whole_ticks: list[Tick] = []
    whole = Session(settings(lockstep=False), watch=whole_ticks.append)
    judged(whole, arrivals(run))
    assert {t.k: t.attitude_error for t in ticks}.items() <= {t.k: t.attitude_error for t in whole_ticks}.items()


def test_a_recorder_that_came_late_learns_the_tick_from_telemetry(
    run: list[tuple[int, bytes, bytes, Telemetry]],
) -> None:
    ticks: list[Tick] = []
    session = Session(settings(lockstep=False), watch=ticks.append)
    judged(session, arrivals(run[203:]))
    assert [tick.k for tick in ticks] == list(range(203, TICKS))


def test_an_unanswered_measurement_at_the_end_is_not_judged(run: list[tuple[int, bytes, bytes, Telemetry]]) -> None:
    messages = list(arrivals(run))
    last = START_NS + (TICKS - 1) * PERIOD_NS + 300_000
    figures = judged(Session(settings(lockstep=False)), iter([m for m in messages if m[0] < last]))
    assert figures.duration_s == (TICKS - 1) * PERIOD_NS * 1e-9

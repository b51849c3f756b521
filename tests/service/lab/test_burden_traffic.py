"""Traffic of one direction, on synthetic codes and beside a loop that sends on change."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.transmit import UNCHANGED, Sender
from aeroloop.service.config import Settings, load
from aeroloop.service.lab.burden import POLICIES, codes_of, observe, traffic
from aeroloop.service.lab.experiment import run_experiment, sent_ticks

KIND = FrameFormat([6, 6], 4)
CODES = np.array([(0, 0), (0, 0), (0, 1), (2, 0), (2, 0), (2, 0), (2, 0), (2, 0), (2, 0), (2, 0)], float)
PERIOD = 0.01


def test_every_tick_is_sent_when_periodic() -> None:
    assert sent_ticks(CODES, "periodic", 4).tolist() == list(range(10))


def test_on_change_sends_what_is_new_and_a_heartbeat_after_so_many_ticks() -> None:
    assert sent_ticks(CODES, "on_change", 4).tolist() == [0, 2, 3, 7]
    assert sent_ticks(CODES, "on_change", 7).tolist() == [0, 2, 3]


def test_rates_are_over_all_ticks_and_intervals_between_frames_sent() -> None:
    seen = traffic(CODES, KIND, np.array([0, 2, 3, 7]), PERIOD)
    assert seen.frames_per_s == pytest.approx(40)
    assert seen.bits_per_s == pytest.approx(40 * 16)
    assert seen.component_changes_per_s == pytest.approx([10, 20])  # 0→2, and 0→1→0
    assert seen.changes_per_s == pytest.approx(30)
    assert seen.mean_interval_ms == pytest.approx(70 / 3)
    assert seen.least_interval_ms == pytest.approx(10)
    assert seen.can_frames == 1
    assert seen.can_bits_per_s == pytest.approx(40 * 75)
    assert seen.can_load == pytest.approx(0.003)


def test_changes_do_not_depend_on_what_was_sent() -> None:
    always, changed = traffic(CODES, KIND, np.arange(10), PERIOD), traffic(CODES, KIND, np.array([0]), PERIOD)
    assert always.changes_per_s == changed.changes_per_s > 0
    assert changed.mean_interval_ms is None
    assert changed.least_interval_ms is None


def test_a_frame_longer_than_a_classic_one_counts_as_several() -> None:
    floats = FrameFormat([None, None], 4)
    seen = traffic(np.array([(0.0, 1.0)] * 4), floats, np.arange(4), PERIOD)
    assert floats.size == 17
    assert seen.can_frames == 3
    assert seen.can_bits_per_s == pytest.approx(100 * (135 + 135 + 65))


def test_nothing_and_nonsense_are_refused() -> None:
    with pytest.raises(ValueError, match="ticks"):
        traffic(np.empty((0, 2)), KIND, np.arange(0), PERIOD)
    with pytest.raises(ValueError, match="malformed"):
        codes_of([KIND.pack(0, (1, 2)), UNCHANGED], KIND)


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
    """The last bit included: frames, their ticks, figures."""
    settings = load(overrides=overrides)
    said: list[tuple[bytes, bytes]] = []
    run_experiment(settings, 3.0, watch=lambda _k, *frames: said.append(frames))
    received: list[tuple[bytes, bytes]] = []
    figures = run_experiment(_on_change(settings), 3.0, watch=lambda _k, *frames: received.append(frames))

    seen = observe(settings.description(), 3.0)
    assert seen.figures is not None
    assert (seen.figures.z_track, seen.figures.u_total) == (figures.z_track, figures.u_total)
    assert list(seen.traffic) == list(POLICIES)
    wire = settings.wire
    counters = wire.measurement.counters
    heartbeat = wire.transmit.heartbeat_ticks(settings.loop.period_ns, counters)
    for i, (kind, measured) in enumerate(((wire.measurement, figures.measurement), (wire.command, figures.command))):
        sent = sent_ticks(codes_of([frames[i] for frames in said], kind), "on_change", heartbeat).tolist()
        assert [k for k, frames in enumerate(received) if frames[i] != UNCHANGED] == sent
        assert [received[k][i] for k in sent] == [said[k][i] for k in sent]
        reckoned = seen.traffic["on_change"][i]
        assert (reckoned.frames_per_s, reckoned.bits_per_s) == (measured.frames_per_s, measured.bits_per_s)
        assert 0 < len(sent) < len(said)


def _on_change(settings: Settings) -> Settings:
    transmit = settings.wire.transmit.model_copy(update={"measurement": "on_change", "command": "on_change"})
    return settings.model_copy(update={"wire": settings.wire.model_copy(update={"transmit": transmit})})


@given(
    st.lists(st.sampled_from([(0.0, 1.0), (-0.0, 1.0), (nan, 1.0), (2.0, 1.0)]), min_size=1, max_size=40),
    st.integers(1, 7),
)
def test_ticks_sent_are_those_of_a_sender(codes: list[tuple[float, float]], heartbeat: int) -> None:
    sender = Sender("on_change", heartbeat, 16)
    sent = [k for k, each in enumerate(codes) if sender.due(k, each)]
    assert sent_ticks(np.array(codes), "on_change", heartbeat).tolist() == sent

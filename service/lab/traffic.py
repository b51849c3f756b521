"""Traffic of one direction of a loop: frames, changes, intervals, bits on the wire and on CAN.

Computed from the frames of every tick. Sending on change withholds frames that repeat the last one, and the other end
holds the same levels, so one run gives the traffic of either policy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.transmit import Policy
from aeroloop.service.figures import Floats, Integers, StreamFigures
from aeroloop.service.lab.bus import BITRATE, bus_bits, classic_frames


class Traffic(StreamFigures):
    """Traffic of one direction under one policy, over the whole run."""

    frames_per_s: float
    bits_per_s: float = Field(description="payload bits, padding included")
    changes_per_s: float = Field(description="changes of a component's code, of all components together")
    component_changes_per_s: list[float] = Field(description="the same, one by one: ε₁ ε₂ ε₃ ω₁ ω₂ ω₃, or u in order")
    mean_interval_ms: float | None = Field(description="from one frame to the next; null for less than two [ms]")
    least_interval_ms: float | None = Field(description="the least of these times [ms]")
    can_frames: int = Field(
        description="classic CAN frames that a frame fills; more than one is a split, without any header, of what "
        "this project sends as one CAN FD frame"
    )
    can_bits_per_s: float = Field(description="bits on a classic CAN bus, with worst-case stuffing")
    can_load: float = Field(description="share of a classic bus of 1 Mbit/s; above 1 it does not fit")


def codes_of(frames: Sequence[bytes], kind: FrameFormat) -> Floats:
    """Codes of frames. Shape (frames, components).

    Raises:
        ValueError: A frame is malformed.
    """
    unpacked = [kind.unpack(frame) for frame in frames]
    if None in unpacked:
        raise ValueError("a frame is malformed")
    return np.array([content[1] for content in unpacked if content is not None], float)


def frames_of(codes: Floats, kind: FrameFormat) -> list[bytes]:
    """The frames of every tick from 0 on. Shape of the codes: (ticks, components)."""
    columns = [
        column.tolist() if width is None else column.astype(int).tolist()
        for column, width in zip(codes.T, kind.widths, strict=True)
    ]
    return [kind.pack(k % kind.counters, row) for k, row in enumerate(zip(*columns, strict=True))]


def sent_ticks(codes: Floats, policy: Policy, heartbeat: int) -> Integers:
    """The ticks at which a policy sends; as a `Sender` decides where no tick is missed.

    Args:
        codes: Codes at every tick from 0 on. Shape (ticks, components).
        policy: The transmit policy.
        heartbeat: The most ticks from one frame to the next.
    """
    ticks = np.arange(len(codes))
    if policy == "periodic":
        return ticks
    now, before = codes[1:], codes[:-1]
    alike = (now == before) & (np.signbit(now) == np.signbit(before)) | np.isnan(now) & np.isnan(before)
    changed = np.concatenate([[True], ~alike.all(axis=1)])
    since = ticks - np.maximum.accumulate(np.where(changed, ticks, 0))
    sent: Integers = ticks[since % heartbeat == 0]
    return sent


def traffic(codes: Floats, kind: FrameFormat, sent: Integers, period: float) -> Traffic:
    """The traffic of one direction.

    Args:
        codes: Codes at every tick from 0 on. Shape (ticks, components).
        kind: Format of the frames.
        sent: Ticks at which a frame was sent.
        period: Time between ticks [s].

    Raises:
        ValueError: There are no ticks.
    """
    if not len(codes):
        raise ValueError("no ticks, no traffic")
    duration = len(codes) * period
    changes = np.count_nonzero(np.diff(codes, axis=0), axis=0) / duration
    intervals = np.diff(sent) * (period * 1e3)
    on_bus = len(sent) * bus_bits(kind.size) / duration
    return Traffic(
        frames_per_s=len(sent) / duration,
        bits_per_s=len(sent) * kind.size * 8 / duration,
        changes_per_s=float(changes.sum()),
        component_changes_per_s=changes.tolist(),
        mean_interval_ms=float(intervals.mean()) if len(intervals) else None,
        least_interval_ms=float(intervals.min()) if len(intervals) else None,
        can_frames=len(classic_frames(kind.size)),
        can_bits_per_s=on_bus,
        can_load=on_bus / BITRATE,
    )

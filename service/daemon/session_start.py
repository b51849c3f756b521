"""What a session takes up from the one before, and where it begins."""

from __future__ import annotations

from math import degrees

from aeroloop.protocol.messages.models import SessionRecord
from aeroloop.protocol.messages.operator import Hold, Points, Reference
from aeroloop.protocol.wire.attitude import Quaternion, Vector, to_euler

_DECIMALS = 3
"""Of an attitude found [deg]: far finer than any level, and short to print."""


def remaining(last: SessionRecord, period: float) -> Reference:
    """What a session that was cut short had still to follow; period in s.

    Points go on with the first that it had not reached; a sinusoid begins anew.
    """
    reference = last.reference
    if not isinstance(reference, Points):
        return reference
    followed_s = ((last.ended_tick or 0) - last.since_tick) * period - last.within_s
    ahead = [i for i, time in enumerate(reference.times) if time >= followed_s]
    if len(ahead) < 2:
        return Hold(attitude=reference.attitudes[-1])
    times, first = reference.times[ahead[0] :], reference.times[ahead[0]]
    return Points(times=[time - first for time in times], attitudes=reference.attitudes[ahead[0] :])


def found(attitude: Quaternion, *, rolls: bool) -> Vector:
    """Roll, pitch, yaw at which the body is found [deg]; roll is 0 for a vehicle that cannot roll."""
    roll, pitch, yaw = (round(degrees(angle), _DECIMALS) for angle in to_euler(attitude))
    return (roll if rolls else 0.0, pitch, yaw)

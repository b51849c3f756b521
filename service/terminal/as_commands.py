"""Gains and reference of a session as commands that an operator can paste into a shell."""

from __future__ import annotations

from collections.abc import Sequence
from shlex import join
from typing import Final

from aeroloop.protocol.messages.models import SessionRecord
from aeroloop.protocol.messages.operator import Hold, Points, Sinusoid, Stream

WITHIN_S: Final = 2.0
"""For a reference that was followed from a session's first tick on [s]."""


def as_commands(record: SessionRecord, options: Sequence[str] = ()) -> list[str]:
    """`op set-gains`, and `op goto` or `op track`, each with a comment that says where its values come from.

    `options` are appended to each. Points stand in a here-document. A stream's time to reach a set-point has no option.
    """
    gains = [word for name, value in record.gains.named.items() for word in (f"--{name}", *_numbers(value))]
    move, table = ["track", "hold"], ""
    match record.reference:
        case Hold(attitude=attitude) if attitude is not None:
            move = ["goto", *_numbers(attitude)]
        case Sinusoid(amplitude=amplitude, frequency=frequency):
            move = ["track", "sinusoid", "--amplitude", *_numbers(amplitude), "--frequency", *_numbers(frequency)]
        case Stream(timeout_s=timeout_s):
            move = ["track", "stream", "--timeout", *_numbers([timeout_s])]
        case Points(times=times, attitudes=attitudes):
            move = ["track", "/dev/stdin"]
            rows = (",".join(_numbers([time, *attitude])) for time, attitude in zip(times, attitudes, strict=True))
            table = "\n".join(["", *rows, "END"])
    move += ["--in", *_numbers([record.within_s or WITHIN_S])]
    ended = f"; session {record.session} ended: {record.ended}" if record.ended else ""
    return [
        f"{join(['aeroloop', 'op', 'set-gains', *gains, *options])}  # {record.gains_from}{ended}",
        f"{join(['aeroloop', 'op', *move, *options])}{' <<END' if table else ''}  # {record.reference_from}{table}",
    ]


def _numbers(values: Sequence[float]) -> list[str]:
    return [repr(float(value)).removesuffix(".0") for value in values]

"""Operators' requests to a controller: `set_gains` and `track`.

Each is checked in a thread beside the loop, which takes time, and applied by the loop between two ticks.
"""

from __future__ import annotations

from collections.abc import Callable

from aeroloop.protocol.messages.models import Source
from aeroloop.protocol.messages.operator import Answer, Gains, Track
from aeroloop.protocol.runtime.node import Node
from aeroloop.service.daemon.operator_changes import OperatorChanges


def serve(role: Node, changes: OperatorChanges) -> None:
    """Serve the requests. FollowError is the answer where one is refused."""
    vehicle = role.vehicle

    def prepare_gains(gains: Gains) -> Callable[[], Answer]:
        changes.admit(gains)

        def apply() -> Answer:
            text = changes.set_gains(gains)
            return Answer(done=True, text=f"{vehicle}: {text or 'no gain was given, so none has changed'}")

        return apply

    def prepare_reference(track: Track) -> Callable[[], Answer]:
        source: Source = "operator" if track.reference is not None else "configured"
        reference = track.reference or changes.configured
        plan = changes.plan(reference)
        changes.admit()

        def apply() -> Answer:
            text = changes.follow(reference, plan, track.within_s, source)
            return Answer(done=True, text=f"{vehicle} {text}")

        return apply

    role.serve("set_gains", Gains, prepare_gains)
    role.serve("track", Track, prepare_reference)

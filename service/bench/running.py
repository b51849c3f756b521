"""Running loop: controller, emulator and recorder as processes on a network of their own, and their statuses."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import zenoh
from pydantic import ValidationError

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.states import PlantState
from aeroloop.service.config import Settings
from aeroloop.service.testing.process_group import ProcessGroup, ProcessGroupError, RoleName, standalone

ROLES: Final[tuple[RoleName, ...]] = ("controller", "plant", "recorder")
STATUS_WAIT_S: Final = 20.0
_CHECK_S: Final = 0.5
_OWN_INTERPRETER: Final = {"PYTHONUNBUFFERED": "1"}
"""Any variable makes a process group start a new interpreter instead of a fork."""


class RunningLoop:
    """A loop that drives its plant, and the statuses of some of its roles.

    Attributes:
        processes: Its processes.
    """

    def __init__(self, processes: ProcessGroup, vehicle: str, roles: Sequence[str] = ROLES) -> None:
        self.processes = processes
        self._roles = roles
        self._received: dict[str, Status] = {}
        self._changed = threading.Condition()
        processes.zenoh.declare_subscriber(topics.key("status", vehicle), self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        # On a starved machine Zenoh 1.10 was seen to deliver a publisher's numbers of four bytes under its key, too.
        with suppress(ValidationError), self._changed:
            status = Status.model_validate_json(sample.payload.to_bytes())
            self._received[status.role] = status
            self._changed.notify_all()

    def statuses(self) -> dict[str, Status]:
        """The next status of each role.

        Raises:
            ProcessGroupError: A process has failed, or published none within `STATUS_WAIT_S`.
        """
        deadline = time.monotonic() + STATUS_WAIT_S
        with self._changed:
            self._received.clear()
            while not self._received.keys() >= {*self._roles}:
                self._changed.wait(_CHECK_S)
                self.processes.check()
                if time.monotonic() > deadline:
                    silent = ", ".join(role for role in self._roles if role not in self._received)
                    raise ProcessGroupError(f"no status of {silent} within {STATUS_WAIT_S:g} s")
            return dict(self._received)

    def await_drive(self) -> dict[str, Status]:
        """The first statuses after the controller began to drive the plant. Raises as `statuses`, and if it does not.

        Raises:
            ProcessGroupError: As of `statuses`; or the plant is not driven within `STATUS_WAIT_S`.
        """
        deadline = time.monotonic() + STATUS_WAIT_S
        while (found := self.statuses())["plant"].state != PlantState.DRIVEN:
            if time.monotonic() > deadline:
                raise ProcessGroupError(f"the plant is {found['plant'].state} for {STATUS_WAIT_S:g} s, not driven")
        return found


@contextmanager
def running_loop(settings: Settings, *, own_interpreters: bool = False) -> Iterator[RunningLoop]:
    """Start the three processes, the log in a temporary folder, and stop them at the end.

    With `own_interpreters` each is started as a user starts it, instead of as a fork of a process that has imported
    what all of them need.

    Raises:
        ProcessGroupError: A process did not start.
    """
    environment = _OWN_INTERPRETER if own_interpreters else None
    with tempfile.TemporaryDirectory(prefix="aeroloop-") as folder:
        settings = standalone(settings, Path(folder) / "log.mcap")
        with ProcessGroup(settings) as processes:
            loop = RunningLoop(processes, settings.vehicle)
            for role in ("recorder", "plant"):
                processes.start(role, environment=environment)
                processes.await_role(role)
            processes.start("controller", environment=environment)
            yield loop

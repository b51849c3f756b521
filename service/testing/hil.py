"""Hardware-in-the-loop tests: runs controller, plant and recorder as a process group and injects faults.

The `hil` fixture of the pytest plugin is a `Hil`; it works without pytest, too. In real time `run` sleeps; in lockstep
the plant takes an exact number of steps, so a test repeats bit for bit on a busy machine.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import Condition
from typing import Any, Final, Literal, Self

import zenoh
from mcap.reader import make_reader

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status
from aeroloop.protocol.messages.operator import Advance, Answer, Ask, Change, Inject, Message
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.messages.trace import Batch, End, Received, Sent, read_batch
from aeroloop.service.config import Settings, load
from aeroloop.service.figures import Figures
from aeroloop.service.review.review import review
from aeroloop.service.testing.process_group import ProcessGroup, RoleName, free_rendezvous, private_bus

ROLES: Final[tuple[RoleName, ...]] = ("recorder", "plant")
PATIENCE_S: Final = 30.0
"""Timeout for another process: one starts in about a second here, and CI machines are busy."""
PATIENCE_PER_STEP_S: Final = 0.02
"""Timeout per step in lockstep: a hundred times what a step takes here."""


class HilError(AeroloopError):
    """The loop did not reach a state that the test requires; one line."""


class HilLog:
    """The log of a run.

    Attributes:
        path: The MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def figures(self) -> Figures:
        """Every figure of merit, from the log alone. Raises ReviewError if it holds no session."""
        return review(self.path)

    @property
    def events(self) -> list[Event]:
        """Events in order."""
        return [message for _, message in self.messages("event") if isinstance(message, Event)]

    @property
    def trips(self) -> list[str]:
        """Cause of each trip of the plant, in order."""
        return [event.text for event in self.events if event.kind == "tripped"]

    def batches(self, end: End) -> list[Batch]:
        """Trace batches of one end, in the order of recording."""
        read = [read_batch(content) for _, content in self.messages("trace") if isinstance(content, bytes)]
        return [batch for batch in read if batch is not None and batch.header.end == end]

    def times(self, end: End, column: Literal["received", "sent"]) -> list[int]:
        """Times at which one end received or sent frames, on its wall clock [ns since 1970]."""
        frame = Received.FRAME if (end, column) == ("controller", "received") else Sent.FRAME
        return [
            at_ns + batch.header.wall_ns - batch.header.monotonic_ns
            for batch in self.batches(end)
            for at_ns, kind in zip(batch.times_ns(column).tolist(), batch.columns[f"{column}_as"].tolist(), strict=True)
            if at_ns >= 0 and kind == frame
        ]

    @property
    def changes(self) -> list[Change]:
        """Changes of references and gains that controllers applied, in order."""
        return [change for batch in self.batches("controller") for change in batch.tail.changes]

    def messages(self, name: str) -> list[tuple[int, Message | bytes]]:
        """Time of publication [ns] and content of every message of one topic; frames and traces are bytes."""
        found: list[tuple[int, Message | bytes]] = []
        topic = topics.TOPICS[name]
        with self.path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                address = topics.read_key(channel.topic)
                if address is not None and address.topic is topic:
                    content = topic.model.model_validate_json(message.data) if topic.model else message.data
                    found.append((message.publish_time, content))
        return found


class Hil:
    """A closed loop of real processes.

    Args:
        folder: Folder of the logs.
        lockstep: Whether `run` counts steps instead of seconds.
        plant: The plant end: a value of `plant.via`, or can-node for an emulated node on a private bus.
        config: TOML file to start from, unless `start` names another.

    Attributes:
        events: Events received so far.
        settings: The configuration, once started.
        processes: The process group, once started.
    """

    settings: Settings
    processes: ProcessGroup

    def __init__(
        self, folder: Path, *, lockstep: bool = False, plant: str = "emulator", config: Path | None = None
    ) -> None:
        self._folder = folder
        self._via = plant.replace("can-node", "can")
        self._private_bus = plant == "can-node"
        self._config = config
        self._lockstep = lockstep
        self._running = False
        self._logs: list[HilLog] = []
        self._changed = Condition()
        self._statuses: dict[str, Status] = {}
        self._requested_ticks = 0
        self.events: list[Event] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.finish()

    def start(
        self, config: Path | str | None = None, settings: Mapping[str, Any] | None = None, *, drive: bool = True
    ) -> None:
        """Start a recorder, a plant and a controller, and wait until the controller drives the plant.

        Args:
            config: A TOML file, as for `--config`.
            settings: Overrides as for `--set`: section.key to value. Without one of `controller.after_restart` the
                controller follows the configured reference from the start.
            drive: Whether to start a controller and wait for it.

        Raises:
            ConfigError: The configuration is invalid.
            HilError: The loop did not close.
        """
        self.finish()
        log = self._folder / f"hil-{len(self._logs)}.mcap"
        ours = {
            "network.rendezvous": free_rendezvous(),
            "recorder.path": str(log),
            "recorder.max_file_mb": 1e6,  # a test reads one file
            "recorder.max_file_s": 1e6,
            "controller.require_recorder": True,
            "controller.after_restart": "configured",
            "loop.lockstep": self._lockstep,
            "plant.steps_on_request": self._lockstep and self._via == "emulator",
            "plant.via": self._via,
        }
        overrides = [f"{key}={json.dumps(value)}" for key, value in {**ours, **(settings or {})}.items()]
        self.settings = load(Path(config) if config else self._config, overrides)
        if self._private_bus:
            self.settings = self.settings.model_copy(update={"can": private_bus(self.settings.can)})
        self.events.clear()
        self._statuses.clear()
        self._requested_ticks = 0
        self.processes = ProcessGroup(self.settings)
        self._running = True
        self._logs.append(HilLog(log))
        for name, receive in (("event", self._receive_event), ("status", self._receive_status)):
            self.processes.zenoh.declare_subscriber(topics.key(name, self.settings.vehicle), receive)
        self.processes.start("recorder")
        self.processes.start_plant()
        if drive:
            self.processes.start("controller")  # it waits for the recorder before it claims
        for role in ROLES:
            self.processes.await_role(role)
        if drive:
            ready = {PlantState.GRANTED, PlantState.DRIVEN} if self._lockstep else {PlantState.DRIVEN}
            self.eventually("the controller drives the plant", lambda: self.state("plant") in ready)

    def run(self, seconds: float) -> None:
        """Run the loop for a time; in lockstep for that many steps, or until the session ends.

        In lockstep an emulator stops between two calls; other plants run on, so they take at least that many steps.

        Raises:
            ProcessGroupError: A process has failed.
            HilError: In lockstep, the plant does not step in time.
        """
        if not self._lockstep:
            time.sleep(seconds)
            self.processes.check()
            return
        self._requested_ticks += self.settings.loop.ticks(seconds)
        if self._via == "emulator":
            self._query("advance", Advance(seconds=seconds))

        def over() -> bool:
            plant = self._statuses.get("plant")
            return plant is not None and (plant.ticks >= self._requested_ticks or plant.session is None)

        patience_s = PATIENCE_S + PATIENCE_PER_STEP_S * self.settings.loop.ticks(seconds)
        self.eventually(f"{seconds:g} s in lockstep", over, patience_s)
        self.processes.check()

    def inject(self, fault: str | None) -> None:
        """Inject a fault into the emulated plant, its times in seconds from now: `signal:kind[=value][@start[..end]]`.

        None clears all faults.

        Raises:
            HilError: The fault is malformed, or the plant is not emulated.
        """
        self._query("inject", Inject(clear=True) if fault is None else Inject(faults=[fault]))

    def arm(self) -> None:
        """Arm the plant, as `aeroloop op arm`."""
        self._query("arm", Ask())

    def stop(self) -> None:
        """Stop the plant, as `aeroloop op stop`."""
        self._query("stop", Ask())

    def kill(self, role: RoleName) -> None:
        """Kill a role with SIGKILL."""
        self.processes.stop(role, signal.SIGKILL)

    def pause(self, role: RoleName) -> None:
        """Pause a role with SIGSTOP; its links stay open."""
        self.processes.signal(role, signal.SIGSTOP)

    def resume(self, role: RoleName) -> None:
        """Resume a paused role with SIGCONT."""
        self.processes.signal(role, signal.SIGCONT)

    def restart(self, role: RoleName) -> None:
        """Start a role again that has ended, and wait until it is on the network.

        A recorder begins another log, which `log` then returns.
        """
        if role == "recorder":
            self._logs.append(HilLog(self._folder / f"hil-{len(self._logs)}.mcap"))
            self.processes.replace_log(self._logs[-1].path)
        self.processes.start(role)
        if role != "controller":
            self.processes.await_role(role)

    def state(self, role: str) -> str | None:
        """State of `plant`, `controller` or `recorder` in its last status; None before the first."""
        status = self._statuses.get(role)
        return status.state if status else None

    def status(self, role: str) -> Status:
        """The last status of a role. Raises HilError before the first."""
        if role not in self._statuses:
            raise HilError(f"no status received from the {role}")
        return self._statuses[role]

    def happened(self, kind: str, text: str = "") -> bool:
        """Whether an event of this kind, with this in its text, was received."""
        return any(event.kind == kind and text in event.text for event in self.events)

    def eventually(self, what: str, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        """Wait until a condition on the loop holds. Raises HilError if it does not hold in time."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not condition():
                if time.monotonic() > deadline:
                    states = ", ".join(f"{role} {status.state}" for role, status in sorted(self._statuses.items()))
                    last = "; ".join(f"{event.role} {event.kind}: {event.text}" for event in self.events[-3:])
                    raise HilError(
                        f"not within {timeout_s:g} s: {what} ({states or 'no status was received'}"
                        f"{f'; last events: {last}' if last else ''})"
                    )
                self._changed.wait(0.05)

    def finish(self) -> None:
        """Stop all processes and close the log."""
        if self._running:
            self._running = False
            self.processes.__exit__(None, None, None)

    @property
    def log(self) -> HilLog:
        """The log since `start`, or since the recorder's last restart. Reading it ends the run."""
        self.finish()
        if not self._logs:
            raise HilError("nothing was started, so there is no log")
        return self._logs[-1]

    def _query(self, topic: str, message: Message) -> None:
        key = topics.key(topic, self.settings.vehicle)
        for reply in self.processes.zenoh.get(key, payload=message.encode(), timeout=PATIENCE_S):
            if reply.ok is not None:
                answer = Answer.model_validate_json(reply.ok.payload.to_bytes())
                if not answer.done:
                    raise HilError(answer.text)
                return
        raise HilError(f"no answer to {topic!r}")

    def _receive_event(self, sample: zenoh.Sample) -> None:
        with self._changed:
            self.events.append(Event.model_validate_json(sample.payload.to_bytes()))
            self._changed.notify_all()

    def _receive_status(self, sample: zenoh.Sample) -> None:
        status = Status.model_validate_json(sample.payload.to_bytes())
        with self._changed:
            self._statuses[status.role] = status
            self._changed.notify_all()

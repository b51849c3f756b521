"""Hardware-in-the-loop tests: runs controller, plant and recorder as a process group, operates it and injects faults.

The `hil` fixture of the pytest plugin is a `Hil`; it works without pytest, too. In real time `run` sleeps; in lockstep
the plant takes an exact number of steps, and what an operator requests holds from the next tick on, so a test repeats
bit for bit on a busy machine.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status
from aeroloop.protocol.messages.operator import Advance, Answer, Gains, Hold, Inject, Message, Reference, Request, Track
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wording import problem
from aeroloop.service.config import Settings, as_overrides, load
from aeroloop.service.host.operator import send, stop
from aeroloop.service.settings import read_points
from aeroloop.service.testing.hil_log import HilLog as HilLog
from aeroloop.service.testing.process_group import PATIENCE_S, ProcessGroup, RoleName, free_rendezvous, private_bus
from aeroloop.service.testing.process_group import HilError as HilError
from aeroloop.service.testing.process_group import __tracebackhide__ as __tracebackhide__

PLANTS: Final = ("emulator", "can", "can-node", "can-node-c", "quanser")
"""Plant ends by name; any other name is of a plant, which the emulator runs."""

PATIENCE_PER_STEP_S: Final = 0.02
"""Timeout per step in lockstep: a hundred times what a step takes here."""


class Hil:
    """A closed loop of real processes, with the events received so far.

    Args:
        folder: Folder of the logs.
        lockstep: Whether `run` counts steps instead of seconds.
        plant: The plant end: a value of `plant.via`; can-node for an emulated node on a private bus, can-node-c for the
            same in C; any other value of `plant.kind`, such as package.module:Class, for the emulator with that plant.
        config: TOML file to start from, unless `start` names another.
    """

    def __init__(
        self, folder: Path, *, lockstep: bool = False, plant: str = "emulator", config: Path | None = None
    ) -> None:
        self._folder, self._lockstep, self._config = folder, lockstep, config
        self._private_bus = plant in ("can-node", "can-node-c")
        self._plant: dict[str, Any] = {"plant.via": "can" if self._private_bus else plant}
        if plant not in PLANTS:
            self._plant = {"plant.via": "emulator", "plant.kind": plant}
        if plant == "can-node-c":
            self._plant["can.node_in_c"] = True
        self._processes: ProcessGroup | None = None
        self._logs: list[HilLog] = []
        self._requested_ticks = 0
        self._may_advance = 0.0  # from when on the plant answers another such query, on the monotonic clock [s]

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
            settings: Overrides: `{"loop.rate_hz": 200}`, as for `--set`, or nested, `{"loop": {"rate_hz": 200}}`.
                Without one of `controller.after_restart` the controller follows the configured reference at once.
            drive: Whether to start a controller and wait for it.

        Raises:
            HilError: The configuration is invalid, or the loop did not close.
        """
        self.finish()
        log = self._folder / f"hil-{len(self._logs)}.mcap"
        ours = {
            "network.rendezvous": free_rendezvous(),
            "network.mode": "peer",
            "recorder.path": str(log),
            "recorder.max_file_mb": 1e6,  # a test reads one file
            "controller.require_recorder": True,
            "controller.after_restart": "configured",
            "loop.lockstep": self._lockstep,
            "plant.steps_on_request": self._steps,
            **self._plant,
        }
        try:
            overrides = as_overrides(ours) + as_overrides(settings or {})  # a later one wins
            loaded = load(Path(config) if config else self._config, overrides)
        except AeroloopError as error:
            raise HilError(str(error)) from None
        if self._private_bus:
            loaded = loaded.model_copy(update={"can": private_bus(loaded.can)})
        self._requested_ticks = 0
        self._processes = ProcessGroup(loaded, log.with_suffix(""))
        self._logs.append(HilLog(log))
        self.processes.start_loop(drive=drive, own_node=self._private_bus)
        if drive:
            self.eventually("the controller drives the plant", self._closed)

    @property
    def _steps(self) -> bool:  # on request only
        return self._lockstep and self._plant["plant.via"] == "emulator"

    def run(self, seconds: float) -> None:
        """Run the loop for a time; in lockstep for that many steps, or until the session ends.

        In lockstep an emulator stops between two calls; other plants run on, so they take at least that many steps.
        Raises HilError if a process has failed or, in lockstep, the plant does not step in time.
        """
        self._check_running()
        if not self._lockstep:
            time.sleep(seconds)
            self.processes.check()
            return
        steps = self.settings.loop.ticks(seconds)
        self._requested_ticks += steps
        if self._steps:
            self._advance(seconds)

        def over() -> bool:
            plant = self.processes.statuses.get("plant")
            return plant is not None and (plant.ticks >= self._requested_ticks or plant.session is None)

        self.eventually(f"{seconds:g} s in lockstep", over, PATIENCE_S + PATIENCE_PER_STEP_S * steps)
        self.processes.check()

    # ── an operator's verbs; each returns what was done, in one line, and raises HilError if it is refused ──

    def arm(self) -> str:
        """Arm the plant and recall controllers, as `aeroloop op arm`."""
        return self._operate("arm", Request)

    def stop(self) -> str:
        """Stop the plant, as `aeroloop op stop`."""
        self._check_running()
        answers, failures = stop(self.settings.network, self.settings.vehicle)
        if failures:
            raise HilError("; ".join(failures))
        return "; ".join(answers)

    def release(self) -> str:
        """Make the controller release the vehicle, as `aeroloop op release`."""
        return self._operate("stand_down", Request)

    def goto(self, roll: float, pitch: float, yaw: float, in_s: float | None = None) -> str:
        """Turn to an attitude [deg], as `aeroloop op goto`; `in_s` as of `track`."""
        return self.track(Hold(attitude=(roll, pitch, yaw)), in_s)

    def track(self, reference: Reference | Mapping[str, Any] | Path, in_s: float | None = None) -> str:
        """Follow a reference, a table as of `[reference]`, or a CSV file of points, as `aeroloop op track`.

        `in_s` is the time to reach it [s]; None for the shortest within the limits.
        """
        followed = read_points(reference) if isinstance(reference, Path) else reference
        return self._operate("track", Track, reference=followed, within_s=in_s)

    def set_gains(self, **gains: float | Sequence[float]) -> str:
        """Change gains of the law by name, as `aeroloop op set-gains`."""
        return self._operate("set_gains", Gains, **gains)

    def inject(self, fault: str | None) -> str:
        """Inject `signal:kind[=value][@start[..end]]`, times in s from now, into the plant; None clears all faults."""
        return self._operate("inject", Inject, faults=[fault] if fault else [], clear=fault is None)

    # ── processes ──

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

        A plant that has tripped stays at 0 V until `arm`, unless `controller.auto_arm` is set. A recorder begins
        another log, which `log` then returns.
        """
        if role == "recorder":
            self._logs.append(HilLog(self._folder / f"hil-{len(self._logs)}.mcap"))
            self.processes.start(role, "--log", str(self._logs[-1].path))
        else:
            self.processes.start(role)
        if role != "controller":
            self.processes.await_role(role)

    # ── what there is to see ──

    @property
    def events(self) -> list[Event]:
        """Events received so far, in order."""
        return self.processes.events

    def state(self, role: str) -> str | None:
        """State of `plant`, `controller` or `recorder` in its last status; None before the first."""
        return self.processes.state(role)

    def status(self, role: str) -> Status:
        """The last status of a role. Raises HilError before the first."""
        if role not in self.processes.statuses:
            raise HilError(f"no status received from the {role}")
        return self.processes.statuses[role]

    def happened(self, kind: str, text: str = "") -> bool:
        """Whether an event of this kind, with this in its text, was received."""
        return any(event.kind == kind and text in event.text for event in self.events)

    def eventually(self, what: str, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        """Wait until a condition on the loop holds. Raises HilError if it does not hold in time."""
        self.processes.eventually(what, condition, timeout_s)

    @property
    def settings(self) -> Settings:
        """The configuration. Raises HilError before `start`."""
        return self.processes.settings

    @property
    def processes(self) -> ProcessGroup:
        """The process group. Raises HilError before `start`."""
        if self._processes is None:
            raise HilError("nothing was started: call `hil.start()` first")
        return self._processes

    @property
    def log(self) -> HilLog:
        """The log since `start`, or since the recorder's last restart. Reading it ends the run."""
        self.processes.close()
        return self._logs[-1]

    def finish(self) -> None:
        """Stop all processes and close the log."""
        if self._processes is not None:
            self._processes.close()

    def evidence(self) -> list[str]:
        """Stop all processes, write page and events beside each log, and return a line for each file there."""
        self.finish()
        lines = [line for log in self._logs for line in log.evidence(self.events if log is self._logs[-1] else [])]
        outputs = sorted(output for log in self._logs for output in log.path.with_suffix("").glob("*.txt"))
        return [*lines, *(f"{output}: output of the {output.stem}" for output in outputs if output.stat().st_size)]

    def _closed(self) -> bool:
        """Whether the controller drives the plant; in lockstep, whether both ends have begun a session."""
        plant, controller = map(self.processes.statuses.get, ("plant", "controller"))
        if not self._lockstep or plant is None or controller is None:
            return plant is not None and plant.state == PlantState.DRIVEN
        return plant.session is not None and plant.session == controller.session

    def _check_running(self) -> None:
        if self.processes.closed:
            raise HilError("the run has ended, as reading `hil.log` ends it: call `hil.start()` for another")

    def _operate(self, topic: str, model: type[Message], **values: Any) -> str:
        self._check_running()
        try:
            return send(self.settings.network, self.settings.vehicle, topic, model.model_validate(values))
        except ValidationError as error:
            raise HilError(problem(error, model)) from None
        except AeroloopError as error:
            raise HilError(str(error)) from None

    def _advance(self, seconds: float) -> None:
        """Let the emulator step, by a query that is a test's and no operator's."""
        time.sleep(max(0.0, self._may_advance - time.monotonic()))
        message, key = Advance(seconds=seconds), topics.key("advance", self.settings.vehicle)
        for reply in self.processes.zenoh.get(key, payload=message.encode(), timeout=PATIENCE_S):
            if reply.ok is not None:
                answer = Answer.model_validate_json(reply.ok.payload.to_bytes())
                self._may_advance = time.monotonic() + 1 / topics.QUERIES_PER_S  # sooner, it is dropped
                if not answer.done:
                    raise HilError(answer.text)
                return
        raise HilError("the plant does not answer the request to step")

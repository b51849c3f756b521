"""Experiment: runs controller and plant end in one process, in lockstep, in one of two ways with the same bits.

The whole loop is one function, `loop_function`; or a `for` loop over the two ends, through real frames, for what that
function cannot express: faults, a law in Python, a user's own plant, `watch`, a run that trips. Without network or
clock it repeats bit for bit, and a demo in lockstep over Zenoh gives the same figures.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from math import nan
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from aeroloop.plant_emulator.plant import Plant
from aeroloop.protocol.messages.models import Claim, Refusal
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.interface import ExpressionLaw
from aeroloop.service.control.laws.registry import law_class
from aeroloop.service.control.reference import Limits, Trajectory
from aeroloop.service.figures import Figures, Floats, Integers, figures
from aeroloop.service.lab.lockstep import LockstepLoop
from aeroloop.service.lab.loop_function import Course, loop_of

REASONS = {"latency_us": "lockstep without a network has no latency", "log": "nothing crossed a network"}

BYTES_A_TICK: Final = 600
"""Memory that an experiment takes for each tick: inputs, outputs and errors, each column and its copies."""

Watch: TypeAlias = Callable[[int, bytes, bytes], None]
"""Called at every tick with k, the measurement and the command that answers it; UNCHANGED where none is sent."""


class LoopEndedError(ValueError):
    """The plant tripped before the end; one line with time and cause.

    Attributes:
        after_s: The time [s].
        causes: Why, a line each.
    """

    def __init__(self, after_s: float, causes: list[str]) -> None:
        super().__init__(after_s, causes)  # as they are, so that a worker process can hand it over
        self.after_s, self.causes = after_s, causes

    def __str__(self) -> str:
        return f"the loop ended after {self.after_s:g} s: {'; '.join(self.causes) or 'no answer'}"


class Experiment(NamedTuple):
    """Figures of an experiment, the loop's course, and whether it ran as one function."""

    figures: Figures
    course: Course
    compiled: bool


def experiment(
    settings: Settings,
    duration_s: float,
    progress: Callable[[float], None] | None = None,
    watch: Watch | None = None,
    *,
    plant: Plant | None = None,
    controller: Controller | None = None,
) -> Experiment:
    """Run the closed loop as one function if that is possible, else through frames.

    Args:
        settings: The configuration.
        duration_s: Length of the run [s].
        progress: Called once a second of the run with the time reached [s].
        watch: Called at every tick with the frames of both directions.
        plant: Plant to control, which stays open; the configuration's if None.
        controller: Controller to run; the configuration's if None.

    Raises:
        FollowError: A controller would refuse the reference: it is beyond `controller.max_reference_rate` or
            `max_reference_tilt_deg`, or rolls a vehicle that cannot.
        LoopEndedError: The plant tripped.
        PluginError, PlantError: The configured plant is not there, or failed.
        ValueError: The ends do not fit each other, such as a law for 3 motors and a plant with 2; or the run is too
            long for this machine's memory.
    """
    Trajectory.of(settings.reference).check(Limits.of(settings.controller, settings.wire.actuators))
    _check_length(settings, duration_s)
    if watch is None and plant is None and controller is None:
        course = _as_one_function(settings, duration_s, progress)
        if course is not None:
            ticks, transmit, heartbeat = len(course.errors), settings.wire.transmit, heartbeat_of(settings)
            unsent = (
                ticks - len(sent_ticks(course.measured, transmit.measurement, heartbeat)),
                ticks - len(sent_ticks(course.commanded, transmit.command, heartbeat)),
            )
            return Experiment(_figures(settings, np.arange(ticks), course, unsent), course, compiled=True)
    if plant is not None:
        return _through_frames(settings, duration_s, progress, watch, plant, controller)
    with closing(settings.plant.make(settings.loop.period)) as made:  # 0 V at the end: it may be a machine
        return _through_frames(settings, duration_s, progress, watch, made, controller)


def _check_length(settings: Settings, duration_s: float) -> None:
    """Raise ValueError if the columns of a run would not fit into this machine's memory."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    longest_s = memory / BYTES_A_TICK * settings.loop.period
    if duration_s > longest_s:
        raise ValueError(
            f"a run of {duration_s:g} s at {settings.loop.rate_hz:g} Hz does not fit into this machine's memory: "
            f"{longest_s:.1g} s or less would"
        )


def run_experiment(
    settings: Settings | None = None,
    duration_s: float = 50.0,
    progress: Callable[[float], None] | None = None,
    watch: Watch | None = None,
    *,
    plant: Plant | None = None,
    controller: Controller | None = None,
) -> Figures:
    """Run controller and plant in lockstep in this process; it repeats bit for bit. Returns the figures of merit.

    `settings` are the defaults (the paper's experiment at 8 and 6 bits) if None; other arguments as of `experiment`.
    Raises ValueError if the plant trips, or the configuration makes no loop, and FollowError for a reference that a
    controller would refuse.
    """
    return experiment(settings or load(), duration_s, progress, watch, plant=plant, controller=controller).figures


def _as_one_function(settings: Settings, duration_s: float, progress: Callable[[float], None] | None) -> Course | None:
    loop, ticks, reported = settings.loop, settings.loop.ticks(duration_s), 0

    def report(done: int) -> None:
        nonlocal reported
        while progress is not None and reported < done:
            progress(reported * loop.period)
            reported += max(1, loop.ticks(1.0))

    of_expressions = issubclass(law_class(settings.law), ExpressionLaw)
    if not ticks or not of_expressions or settings.plant.faults or settings.plant.actuators != settings.wire.actuators:
        return None
    return loop_of(settings).run(settings, ticks, report)


def _figures(settings: Settings, used: Integers, course: Course, unsent: tuple[int, int]) -> Figures:
    errors, commands = (used, course.errors), (np.arange(len(course.voltages)), course.voltages)
    watchdog_s = settings.plant.watchdog_s
    return figures(
        settings.wire, settings.loop.period, errors, commands, watchdog_s=watchdog_s, unsent=unsent, reasons=REASONS
    )


def heartbeat_of(settings: Settings) -> int:
    """The most ticks from one frame to the next where frames are sent on change."""
    return settings.wire.transmit.heartbeat_ticks(settings.loop.period_ns, settings.wire.measurement.counters)


def _through_frames(
    settings: Settings,
    duration_s: float,
    progress: Callable[[float], None] | None,
    watch: Watch | None,
    plant: Plant,
    controller: Controller | None,
) -> Experiment:
    loop, wire = settings.loop, settings.wire
    controller = controller or Controller(wire, settings.law, settings.reference, loop.period)
    for fault in settings.plant.parsed_faults:
        if fault.signal in ("measurement", "command"):
            raise ValueError(f"fault {fault} acts on frames that cross a network: use `aeroloop demo --lockstep`")
    endpoint = settings.plant.endpoint(plant, loop.model_copy(update={"lockstep": True}), wire)
    answer = endpoint.claim(
        Claim(controller="experiment", session="lab", period_ns=loop.period_ns, lockstep=True, auto_arm=True, wire=wire)
    )
    if isinstance(answer, Refusal):
        raise ValueError(answer.reason)

    level = wire.voltage.quantizer().level
    seen: list[float] = [nan] * 6
    codes, voltages = [nan] * wire.actuators, [nan] * wire.actuators
    used, errors = list[int](), list[Vector]()
    measured, commanded, commands = list[list[float]](), list[list[float]](), list[list[float]]()
    silent = [0, 0]  # measurements and commands without a frame
    report_every = loop.ticks(1.0)
    both = LockstepLoop(endpoint, controller, endpoint.tick(None, 0))
    for k in range(loop.ticks(duration_s)):
        measurement = both.measurement
        command: bytes | None = None
        for answered in both.answer():
            command = answered.command
        if measurement is None or command is None:
            trips = [notice.text for notice in endpoint.notices if notice.kind == "tripped"]
            raise LoopEndedError(k * loop.period, trips if controller.fault is None else [controller.fault])
        if controller.tick_index == k:  # it used the measurement
            used.append(k)
            errors.append(controller.attitude_error)
            silent[0] += measurement == UNCHANGED
        if measurement and (read := wire.measurement.unpack(measurement)):
            seen = list(read[1])
        if read := wire.command.unpack(command):
            codes = list(read[1])
            voltages = [level(code) for code in codes]
        measured.append(seen)
        commanded.append(codes)
        commands.append(voltages)
        silent[1] += command == UNCHANGED
        if watch is not None:
            watch(k, measurement, command)
        both.advance(command)
        if progress is not None and k % report_every == 0:
            progress(k * loop.period)
    rows = ((measured, 6), (commanded, wire.actuators), (commands, wire.actuators), (errors, 3))
    course = Course(*(np.array(each, float).reshape(-1, columns) for each, columns in rows))
    return Experiment(
        _figures(settings, np.array(used, dtype=np.int64), course, (silent[0], silent[1])), course, compiled=False
    )


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

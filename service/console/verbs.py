"""An operator's verbs as a page asks for them: the queries of `aeroloop op`, by the console's own session."""

from __future__ import annotations

from math import degrees
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Angles, Gains, Hold, Inject, Mark, Message, Request, Sinusoid, Track
from aeroloop.protocol.messages.topics import NAME
from aeroloop.protocol.transport.network import CommandSession
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.protocol.wording import problem
from aeroloop.service.console.feed import Feed
from aeroloop.service.control.motion import approached, at_rest, shortest
from aeroloop.service.control.reference import SAMPLES, Limits, Trajectory
from aeroloop.service.host.operator import send_by, stop, stop_by

POINTS = 60  # of an approach that is previewed


class PageRequest(BaseModel, frozen=True, extra="forbid"):
    """What a page sends by its socket; of the fields after `vehicle` those of its verb count."""

    verb: Literal["shown", "stop", "preview", "arm", "release", "mark", "goto", "track", "gains", "inject"]
    number: int = Field(default=0, ge=0, le=2**53, description="the answer repeats it")
    vehicle: str = Field(default="", pattern=f"^({NAME})?$", description="empty: every vehicle, of a stop")
    attitude: Angles | None = Field(default=None, description="roll, pitch, yaw [deg]")
    within_s: float | None = None
    what: Literal["configured", "sinusoid", "hold"] = "configured"
    gains: dict[str, list[float]] = {}
    fault: str = ""
    text: str = ""

    @classmethod
    def read(cls, text: str | bytes) -> PageRequest:
        """Read what a page has sent. Raises VerbError, with one line, for what no page of ours sends."""
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            raise VerbError(f"not a request of this page: {problem(error, cls)}") from None


class VerbError(AeroloopError):
    """A request that no role could be asked; one line."""


class Verbs:
    """What a page may ask for. Raises AeroloopError, or ValueError for values that are none."""

    def __init__(self, network: NetworkSettings, here: CommandSession, feed: Feed) -> None:
        self._network, self._here, self._feed = network, here, feed

    def do(self, asked: PageRequest) -> dict[str, Any]:
        """Do what is asked for; returns what a page is to show of it."""
        if asked.verb == "stop":
            return self._stop(asked.vehicle or "*")
        if asked.verb == "preview":
            return self._preview(asked.vehicle, _attitude_of(asked))
        topic, message = _request(asked)
        return {"text": send_by(self._here.anew(), self._network, asked.vehicle, topic, message)}

    def _stop(self, vehicle: str) -> dict[str, Any]:
        """What each plant answered; where one does not, all are asked again, by a new session and for longer."""
        with self._feed.lock:
            plants = [name for name, its in self._feed.vehicles.items() if "plant" in its.statuses]
        known = [name for name in plants if vehicle in ("*", name)]
        found = stop_by(self._here.anew(), self._network, vehicle, known=known)
        if found.failures:
            again = stop(self._network, None if vehicle == "*" else vehicle)
            found = again._replace(answers=list(dict.fromkeys([*found.answers, *again.answers])))
        return {"answers": found.answers, "failures": found.failures}

    def _preview(self, vehicle: str, attitude: tuple[float, float, float]) -> dict[str, Any]:
        """The shortest approach from the present desired attitude, taken to be at rest: its time [s] and its path."""
        with self._feed.lock:
            known = self._feed.vehicles.get(vehicle)
            telemetry, settings = (list(known.telemetry)[-1:], known.settings) if known else ([], None)
        if not telemetry or settings is None:
            raise VerbError(f"nothing is known of where {vehicle} is: no controller drives it")
        target, limits = Trajectory.of(Hold(attitude=attitude)), Limits.of(settings.controller, settings.wire.actuators)
        target.check(limits)
        roll, pitch, yaw = map(degrees, to_euler(telemetry[0].desired))
        here = at_rest((roll, pitch, yaw + 360 * round((attitude[2] - yaw) / 360)))
        approach = shortest(target, here, limits)
        way = approached(target, here, 0.0, approach).samples()
        at = np.linspace(0, SAMPLES - 1, POINTS).astype(int)  # from rest to rest it is one quintic
        return {
            "within_s": round(approach.within_s, 2),
            "path": {
                "t": np.linspace(0, approach.within_s, POINTS).tolist(),
                "angles": np.degrees(way.angle[at]).round(3).T.tolist(),
            },
        }


def _request(asked: PageRequest) -> tuple[str, Message]:
    """Topic and message of a verb. Raises VerbError for values that are none."""
    try:
        match asked.verb:
            case "arm":
                return "arm", Request()
            case "release":
                return "stand_down", Request()
            case "mark":
                return "mark", Mark(text=asked.text)
            case "goto":
                return "track", Track(reference=Hold(attitude=_attitude_of(asked)), within_s=asked.within_s)
            case "track":
                kinds = {"configured": None, "sinusoid": Sinusoid(), "hold": Hold()}
                return "track", Track(reference=kinds[asked.what], within_s=asked.within_s)
            case "gains":
                return "set_gains", Gains.model_validate(asked.gains)
            case "inject":
                faults = [str(Fault.parse(asked.fault))] if asked.fault else []
                return "inject", Inject(faults=faults, clear=not faults)
    except ValidationError as error:
        raise VerbError(problem(error)) from None
    raise VerbError(f"{asked.verb} asks for nothing")


def _attitude_of(asked: PageRequest) -> tuple[float, float, float]:
    if asked.attitude is None:
        raise VerbError(f"{asked.verb} needs an attitude: roll, pitch, yaw [deg]")
    return asked.attitude

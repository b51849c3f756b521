"""An operator's verbs as a page asks for them: the queries of `aeroloop op`, by the console's own session."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees
from typing import Any

import numpy as np
from pydantic import ValidationError

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Gains, Hold, Inject, Mark, Message, Request, Sinusoid, Track
from aeroloop.protocol.transport.network import CommandSession
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.attitude import to_euler
from aeroloop.protocol.wording import problem
from aeroloop.service.console.feed import Feed
from aeroloop.service.control.motion import approached, at_rest, shortest
from aeroloop.service.control.reference import SAMPLES, Limits, Trajectory
from aeroloop.service.host.operator import send_by, stop, stop_by

POINTS = 60  # of an approach that is previewed


class VerbError(AeroloopError):
    """A request that no role could be asked; one line."""


class Verbs:
    """What a page may ask for. Raises AeroloopError, or ValueError for values that are none."""

    def __init__(self, network: NetworkSettings, here: CommandSession, feed: Feed) -> None:
        self._network, self._here, self._feed = network, here, feed

    def do(self, verb: str, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Do a verb; returns what a page is to show of it."""
        vehicle = str(asked.get("vehicle") or "")
        if verb == "stop":
            return self._stop(vehicle or "*")
        if verb == "preview":
            return self._preview(vehicle, _angles(asked))
        topic, message = _request(verb, asked)
        return {"text": send_by(self._here.anew(), self._network, vehicle, topic, message)}

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


def _request(verb: str, asked: Mapping[str, Any]) -> tuple[str, Message]:
    """Topic and message of a verb; raises VerbError for what is no verb or has wrong values."""
    try:
        match verb:
            case "arm":
                return "arm", Request()
            case "release":
                return "stand_down", Request()
            case "mark":
                return "mark", Mark(text=str(asked.get("text", "")))
            case "goto":
                within = asked.get("within_s")
                return "track", Track(reference=Hold(attitude=_angles(asked)), within_s=within)
            case "track":
                kinds = {"configured": None, "sinusoid": Sinusoid(), "hold": Hold()}
                return "track", Track(reference=kinds[str(asked.get("what"))], within_s=asked.get("within_s"))
            case "gains":
                return "set_gains", Gains.model_validate(asked.get("gains"))
            case "inject":
                faults = [str(Fault.parse(str(asked["fault"])))] if asked.get("fault") else []
                return "inject", Inject(faults=faults, clear=not faults)
    except ValidationError as error:
        raise VerbError(problem(error)) from None
    except (ValueError, KeyError, TypeError) as error:
        raise VerbError(f"{verb} cannot be asked so: {error}") from None
    raise VerbError(f"no verb {verb!r}")


def _angles(asked: Mapping[str, Any]) -> tuple[float, float, float]:
    roll, pitch, yaw = (float(asked["attitude"][i]) for i in range(3))
    return roll, pitch, yaw

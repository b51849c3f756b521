"""MuJoCo as a plant: one body of an MJCF model, its attitude measured, its actuators driven by the loop's voltages.

Each period: voltages → rotor lag → `allocation` → controls of the model → steps of MuJoCo → sensors. What moves,
and how it rubs, weighs and collides, is the MJCF's; its integrator is used, in equal steps no longer than its timestep.
A simulation that diverges measures NaN, on which the plant end trips.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from math import ceil, copysign, exp, log
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, Field

from aeroloop.plant_emulator.model.emulated import RotorSettings, Sensors, SensorSettings
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.attitude import Quaternion, Vector

SHIPPED: Final = {path.stem: path for path in sorted((Path(__file__).parent / "models").glob("*.xml"))}


class MujocoSettings(BaseModel, extra="forbid"):
    """A body of an MJCF model, and what lies between it and the loop."""

    model: str = Field(
        default="aero", description="MJCF: aero or quadrotor of ours, the path of a file, or the text itself, from < on"
    )
    body: str = Field(default="body", description="the body whose attitude and angular velocity are measured")
    keyframe: str | None = Field(default=None, description="to start from; its controls are those at 0 V, else 0")
    allocation: list[list[float]] | None = Field(
        default=None,
        description="controls per volt, a row for each actuator of the model, a column for each voltage [control's "
        "unit/V]; a voltage for each actuator and 1 each if left out",
    )
    rotor: RotorSettings = Field(
        default=RotorSettings(lag_up_s=0.0, lag_down_s=0.0), description="lag and dead zone; by default neither"
    )
    sensors: SensorSettings = Field(
        default=SensorSettings(attitude="perfect", rate="perfect"), description="sensors of attitude and rate"
    )
    joints: tuple[str, str] = Field(default=("pitch", "yaw"), description="hinges that carry the encoders, if any")


class MujocoPlant(Plant):
    """A body in MuJoCo. Raises PluginError: no MuJoCo is installed, the MJCF is none, or lacks what is named."""

    Settings = MujocoSettings
    repeatable = True

    def __init__(self, settings: MujocoSettings, period: float) -> None:
        try:
            self._mujoco: Any = import_module("mujoco")  # 0.3 s and 25 MB
        except ModuleNotFoundError:
            raise PluginError("this needs MuJoCo, which is not installed: pip install 'aeroloop[mujoco]'") from None
        self._model = model = self._loaded(settings.model)
        model.opt.disableflags |= self._mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a state that is not finite is seen
        self._substeps = max(1, ceil(period / model.opt.timestep - 1e-9))
        model.opt.timestep = period / self._substeps

        self._data = data = self._mujoco.MjData(model)
        if settings.keyframe is not None:
            self._mujoco.mj_resetDataKeyframe(model, data, self._found("key", settings.keyframe).id)
        self._body = int(self._found("body", settings.body).id)
        self._at_rest = data.ctrl.copy()
        self._allocation = self._allocated(settings.allocation)
        self.actuators = self._allocation.shape[1]

        self._rotor = settings.rotor
        self._commanded = self._at_rotors = [0.0] * self.actuators
        self._sensors = Sensors(settings.sensors, period)
        joints = settings.joints if settings.sensors.of_joints else ()
        self._joints = [self._found("joint", name).qposadr[0] for name in joints]
        self._ctrl, self._qpos, self._xquat = data.ctrl, data.qpos, data.xquat[self._body]  # views
        self._velocity = np.empty(6)
        self._sense()

    def actuate(self, voltages: Sequence[float]) -> None:
        self._commanded = [float(voltage) for voltage in voltages]

    def advance(self) -> None:
        step, model, data = self._mujoco.mj_step, self._model, self._data
        half, zone = model.opt.timestep / 2, self._rotor.dead_zone_v
        for _ in range(self._substeps):
            self._lag(half)
            voltages = [copysign(max(abs(each) - zone, 0.0), each) for each in self._at_rotors]
            self._ctrl[:] = self._at_rest + self._allocation.dot(voltages)  # held: its value mid-step
            step(model, data)
            self._lag(half)
        self._sense()

    def measure(self) -> Measurement:
        return self._measurement

    def truth(self) -> State:
        return State(self._attitude, self._rate, tuple(self._commanded))

    def close(self) -> None:
        self.actuate((0.0,) * self.actuators)

    def _loaded(self, model: str) -> Any:
        load = self._mujoco.MjModel
        try:
            if model.lstrip().startswith("<"):
                return load.from_xml_string(model)
            path = SHIPPED.get(model, Path(model).expanduser())
            if not path.is_file():
                raise PluginError(f"there is no MJCF file {model}; ours are {', '.join(SHIPPED)}")
            return load.from_xml_path(str(path))
        except ValueError as error:
            said = " ".join(str(error).split())
            raise PluginError(f"MuJoCo refuses the MJCF {'given' if '<' in model else model}: {said}") from None

    def _found(self, kind: str, name: str) -> Any:
        try:
            return getattr(self._model, kind)(name)
        except KeyError as error:  # "Invalid name 'rotor'. Valid names: ['body', 'world']"
            what = "keyframe" if kind == "key" else kind
            raise PluginError(f"the MJCF has no such {what}: {error.args[0]}") from None

    def _allocated(self, allocation: list[list[float]] | None) -> Any:
        """Controls per volt. Shape (controls, voltages)."""
        controls = self._model.nu
        if not controls:
            raise PluginError("the MJCF has no actuators")
        if allocation is None:
            return np.eye(controls)
        widths = {len(row) for row in allocation}
        if len(allocation) != controls or len(widths) != 1 or 0 in widths:
            raise PluginError(f"allocation needs {controls} rows of one length: the MJCF has so many actuators")
        return np.array(allocation)

    def _lag(self, time: float) -> None:
        if not self._rotor.present:
            self._at_rotors = self._commanded
            return
        pairs = zip(self._at_rotors, self._commanded, strict=True)
        self._at_rotors = [lagged(self._rotor, voltage, command, time) for voltage, command in pairs]

    def _sense(self) -> None:
        m, model, data = self._mujoco, self._model, self._data
        m.mj_kinematics(model, data)
        m.mj_comPos(model, data)
        m.mj_comVel(model, data)
        m.mj_objectVelocity(model, data, m.mjtObj.mjOBJ_XBODY, self._body, self._velocity, 1)
        w, x, y, z = self._xquat.tolist()
        self._attitude: Quaternion = (w, x, y, z)
        a, b, c, *_ = self._velocity.tolist()
        self._rate: Vector = (a, b, c)
        self._measurement = self._sensors.read(self._attitude, self._rate, self._qpos[self._joints].tolist())


def lagged(rotor: RotorSettings, voltage: float, command: float, time: float) -> float:
    """The voltage that makes thrust, `time` [s] later under a held command [V]: `rotor_derivative`, solved exactly."""
    if (command - voltage) * voltage >= 0:
        return command + (voltage - command) * exp(-time / rotor.lag_up_s)
    after = command + (voltage - command) * exp(-time / rotor.lag_down_s)
    if after * voltage >= 0:
        return after
    to_zero = rotor.lag_down_s * log(1 - voltage / command)  # a rotor that reverses falls first, then rises
    return command - command * exp(-(time - to_zero) / rotor.lag_up_s)

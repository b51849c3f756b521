"""Settings of the plant end, and the plant and endpoint made of them: the only module that selects their parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, TypeAlias

from pydantic import BaseModel, Field, field_validator, model_validator

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.limits import LimitMonitor, LimitSettings
from aeroloop.plant_emulator.faults.injection import MAX_FAULTS, Faults
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.model.bodies import AeroSettings, Mechanism, RigidBodySettings, aero, rigid_body
from aeroloop.plant_emulator.model.emulated import (
    EmulatedPlant,
    FrictionSettings,
    RotorSettings,
    Sensors,
    SensorSettings,
    WindSettings,
    wind_torques,
)
from aeroloop.plant_emulator.plant import EMULATED, Plant, PlantError, own_plant
from aeroloop.protocol.wire.spec import WATCHDOG_S, LoopSettings, WireSpec

Sign: TypeAlias = Literal[-1, 1]
Channel: TypeAlias = Literal[-3, -2, -1, 1, 2, 3]


class QuanserSettings(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """The board, and how its channels map to the body. Verify the signs and the gyro's axes on the bench."""

    card_type: Literal["quanser_aero2_usb", "quanser_aero_usb"] = Field(
        default="quanser_aero2_usb", description="Aero 2 or Aero, by its HIL name"
    )
    card_identifier: str = Field(default="0", min_length=1, description="which board")
    rate: Literal["derivative", "gyro"] = Field(default="derivative", description="derivative: of the encoders' angles")
    bandwidth: float = Field(default=50.0, gt=0, description="ωn of the derivative's filter [rad/s]")
    encoder_signs: tuple[Sign, Sign] = Field(default=(1, 1), description="of pitch and yaw; -1 where counts run down")
    motor_signs: tuple[Sign, Sign] = Field(default=(1, 1), description="of u2 and u3")
    gyro_channels: tuple[Channel, Channel, Channel] = Field(
        default=(1, 2, 3),
        description="which of the gyro's channels 1, 2, 3 measures the body's x, y, z; negative where it is reversed",
    )
    voltage_limit: float = Field(default=18.0, gt=0, le=24, description="of a motor [V]; 18 recommended, 24 maximum")

    @field_validator("gyro_channels")
    @classmethod
    def _each_channel_once(cls, channels: tuple[int, ...]) -> tuple[int, ...]:
        if len({abs(channel) for channel in channels}) < len(channels):
            raise ValueError("must name each of 1, 2, 3 once")
        return channels


class PlantSettings(BaseModel, extra="forbid"):
    """The plant end: the plant, its disturbances, sensors and faults, the watchdog and the limits."""

    via: Literal["emulator", "can", "quanser"] = Field(
        default="emulator",
        description="the plant: emulated, a node on the CAN bus of [can], or Quanser's USB board",
    )
    kind: str = Field(
        default="aero",
        min_length=1,
        description="which plant: the emulated bodies aero and rigid_body, on which rotor, friction, wind and sensors "
        "act; mujoco or fmu; or package.module:Class of your own. Faults, limits, "
        "watchdog and voltage_limit act on any",
    )
    own: dict[str, Any] = Field(default={}, description="settings of a plant's class; aero and rigid_body have none")
    armed_at_start: bool = Field(
        default=True,
        description="grant the first claim without `op arm`, unless a process before this one left a trip or a stop",
    )
    state_directory: Path | None = Field(
        default=None,
        description="folder of the file that keeps a trip or a stop until `op arm`, whatever restarts; null: systemd's "
        "$STATE_DIRECTORY, else $XDG_STATE_HOME/aeroloop, else ~/.local/state/aeroloop",
    )
    watchdog_s: float = Field(default=WATCHDOG_S, gt=0, le=10, description="0 V after so long without a command [s]")
    truth_rate_hz: float = Field(default=10.0, ge=0, le=10_000, description="publish the true state this often [Hz]")
    voltage_limit: float = Field(default=24.0, gt=0, description="largest voltage of the supply [V]")
    faults: list[str] = Field(
        default=[],
        max_length=MAX_FAULTS,
        description="faults: signal:kind[=value][@start[..end]], in s since the first claim was granted",
    )
    fault_seed: int = Field(default=0, ge=0, description="of the faults' random numbers")
    steps_on_request: bool = Field(default=False, description="lockstep for tests: step on an `advance` query only")
    limits: LimitSettings = Field(default=LimitSettings(), description="beyond any of these the plant trips")
    aero: AeroSettings = Field(default=AeroSettings(), description="body of the Aero, for kind = 'aero'")
    rigid_body: RigidBodySettings = Field(default=RigidBodySettings(), description="free body, for kind = 'rigid_body'")
    quanser: QuanserSettings = Field(default=QuanserSettings(), description="Quanser's board, for via = 'quanser'")
    rotor: RotorSettings = Field(default=RotorSettings(), description="lag and dead zone")
    friction: FrictionSettings = Field(default=FrictionSettings(), description="about the joints, or x, y, z")
    wind: WindSettings = Field(default=WindSettings(), description="wind on the plant")
    sensors: SensorSettings = Field(default=SensorSettings(), description="sensors of attitude and angular velocity")

    @field_validator("faults")
    @classmethod
    def _faults_are_faults(cls, faults: list[str]) -> list[str]:
        return [str(Fault.parse(text)) for text in faults]

    @property
    def parsed_faults(self) -> list[Fault]:
        """The configured faults."""
        return [Fault.parse(text) for text in self.faults]

    @model_validator(mode="after")
    def _parts_belong_to_the_kind(self) -> PlantSettings:
        of_emulated = ("aero", "rigid_body", "rotor", "friction", "wind", "sensors")
        for name in ("own",) if self.emulated else of_emulated:
            if getattr(self, name) != type(self).model_fields[name].default:
                where = "a plant of another kind" if self.emulated else f"the kinds {' and '.join(EMULATED)}"
                raise ValueError(f"plant.{name} is for {where}, and plant.kind is {self.kind!r}: leave it out")
        return self

    @model_validator(mode="after")
    def _sensors_fit_the_body(self) -> PlantSettings:
        if self.kind == "rigid_body" and self.sensors.of_joints:
            raise ValueError(
                "a free body has no joints for encoders: set sensors.attitude to 'perfect' and sensors.rate to 'gyro' "
                "or 'perfect'"
            )
        return self

    @property
    def emulated(self) -> bool:
        """Whether the plant is one of our bodies, and so known by its equations."""
        return self.kind in EMULATED

    @property
    def actuators(self) -> int | None:
        """Number of motors of an emulated body; None for any other plant, whose class states it."""
        return {"aero": 2, "rigid_body": 3}.get(self.kind)

    def mechanism(self) -> Mechanism:
        """The emulated body. Raises PlantError for any other plant."""
        if not self.emulated:
            known = " or ".join(map(repr, EMULATED))
            raise PlantError(f"this needs a plant whose equations are known, plant.kind = {known}, not {self.kind!r}")
        return rigid_body(self.rigid_body) if self.kind == "rigid_body" else aero(self.aero)

    def make(self, period: float) -> Plant:
        """Make the plant of this kind; `advance` lets one `period` pass [s]. Raises PluginError, PlantError."""
        return self.build(period) if self.emulated else own_plant(self.kind, self.own, period, self.voltage_limit)

    def build(self, period: float) -> EmulatedPlant:
        """As `make`, of an emulated body; raises PlantError for any other kind."""
        mechanism, limit = self.mechanism(), self.voltage_limit
        wind, sensors = wind_torques(self.wind, mechanism.axes, period), Sensors(self.sensors, period)
        return EmulatedPlant(mechanism, self.rotor, self.friction, wind, sensors, period, limit)

    def continued(self, plant: Plant, before: PlantSettings, period: float) -> EmulatedPlant:
        """An emulated body with these settings in the state of `plant`, which is of the settings `before`.

        Raises ValueError if anything else is another than before, or the states do not fit each other.
        """
        names = type(self).model_fields.keys() - {"aero", "rigid_body", "rotor", "friction", "wind", "sensors"}
        if other := [name for name in sorted(names) if getattr(self, name) != getattr(before, name)]:
            raise ValueError(f"plant.{other[0]} holds from a session's start")
        if not isinstance(plant, EmulatedPlant):
            raise ValueError(f"plant.kind = {self.kind!r} cannot be changed while it runs: its state is its own")
        built = self.build(period)
        built.take_over(plant, wind=self.wind == before.wind, sensors=self.sensors == before.sensors)
        return built

    def endpoint(self, plant: Plant, loop: LoopSettings, wire: WireSpec) -> Endpoint:
        """Make the endpoint of a plant, with the configured faults, limits and watchdog.

        Raises ValueError if a fault is of a motor that the plant does not have, or the wire commands another number of
        motors. The plant is closed then: it may be a machine.
        """
        faults = Faults(plant.actuators, loop.period, voltage_limit=self.voltage_limit, seed=self.fault_seed)
        full = min(self.voltage_limit, wire.voltage.quantizer().outermost)
        if self.via == "quanser":
            full = min(full, self.quanser.voltage_limit)  # the board clips there
        try:
            faults.inject(self.parsed_faults, "configured")
            return Endpoint(
                plant,
                wire,
                loop.period_ns,
                lockstep=loop.lockstep,
                watchdog_s=self.watchdog_s,
                limits=LimitMonitor(self.limits, loop.period_ns, full),
                armed=self.armed_at_start,
                faults=faults,
            )
        except ValueError:
            plant.close()
            raise

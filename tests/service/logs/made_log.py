"""A log made without a network: a closed loop in lockstep, its messages written as the recorder writes them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from plant_emulator.emulator import truth_of
from plant_emulator.endpoint import Endpoint
from protocol import topics
from protocol.messages import Claim, Contract
from protocol.verbs import Change, Gains, Hold, Reference
from service.config import Settings, load
from service.controller import Controller
from service.logs.mcap_file import CHANGE_METADATA, CONTRACT_METADATA
from service.recording.intake import Taken
from service.recording.log_file import LogFile
from service.reference import Plan
from service.telling import telemetry_of

START_NS = 1_800_000_000_000_000_000
VEHICLE, SESSION = "aero", "s1"


def lockstep() -> Settings:
    return load(overrides=["loop.lockstep=true"])


def make_log(
    path: Path,
    ticks: int,
    *,
    settings: Settings | None = None,
    begin: int = 0,
    changes: dict[int, tuple[Gains | None, Reference | None]] | None = None,
    spoil: int | None = None,
    chunk_every: int = 100,
    truth_every: int = 0,
) -> None:
    """Write a log.

    Args:
        path: Where.
        ticks: How many ticks the loop runs.
        settings: Its configuration.
        begin: The tick at which the recorder comes.
        changes: Gains and reference that an operator sets, by tick.
        spoil: The tick whose command is not logged as it was sent.
        chunk_every: Close a chunk after so many ticks.
        truth_every: Tell the true state every so many ticks; 0 is never.
    """
    settings = settings or lockstep()
    wire, loop, changes = settings.wire, settings.loop, changes or {}
    plant = settings.plant.build(loop.period)
    endpoint = Endpoint(plant, wire, loop.period_ns, lockstep=True)
    endpoint.claim(
        Claim(controller="c", session=SESSION, period_ns=loop.period_ns, lockstep=True, auto_arm=True, wire=wire)
    )
    controller = Controller(wire, settings.law, settings.reference, loop.period)
    path.unlink(missing_ok=True)
    log = LogFile(path)
    sequences: Counter[str] = Counter()

    def write(name: str, payload: bytes, at_ns: int) -> None:
        key = topics.key(name, VEHICLE, session=SESSION, role="controller")
        sequences[key] += 1
        log.add(Taken(key, payload, at_ns, at_ns), sequences[key])

    contract = Contract(role="controller", vehicle=VEHICLE, host="h", versions={}, config=settings.contract())
    key = topics.key("contract", VEHICLE, role="controller")
    log.add_metadata(CONTRACT_METADATA, {"key": key, "json": contract.model_dump_json()})
    first = Change(session=SESSION, tick=0, gains=controller.gains, reference=settings.reference)
    if begin:  # as in a file that another one has gone before
        key = topics.key("change", VEHICLE)
        log.add_metadata(CHANGE_METADATA, {"key": key, "json": first.model_dump_json()})
    else:
        write("change", first.encode(), START_NS - 1)
    measurement = endpoint.tick(None, 0)
    for k in range(ticks):
        assert measurement is not None
        at = START_NS + k * loop.period_ns
        if k in changes:
            gains, reference = changes[k]
            change = Change(session=SESSION, tick=k, gains=gains, reference=reference, within_s=1.0)
            if gains is not None:
                controller.set_gains(gains)
            if reference is not None:
                controller.motion.follow(Plan.of(reference), k * loop.period, 1.0)
            write("change", change.encode(), at)
        command = controller.tick(measurement, k)
        assert command is not None
        if k >= begin:
            write("measurement", measurement, at)
            if truth_every and k % truth_every == 0:
                write("truth", truth_of(plant, endpoint).encode(), at + 1)
            logged = bytes([command[0], command[1] ^ 0x01]) if k == spoil else command
            write("command", logged, at + 300_000)
            if k % 10 == 0:
                write("telemetry", telemetry_of(controller, SESSION).encode(), at + 300_001)
        measurement = endpoint.tick(command, k + 1)
        if k % chunk_every == chunk_every - 1:
            log.commit()
    log.end()


AN_OPERATORS_WORDS: dict[int, tuple[Gains | None, Reference | None]] = {
    120: (Gains(C2=(0.2, 0.2, 0.2)), None),
    250: (None, Hold(attitude=(0.0, 5.0, -10.0))),
    400: (Gains(Gamma=(0.01, 0.01, 0.01)), load().reference),
}

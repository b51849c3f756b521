"""A log of a loop that sends only what is new says of every tick what the controller used and commanded."""

from __future__ import annotations

import pytest

from protocol.messages import Lapse, Telemetry
from protocol.transmit import Policy
from protocol.wire import WireSpec
from service.logs.filling import Read
from service.logs.pairing import Pairing
from tests.service.logs.silent_loop import LOOP, Codes, Logged, run, wire_of

POLICIES: list[tuple[Policy, Policy]] = [
    ("on_change", "on_change"),
    ("on_change", "periodic"),
    ("periodic", "on_change"),
    ("periodic", "periodic"),
]


class Paired(Pairing):
    """What a log says of each tick that was computed."""

    def __init__(self, wire: WireSpec, lapses: list[Lapse]) -> None:
        super().__init__(wire, LOOP, lapses)
        self.found: dict[int, tuple[Codes, Codes]] = {}
        self.frames: list[tuple[bytes, int | None]] = []

    def answered(self, k: int, measurement: Read, command: Read) -> None:
        measured, commanded = self._wire.measurement.unpack(measurement.frame), self._wire.command.unpack(command.frame)
        assert measured is not None
        assert commanded is not None
        self.found[k] = measured[1], commanded[1]  # type: ignore[assignment]  # codes of a quantized wire are whole

    def passed_over(self, k: int, measurement: Read) -> None:
        pass

    def measured(self, frame: bytes, published_ns: int) -> None:
        self.frames.append((frame, published_ns))

    def commanded(self, frame: bytes) -> None:
        self.frames.append((frame, None))


def read(wire: WireSpec, logged: Logged) -> Paired:
    paired = Paired(wire, logged.lapses)
    for topic, payload, at_ns in logged.messages:
        if topic == "telemetry":
            paired.telemetry(Telemetry.model_validate_json(payload), at_ns)
        else:
            getattr(paired, topic)(payload, at_ns)
    paired.finish()
    return paired


@pytest.mark.parametrize(("measurement", "command"), POLICIES)
@pytest.mark.parametrize(("seed", "own_grid"), [*((i, False) for i in range(50)), *((i, True) for i in range(50, 70))])
def test_a_log_says_what_was_used_and_commanded_at_every_tick(
    seed: int, own_grid: bool, measurement: Policy, command: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = wire_of(measurement, command)
    logged = run(seed, wire, monkeypatch, own_grid=own_grid)
    paired = read(wire, logged)
    known = max(paired.found)
    assert known >= logged.last - 15  # silence at the very end is not told from the end
    expected = {k: (logged.used[k], logged.commanded[k]) for k in logged.used if k <= known}
    assert paired.found == expected
    # What is filled in is no frame that was sent, and what is malformed is counted.
    sent = [(payload, at_ns) for topic, payload, at_ns in logged.messages if topic == "measurement"]
    whole = [frame for frame in sent if wire.measurement.counter(frame[0]) is not None]
    assert [frame for frame in paired.frames if frame[1] is not None] == whole
    assert paired.malformed == len(sent) - len(whole)
    assert len(paired.frames) + paired.malformed == sum(topic != "telemetry" for topic, _, _ in logged.messages)

"""What `op show` prints sets, pasted into a shell, what was shown."""

from __future__ import annotations

import shlex
from io import StringIO
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.models import SessionRecord
from aeroloop.protocol.messages.operator import Gains, Hold, Message, Points, Reference, Sinusoid, Stream, Track
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.cli.main import execute
from aeroloop.service.cli.op import as_commands
from aeroloop.service.host import operator

angle = st.floats(-1e4, 1e4)
angles = st.tuples(angle, angle, angle)
gain = st.tuples(*[st.floats(1e-6, 20)] * 3)
frequency = st.floats(0, 100)
points = st.lists(st.tuples(st.integers(1, 10**6), angles), min_size=1, max_size=4).map(
    lambda rows: Points(
        times=[0.0, *(sum(ms for ms, _ in rows[: i + 1]) / 1000 for i in range(len(rows)))],
        attitudes=[(0.0, 0.0, 0.0), *(attitude for _, attitude in rows)],
    )
)
references: st.SearchStrategy[Reference] = st.one_of(
    st.builds(Hold, attitude=angles | st.none()),
    st.builds(Sinusoid, amplitude=angles, frequency=st.tuples(frequency, frequency, frequency)),
    st.builds(Stream, timeout_s=st.floats(1e-3, 60)),
    points,
)
records = st.builds(
    SessionRecord,
    controller=st.just("controller-7"),
    session=st.just("s") | st.none(),
    gains=st.builds(Gains, C1=gain, C2=gain, Gamma=gain),
    gains_from=st.just("operator"),
    reference=references,
    reference_from=st.just("operator"),
    within_s=st.just(0.0) | st.floats(0.02, 600),
    since_tick=st.just(0),
    ended=st.none() | st.sampled_from(TripCause),
    ended_tick=st.none(),
)


@settings(max_examples=20)
@given(record=records)
def test_the_commands_printed_send_what_was_read(record: SessionRecord) -> None:
    sent: list[tuple[NetworkSettings, str, Message]] = []

    def keep(network: NetworkSettings, vehicle: str, topic: str, message: Message) -> str:
        sent.append((network, f"{vehicle} {topic}", message))
        return "done"

    options = ["--set", "vehicle=aero-2", "--set", "network.rendezvous=tcp/127.0.0.1:7555"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(operator, "send", keep)
        for text in as_commands(record, options):
            line, _, table = text.partition("\n")
            words = shlex.split(line, comments=True)
            if words[-1] == "<<END":
                assert table.endswith("\nEND")
                patch.setattr(Path, "open", lambda *_, table=table, **__: StringIO(table.removesuffix("END")))
                words.pop()
            assert words[:2] == ["aeroloop", "op"]
            assert execute(words[1:]) == 0
    track = Track(reference=record.reference, within_s=record.within_s or None)
    assert [(what, message) for _, what, message in sent] == [
        ("aero-2 set_gains", record.gains),
        ("aero-2 track", track),
    ]
    assert [network.rendezvous for network, _, _ in sent] == [["tcp/127.0.0.1:7555"]] * 2


def test_the_commands_say_where_the_values_come_from_and_how_the_session_ended() -> None:
    gains = Gains(C1=(0.5, 0.5, 0.5), C2=(0.4, 0.4, 0.4), Gamma=(0.1, 0.1, 0.1))
    record = SessionRecord(
        controller="c", session="5f0c", gains=gains, gains_from="configured",
        reference=Hold(attitude=(0.0, -10.0, 90.0)), reference_from="operator", within_s=5.0, since_tick=0,
        ended=TripCause.HOLDER_GONE, ended_tick=7,
    )  # fmt: skip
    assert as_commands(record) == [
        "aeroloop op set-gains --C1 0.5 0.5 0.5 --C2 0.4 0.4 0.4 --Gamma 0.1 0.1 0.1  "
        "# configured; session 5f0c ended: controller gone",
        "aeroloop op goto 0 -10 90 --in 5  # operator",
    ]

"""SPEC.md against the code: golden vectors are parsed from the text and tried on the code."""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from itertools import takewhile
from math import isnan, nan
from pathlib import Path
from typing import Final

import pytest

from aeroloop import protocol
from aeroloop.protocol.messages.models import PROTOCOL_VERSION
from aeroloop.protocol.messages.states import CONTROLLER_TABLE, PLANT_TABLE, TripCause
from aeroloop.protocol.messages.topics import TOPICS, Topic
from aeroloop.protocol.transport.history import attachment, page, query
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import UniformQuantizer
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.protocol.wire.transmit import Sender, Transmit
from tests.protocol.spec_messages import section
from tests.support.wires import wire_of

SPEC: Final = (Path(protocol.__file__).parent / "SPEC.md").read_text(encoding="utf-8")

QUANTIZER: Final = "| bits | limit | dead zone | value | code | level |"
KINDS: Final = "| kind | bits | limit | dead zone | parameter | values | codes | levels |"
FRAMES: Final = "| frame | counter bits | bits of ε, ω / u | actuators | counter | codes | hex |"
SENT: Final = "| heartbeat_s | period in ms | counter bits | codes | ticks that send | their counters |"
PUBLISHED: Final = "| what | wanted | hex |"
REFUSED: Final = "| frame | counter bits | bits of ε, ω / u | actuators | hex | why |"

Row = tuple[str, ...]


def cells(line: str) -> Row:
    """The cells of a row, without spaces and backticks around them."""
    return tuple(cell.strip().strip("`").strip() for cell in line.strip().strip("|").split("|"))


def rows(header: str) -> list[Row]:
    """Rows of every table whose header begins so."""
    lines, found = SPEC.splitlines(), list[Row]()
    for start in (i for i, line in enumerate(lines) if line.startswith(header)):
        found += [cells(line) for line in takewhile(lambda line: line.startswith("|"), lines[start + 2 :])]
    return found


QUANTIZER_ROWS: Final = rows(QUANTIZER)
KIND_ROWS: Final = rows(KINDS)
FRAME_ROWS: Final = rows(FRAMES)
REFUSED_ROWS: Final = rows(REFUSED)
SENT_ROWS: Final = rows(SENT)
PUBLISHED_ROWS: Final = rows(PUBLISHED)


def number(text: str) -> int:
    """The integer that a code cell starts with; `-128` may be followed by a word."""
    found = re.fullmatch(r"([-−]?\d+)`?( invalid)?", text)
    assert found, f"{text!r} is not a code"
    return int(found[1].replace("−", "-"))


def form(frame: str, counter_bits: str, bits: str, actuators: str) -> FrameFormat:
    """The format that the first cells of a row describe."""
    widths = [None if cell.strip() == "cont" else int(cell) for cell in bits.split(",")]
    if frame == "measurement":
        return wire_of(widths[0], widths[1], 6, counter_bits=int(counter_bits)).measurement
    assert frame == "command", f"{frame!r} is neither a measurement nor a command"
    return wire_of(8, 8, widths[0], int(actuators), int(counter_bits)).command


def test_the_golden_vectors_are_there() -> None:
    found = QUANTIZER_ROWS, KIND_ROWS, FRAME_ROWS, REFUSED_ROWS, SENT_ROWS, PUBLISHED_ROWS
    assert [len(set(rows)) >= least for rows, least in zip(found, (6, 14, 14, 4, 8, 5), strict=True)] == [True] * 6


@pytest.mark.parametrize("row", QUANTIZER_ROWS, ids=" ".join)
def test_the_quantizer_gives_its_golden_vectors(row: Row) -> None:
    bits, limit, deadzone, value, code, level = row
    quantizer = UniformQuantizer(int(bits), float(limit), None if deadzone == "l/2" else float(deadzone))
    if isnan(float(value)):
        assert number(code) == quantizer.invalid
        assert isnan(float(level))
        assert isnan(quantizer.level(number(code)))
        return
    assert quantizer.encode(float(value)) == number(code)
    # The text gives at least twelve significant digits; zero is exact.
    assert quantizer.level(number(code)) == pytest.approx(float(level), rel=1e-12, abs=0)


@pytest.mark.parametrize("row", KIND_ROWS, ids=" ".join)
def test_the_other_kinds_give_their_golden_vectors(row: Row) -> None:
    kind, bits, limit, deadzone, parameter, values, codes, levels = row
    name = {"hysteresis-uniform": "hysteresis", "logarithmic-uniform": "threshold"}[kind]
    given = {key: float(text) for key, text in (("deadzone", deadzone), (name, parameter)) if text != "–"}
    quantizer = SignalSpec.model_validate({"kind": kind, "bits": int(bits), "limit": float(limit), **given}).quantizer()
    for value, code, level in zip(values.split(), codes.split(), levels.split(), strict=True):
        if isnan(float(value)):
            assert number(code) == quantizer.invalid
            quantizer.resume(quantizer.invalid)
            assert isnan(quantizer.level(number(code)))
            continue
        assert quantizer.encode(float(value)) == number(code)
        assert quantizer.level(number(code)) == pytest.approx(float(level), rel=1e-12, abs=0)


@pytest.mark.parametrize("row", FRAME_ROWS, ids=" ".join)
def test_frames_are_their_golden_vectors(row: Row) -> None:
    frame, counter_bits, bits, actuators, counter, codes, text = row
    layout = form(frame, counter_bits, bits, actuators)
    expected = [
        float(code) if width is None else int(code) for width, code in zip(layout.widths, codes.split(), strict=True)
    ]
    assert text == text.lower()
    assert layout.pack(int(counter), expected).hex() == text.replace(" ", "")
    arrived = layout.unpack(bytes.fromhex(text))
    assert arrived is not None
    assert arrived[0] == int(counter)
    assert [repr(code) for code in arrived[1]] == [repr(code) for code in expected]  # repr: NaN equals itself
    assert layout.counter(bytes.fromhex(text)) == int(counter)


@pytest.mark.parametrize("row", REFUSED_ROWS, ids=" ".join)
def test_golden_vectors_that_must_be_refused_are_refused(row: Row) -> None:
    frame, counter_bits, bits, actuators, text, why = row
    assert why
    assert form(frame, counter_bits, bits, actuators).unpack(bytes.fromhex(text)) is None


@pytest.mark.parametrize("row", SENT_ROWS, ids=" ".join)
def test_frames_are_sent_as_their_golden_vectors_say(row: Row) -> None:
    heartbeat_s, period_ms, counter_bits, codes, ticks, counted = row
    counters = 2 ** int(counter_bits)
    heartbeat = Transmit(heartbeat_s=float(heartbeat_s)).heartbeat_ticks(int(period_ms) * 1_000_000, counters)
    sender, invalid = Sender("on_change", heartbeat, counters), [nan]  # an end has one list that says no valid value
    computed = [(k, invalid if code == "NaN" else [float(code)]) for k, code in enumerate(codes.split()) if code != "."]
    sent = [k for k, code in computed if sender.due(k, code)]
    assert sent == [int(tick) for tick in ticks.split()]
    assert [k % counters for k in sent] == [int(counter) for counter in counted.split()]


@pytest.mark.parametrize("row", PUBLISHED_ROWS, ids=lambda row: " ".join(row[:2]))
def test_queries_pages_and_attachments_are_their_golden_vectors(row: Row) -> None:
    what, wanted, data = row[0], row[1], bytes.fromhex(row[2])
    publisher, clock_ns = 0x0123456789ABCDEF, 1_800_000_000_000_000_000
    kept = [(number, clock_ns + number, payload) for number, payload in ((1, b"two"), (2, b""), (3, b"four"))]
    if what == "attachment":
        assert attachment(clock_ns + int(wanted), publisher, int(wanted)) == data
        return
    ranges = [tuple(map(int, each.split("–"))) for each in wanted.split(", ")]
    asked = query([(publisher, (first, end)) for first, end in ranges])
    assert (asked if what == "query" else page(asked, publisher, kept)) == data


def longest(topic: Topic) -> int:
    """Most bytes of a request or its answer, or of what is published."""
    return max(topic.request, topic.limit) if topic.kind == "query" else topic.limit


def size(count: int) -> str:
    for unit, factor in (("MiB", 1 << 20), ("KiB", 1 << 10)):
        if count % factor == 0:
            return f"{count // factor} {unit}"
    return f"{count} B"


def roles(cell: str) -> set[str]:
    """Roles that a cell names; `readers` are three of them."""
    return set(cell.replace("readers", "operator, observer, recorder").split(", "))


def test_the_table_of_topics_is_that_of_the_code() -> None:
    table = {row[0]: (row[1], roles(row[3]), roles(row[4]), row[6]) for row in rows("| topic | ")}
    assert table == {
        one.name: (one.key, {*one.senders}, {*one.receivers}, "–" if one.kind == "token" else size(longest(one)))
        for one in TOPICS.values()
    }


@pytest.mark.parametrize(("end", "table"), [("plant", PLANT_TABLE), ("controller", CONTROLLER_TABLE)])
def test_the_tables_of_states_are_those_of_the_code(end: str, table: Mapping[tuple[StrEnum, StrEnum], StrEnum]) -> None:
    documented = rows(f"| {end} is | what happens | {end} is then |")
    assert documented == [(str(a), str(b), str(c)) for (a, b), c in table.items()]


def test_version_causes_of_a_trip_and_every_message_are_those_of_the_code() -> None:
    """`python -m tests.protocol.spec_messages` writes the section of the messages anew."""
    assert re.search(rf"^# .*version {PROTOCOL_VERSION}$", SPEC, re.MULTILINE)
    documented = " ".join(SPEC.split()).split("Causes: ")[1].split(". >")[0]
    assert documented == ", ".join(f"{number} {cause}" for number, cause in enumerate(TripCause, start=1))
    assert section() in SPEC

"""Broken log files: whole records are read and copied, damage is named, and forged sizes cost no memory."""

from __future__ import annotations

import random
import struct
import tracemalloc
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message
from mcap.writer import MCAP0_MAGIC as MAGIC

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.logs.copies import ExportError, copy
from aeroloop.service.logs.mcap_file import MAX_CHUNK, records
from aeroloop.service.logs.outputs import OutputError
from aeroloop.service.logs.recording import Recording, ReviewError
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import read as read_run
from aeroloop.service.review.review import review
from tests.support.edited_log import END, FOOTER, HEAD, Read, by_mcap, chunks, parts
from tests.support.made_log import AN_OPERATORS_WORDS, make_log

TICKS: Final = 600


def read(path: Path, damages: list[str]) -> list[Read]:
    """Every message."""
    found = list(records(path, damages))
    topics = {one.id: one.topic for one in found if isinstance(one, Channel)}
    messages = (one for one in found if isinstance(one, Message))
    return [Read(topics[m.channel_id], m.sequence, m.log_time, m.publish_time, m.data) for m in messages]


def after(messages: list[Read]) -> str:
    """Up to when these messages are, in words."""
    last_ns = max(one.log_time for one in messages)
    return f"after {datetime.fromtimestamp(last_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    make_log(path, TICKS, changes=AN_OPERATORS_WORDS, chunk_every=5)
    return path


@pytest.fixture(scope="module")
def everything(whole: Path) -> list[Read]:
    return by_mcap(whole)


def test_a_whole_file_gives_what_mcaps_own_reader_has_and_is_copied_whole(
    whole: Path, everything: list[Read], tmp_path: Path
) -> None:
    damages: list[str] = []
    assert read(whole, damages) == everything
    assert damages == []
    assert copy([whole], tmp_path / "out.mcap").damages == []
    assert by_mcap(tmp_path / "out.mcap") == everything
    assert Recording([tmp_path / "out.mcap"]).descriptions == Recording([whole]).descriptions


def test_a_file_cut_anywhere_gives_every_whole_chunk_before_the_cut_and_says_up_to_when(
    whole: Path, everything: list[Read], tmp_path: Path
) -> None:
    """And so does a copy of it, by an index."""
    data, cut, out, rng = whole.read_bytes(), tmp_path / "cut.mcap", tmp_path / "out.mcap", random.Random(11)
    ends = [chunk.end for chunk in chunks(data)]
    data_end = next(part.end for part in parts(data[: -len(MAGIC)], len(MAGIC)) if part.opcode == Opcode.DATA_END)
    of_chunk = len(everything) / len(ends)
    edges = (place + d for place in (*ends, data_end) for d in (-1, 0, 1))
    for size in {*(rng.randrange(8, len(data)) for _ in range(60)), *edges}:
        cut.write_bytes(data[:size])
        damages: list[str] = []
        got = read(cut, damages)
        assert got == everything[: len(got)]
        assert len(got) > (sum(place <= size for place in ends) - 0.1) * of_chunk * 0.9
        assert len(damages) == (size < data_end)
        if damages and got:
            assert after(got) in damages[0]
        if got:
            assert copy([cut], out).damages == [f"{cut}: {damage}" for damage in damages]
            assert by_mcap(out) == got
            out.unlink()
        else:
            with pytest.raises(ExportError, match="no whole message"):
                copy([cut], out)
            assert not out.exists()


def test_a_flipped_bit_anywhere_costs_one_chunk_at_most_and_nothing_unnamed(
    whole: Path, everything: list[Read], tmp_path: Path
) -> None:
    """Also in the head of a record: the index of a closed file says where the next one begins. In it, nothing."""
    data, flipped, rng = whole.read_bytes(), tmp_path / "flipped.mcap", random.Random(13)
    log = parts(data[: -len(MAGIC)], len(MAGIC))
    index, _, _ = FOOTER.unpack_from(data, len(data) - END + HEAD.size)
    in_index = rng.sample(range(index * 8, (len(data) - len(MAGIC)) * 8), 30)
    in_heads = [part.offset * 8 + rng.randrange(HEAD.size * 8) for part in log for _ in range(2)]
    of_chunk = len(everything) / len(chunks(data))
    for bit in (*in_heads, *in_index, *(rng.randrange(len(MAGIC) * 8, len(data) * 8) for _ in range(60))):
        bent = bytearray(data)
        bent[bit // 8] ^= 1 << bit % 8
        flipped.write_bytes(bent)
        damages: list[str] = []
        got = read(flipped, damages)
        lost = len(everything) - len(got)
        assert lost < 1.5 * of_chunk, f"bit {bit}"
        assert damages or not lost, f"bit {bit} is not named"
        assert len(damages) == len(set(damages)), f"bit {bit}"
        assert bit not in in_index or (lost, damages) == (0, []), f"bit {bit}"
        start = next((i for i, one in enumerate(got) if one != everything[i]), len(got))
        assert got == everything[:start] + everything[start + lost :]  # the rest, in one piece on either side


def test_a_log_of_a_killed_recorder_is_read_up_to_the_damage(
    whole: Path, everything: list[Read], tmp_path: Path
) -> None:
    data = bytearray(whole.read_bytes()[:-END])
    damaged = chunks(whole.read_bytes())[5]
    data[(damaged.offset + damaged.end) // 2] ^= 0x10
    killed, damages = tmp_path / "killed.mcap", list[str]()
    killed.write_bytes(data)
    got = read(killed, damages)
    assert got == everything[: len(got)] != []
    (damage,) = damages
    assert f"(byte {damaged.offset}, {after(got)})" in damage
    assert copy([killed], tmp_path / "out.mcap").damages == [f"{killed}: {damage}"]


def test_no_cut_or_flipped_file_gives_a_traceback_or_another_figure_without_a_word(tmp_path: Path) -> None:
    """Cut, or with up to three bits flipped, some without their index; a quarter in a description."""
    log, broken, rng = tmp_path / "a.mcap", tmp_path / "b.mcap", random.Random(20261201)
    make_log(log, 200, changes={120: AN_OPERATORS_WORDS[120]}, chunk_every=4, truth_every=20)
    data, clean, same = log.read_bytes(), read_run(log), replay([log])
    descriptions = [i for i in range(len(data)) if data.startswith(b'{"protocol":2', i)]
    assert len(descriptions) == 2  # uncompressed, of two roles
    refused: list[str] = []
    for i in range(48):
        described = i % 4 == 0
        bent = bytearray(data if described or rng.random() < 0.6 else data[: rng.randrange(len(data))])
        if described:  # its JSON, its name or its length
            bent[rng.choice(descriptions) + rng.randrange(-100, 1500)] ^= 1 << rng.randrange(8)
        for _ in range(0 if described or not bent else rng.randrange(4)):
            bent[rng.randrange(len(bent))] ^= 1 << rng.randrange(8)
        broken.write_bytes(bent)
        try:
            found, again = read_run(broken), replay([broken])
        except AeroloopError as error:
            refused.append(str(error))
            assert not described
            continue
        assert not again.differs
        unlike = {"damages", "log"}
        if found.figures.model_dump(exclude=unlike) != clean.figures.model_dump(exclude=unlike):
            assert found.findings.damages or found.findings.missing or found.findings.unknown
            assert not described
        if again.controller != same.controller or again.plant != same.plant:
            assert not again.complete or again.reasons
    assert len(refused) < 18
    assert all(len(line.splitlines()) == 1 for line in refused)


def test_what_is_no_log_or_stands_in_the_way_is_reported_in_one_line(whole: Path, tmp_path: Path) -> None:
    for content in (b"", b"something else", MAGIC):
        (tmp_path / "a.mcap").write_bytes(content)
        for verb in (review, lambda path: copy([path], tmp_path / "out")):
            with pytest.raises((ReviewError, ExportError)) as refused:
                verb(tmp_path / "a.mcap")
            assert len(str(refused.value).splitlines()) == 1
            assert not (tmp_path / "out").exists()
    (tmp_path / "empty").mkdir()
    with pytest.raises(ReviewError, match=r"no \.mcap file"):
        Recording([tmp_path / "empty"])
    with pytest.raises(ReviewError, match="No such file"):
        copy([tmp_path / "none.mcap"], tmp_path / "out")
    with pytest.raises(OutputError, match="is an input"):
        copy([whole], whole)


# What a file claims


def chunk_of(data: bytes, size: int, compression: str = "zstd") -> bytes:
    builder = RecordBuilder()
    Chunk(compression, data, 0, 0, 0, size).write(builder)
    return bytes(builder.end())


def _unsized(data: bytes) -> bytes:
    return zstandard.ZstdCompressor(write_content_size=False).compress(data)


BOMB: Final = bytes(2 * MAX_CHUNK)
LIES: Final[dict[str, Callable[[], bytes]]] = {
    "a record of 2^62 bytes": lambda: HEAD.pack(Opcode.METADATA, 1 << 62),
    "a record that is longer than the file": lambda: HEAD.pack(Opcode.CHUNK, MAX_CHUNK) + bytes(100),
    "a chunk with 2^63 bytes of data": lambda: chunk_of(b"", 0)[:-8] + struct.pack("<Q", 1 << 63),
    "a chunk that claims too much": lambda: chunk_of(_unsized(bytes(100)), MAX_CHUNK + 1),
    "a frame that claims more than its chunk": lambda: chunk_of(zstandard.compress(BOMB), 1000),
    "a bomb of zstd": lambda: chunk_of(_unsized(BOMB), 1000),
    "an unknown compression": lambda: chunk_of(bytes(100), 100, "rar"),
    "a message in a chunk that is too short": lambda: chunk_of(HEAD.pack(Opcode.MESSAGE, 2) + bytes(2), 11, ""),
}


@pytest.mark.parametrize("lie", LIES)
def test_what_a_file_claims_costs_no_memory_and_is_damage(tmp_path: Path, whole: Path, lie: str) -> None:
    path, damages = tmp_path / "lie.mcap", list[str]()
    first = chunks(whole.read_bytes())[0].offset
    block = LIES[lie]()
    path.write_bytes(whole.read_bytes()[:first] + block)
    tracemalloc.start()
    assert read(path, damages) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert f"(byte {first}" in damages[0]
    assert peak < 10 * len(block) + MAX_CHUNK + 1_000_000

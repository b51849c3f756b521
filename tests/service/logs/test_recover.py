"""Recovery of a broken log: whole records kept, losses reported, output valid for an independent reader."""

from __future__ import annotations

import errno
import os
import random
import resource
from pathlib import Path
from typing import NamedTuple

import pytest
from mcap.reader import make_reader

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.logs.mcap_file import DESCRIPTION_METADATA
from aeroloop.service.logs.outputs import OutputError
from aeroloop.service.logs.recover import RecoverError, recover
from aeroloop.service.recording.log_file import LogFile
from aeroloop.service.review.review import review
from tests.support.made_log import START_NS, VEHICLE, description, lockstep, made, make_log

TICKS = 400


class Read(NamedTuple):
    """A message as the mcap package's reader, by the index, has it."""

    topic: str
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


def read(path: Path) -> list[Read]:
    with path.open("rb") as file:
        return [
            Read(channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    make_log(path, TICKS, chunk_every=5)
    return path


def test_a_whole_log_is_recovered_whole(whole: Path, tmp_path: Path) -> None:
    recovery = recover(whole, tmp_path / "out.mcap")
    assert recovery.lost == []
    assert read(tmp_path / "out.mcap") == read(whole)
    assert review(tmp_path / "out.mcap").z_track == review(whole).z_track


def test_a_log_cut_at_any_byte_gives_every_whole_chunk_before_it_to_an_independent_reader(
    whole: Path, tmp_path: Path
) -> None:
    data, everything = whole.read_bytes(), read(whole)
    rng = random.Random(2)
    broken = tmp_path / "broken.mcap"
    lengths = []
    for n, size in enumerate(sorted(rng.randrange(len(data)) for _ in range(300))):
        broken.write_bytes(data[:size])
        out = tmp_path / f"{n}.mcap"
        try:
            recovery = recover(broken, out)
        except RecoverError:
            assert not out.exists()
            lengths.append(0)
            continue
        got = read(out)
        assert got == everything[: len(got)]
        assert recovery.messages == len(got)
        assert recovery.lost or got == everything  # cut behind the last message, within the index
        lengths.append(len(got))
    assert lengths == sorted(lengths)  # the later the cut, the more
    assert lengths[-1] > 0.8 * len(everything)
    assert len(set(lengths)) >= TICKS // 50  # chunk by chunk


@pytest.mark.parametrize("which", range(8))
def test_a_damaged_chunk_costs_its_own_messages_and_no_others(whole: Path, tmp_path: Path, which: int) -> None:
    """Also the first one, where the channels stand: the file's end repeats them."""
    data, everything = bytearray(whole.read_bytes()), read(whole)
    chunks = []
    at = 8
    while at < len(data) - 8:
        opcode, length = data[at], int.from_bytes(data[at + 1 : at + 9], "little")
        if opcode == 0x06:
            chunks.append((at + 9, length))
        at += 9 + length
    start, length = chunks[which]
    data[start + length // 2] ^= 0x55
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    recovery = recover(broken, tmp_path / "out.mcap")
    assert len(recovery.lost) == 1
    got = read(tmp_path / "out.mcap")
    assert set(got) < set(everything)
    lost = [message for message in everything if message not in set(got)]
    assert len(lost) < 1.5 * len(everything) / len(chunks)
    first = everything.index(lost[0])
    assert everything[first : first + len(lost)] == lost  # in one piece


def test_what_is_no_log_or_stands_in_the_way_is_reported_in_one_line(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("hello")
    for broken, out in ((tmp_path / "text.mcap", tmp_path / "a"), (tmp_path / "none.mcap", tmp_path / "b")):
        with pytest.raises(RecoverError) as refused:
            recover(broken, out)
        assert len(str(refused.value).splitlines()) == 1
        assert not out.exists()
    with pytest.raises(OutputError, match="is an input"):
        recover(whole, whole)


def test_what_a_full_disk_cut_short_is_removed(whole: Path, tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(OutputError, match=os.strerror(errno.EFBIG)):
            recover(whole, tmp_path / "out.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not (tmp_path / "out.mcap").exists()


# Descriptions


@pytest.fixture(scope="module", params=["a run's first file", "a later file"])
def described(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with its descriptions where the recorder puts them: at both ends and, in the first, as messages."""
    settings, path = lockstep(), tmp_path_factory.mktemp("log") / f"{request.param}.mcap"
    log = LogFile(path)
    descriptions = {
        topics.key("description", VEHICLE, role=role): description(settings, role).encode()
        for role in ("controller", "plant")
    }

    def add_metadata() -> None:
        for key, text in descriptions.items():
            log.add_metadata(DESCRIPTION_METADATA, {"key": key, "json": text.decode()})

    add_metadata()
    for key, text in descriptions.items() if "first" in request.param else ():
        log.add(Delivery(key, text, 0, START_NS, None), START_NS)
    log.commit()
    for i, one in enumerate(made(settings, 100)):
        log.add(Delivery(one.key, one.payload, i, one.published_ns, None), one.at_ns)
    log.commit()
    add_metadata()
    log.end()
    return path


def test_one_flipped_bit_in_a_description_costs_no_log_and_changes_no_figure(described: Path, tmp_path: Path) -> None:
    """Wherever it flips: in JSON, in a name, in a length, in a chunk; and what is recovered of it is read as well."""
    data, rng = described.read_bytes(), random.Random(4)
    at = [i for i in range(len(data)) if data.startswith(b'{"protocol":2', i)]
    assert len(at) == 4  # uncompressed, of two roles, at both ends
    chunk = data.index(b"zstd")
    spots = [place - 120 + rng.randrange(3000) for place in at for _ in range(2)]
    spots += [at[0] - d for d in (2, 4, 60, 100)]
    if "first" in described.name:  # the first chunk has nothing but descriptions
        spots += [chunk + 12 + 9 * i for i in range(4)]
    clean = review(described)
    bent, out = tmp_path / "bent.mcap", tmp_path / "out.mcap"
    for spot in spots:
        damaged = bytearray(data)
        damaged[spot] ^= 1 << rng.randrange(8)
        bent.write_bytes(damaged)
        assert recover(bent, out).lost, spot
        damaged_one, recovered = review(bent), review(out)
        for figures in (damaged_one, recovered):
            assert (figures.z_track, figures.u_total) == (clean.z_track, clean.u_total), spot
        assert damaged_one.damages, spot
        out.unlink()

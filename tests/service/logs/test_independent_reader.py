"""Independent MCAP reader on logs of this project: the whole file, as a stream and by the index.

The reader is Foxglove's own, in tests/readers. It checks every checksum and refuses a damaged file.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Message

from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.logs.mcap_file import records
from aeroloop.service.recording import rolling
from aeroloop.service.settings import RecorderSettings
from tests.support.made_log import make_log
from tests.support.mcap_parts import with_a_damaged_chunk

READERS = Path(__file__).parents[2] / "readers"
INSTALL = "npm install --no-package-lock --prefix tests/readers"
TICKS = 400


Reader = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="session")
def reader() -> Reader:
    """Runs the independent reader over some files."""
    node = shutil.which("node")
    if node is None or not (READERS / "node_modules").is_dir():
        assert "CI" not in os.environ, "CI has Node.js and the reader"
        pytest.skip(f"no independent reader: install Node.js, then run `{INSTALL}`")

    def run(*paths: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [node, READERS / "count.mjs", *paths], capture_output=True, text=True, check=False, timeout=60
        )

    return run


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    make_log(path, TICKS, chunk_every=5)
    return path


def ours(path: Path) -> dict[str, dict[str, Any]]:
    """What our own reader finds of each topic: messages, bytes, the first and the last log time [ns]."""
    found: defaultdict[str, list[Message]] = defaultdict(list)
    names: dict[int, str] = {}
    for record in records(path):
        if isinstance(record, Channel):
            names[record.id] = record.topic
        elif isinstance(record, Message):
            found[names[record.channel_id]].append(record)
    return {
        topic: {
            "count": len(its),
            "bytes": sum(len(one.data) for one in its),
            "first": str(min(one.log_time for one in its)),
            "last": str(max(one.log_time for one in its)),
        }
        for topic, its in found.items()
    }


def assert_all_read(reader: Reader, *paths: Path) -> None:
    done = reader(*paths)
    assert done.returncode == 0, done.stderr
    output = json.loads(done.stdout)
    for path in paths:
        mine = ours(path)
        assert mine
        assert output[str(path)]["stream"] == output[str(path)]["index"] == mine


def test_a_recorded_log(reader: Reader, whole: Path) -> None:
    assert_all_read(reader, whole)
    assert ours(whole)["aeroloop/aero/telemetry"]["count"] == TICKS // 10


def test_the_files_of_a_rotated_run(
    reader: Reader, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them alone, and together as many messages as were recorded."""
    monkeypatch.setattr(rolling, "CHUNK_S", 1e-9)
    settings = RecorderSettings(path=tmp_path / "run.mcap", max_file_mb=0.005)
    log = rolling.RollingLog(settings, lambda text, _: pytest.fail(text))
    with whole.open("rb") as file:
        for i, (_, channel, message) in enumerate(make_reader(file).iter_messages()):
            log.add(
                Delivery(channel.topic, message.data, message.sequence, message.publish_time, None),
                message.log_time,
                [],
            )
            if i % 5 == 4:
                log.tend()
    log.close()
    files = sorted(tmp_path.glob("run*.mcap"))
    assert len(files) > 3
    assert_all_read(reader, *files)
    recorded, together = ours(whole), Counter[str]()
    for path in files:
        together.update({topic: its["count"] for topic, its in ours(path).items()})
    assert together == {topic: its["count"] for topic, its in recorded.items()}


def test_the_reader_turns_away_what_is_not_whole(reader: Reader, whole: Path, tmp_path: Path) -> None:
    """Otherwise the tests above would say nothing."""
    damaged = with_a_damaged_chunk(whole, tmp_path / "damaged.mcap")
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[:-20])
    for path in (damaged, tmp_path / "cut.mcap"):
        done = reader(path)
        assert done.returncode == 1
        assert str(path) in done.stderr
        assert done.stdout == ""

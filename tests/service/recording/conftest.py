"""What tests of a recording share: a session, a clock and a disk."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from mcap.records import Channel, Message, Metadata

from service.logs.mcap_file import records
from service.recording import rolling
from service.recording.intake import Taken
from tests.service.logs.made_log import AN_OPERATORS_WORDS, make_log
from tests.service.recording.recording import Clock, Disk, Story

TICKS = 600


@pytest.fixture(scope="session")
def story(tmp_path_factory: pytest.TempPathFactory) -> Story:
    """A session of 1.2 s, in which an operator speaks at 0.24, 0.5 and 0.8 s."""
    path = tmp_path_factory.mktemp("made") / "made.mcap"
    make_log(path, TICKS, changes=AN_OPERATORS_WORDS)
    channels: dict[int, str] = {}
    messages: list[Taken] = []
    contract: dict[str, str] = {}
    for record in records(path):
        if isinstance(record, Metadata):
            contract = record.metadata
        elif isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message):
            # it comes some time after it was published, so that the two cannot be taken for each other
            messages.append(Taken(channels[record.channel_id], record.data, record.publish_time, record.log_time + 77))
    return Story(contract["key"], contract["json"].encode(), messages)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()
    disk.install(monkeypatch)
    return disk


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, disk: Disk) -> Iterator[Clock]:
    """With a disk that is not a real one."""
    del disk
    clock = Clock()
    monkeypatch.setattr(rolling, "time", SimpleNamespace(monotonic=lambda: clock.now))
    yield clock
    for log in clock.logs:
        log._file.abandon()  # of a test that failed, it may be open still

"""Decoded log: every raw message unchanged, and every message decoded once."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.service.config import load
from aeroloop.service.logs.export import ExportError, export
from aeroloop.service.logs.mcap_file import DESCRIPTION_METADATA
from aeroloop.service.logs.recording import Recording
from aeroloop.service.review.review import review
from aeroloop.service.viewers.channels import Decoder
from tests.support.edited_log import Said, write_messages
from tests.support.made_log import SESSION, VEHICLE, make_log
from tests.support.mcap_parts import by_mcap

TICKS = 400


def test_a_log_with_everything_decoded_has_every_raw_message_and_each_row_decoded(tmp_path: Path) -> None:
    """Also where the recorder has decoded some already: those are made again, not doubled."""
    log = tmp_path / "log.mcap"
    make_log(log, TICKS, settings=load())
    raw, rng = by_mcap(log), random.Random(3)
    files = Recording([log])
    decoder = Decoder(rate_hz=10)
    for description in files.descriptions.values():
        decoder.configure(description)
    recorded = [Said(message.topic, message.log_time, message.data) for message in raw]
    for message in raw:
        address = topics.read_key(message.topic)
        assert address is not None
        recorded += [Said(d.topic, d.at_ns, d.data) for d in decoder.take(address, message.data, message.publish_time)]
    assert len(recorded) > len(raw)
    rng.shuffle(recorded)
    descriptions = [
        (DESCRIPTION_METADATA, {"key": topics.key("description", VEHICLE, role=role), "json": one.model_dump_json()})
        for (_, role), one in files.descriptions.items()
    ]
    write_messages(tmp_path / "recorded.mcap", recorded, descriptions)
    exported = export([tmp_path / "recorded.mcap"], "mcap", tmp_path / "out.mcap")
    found = by_mcap(tmp_path / "out.mcap")
    assert exported.rows == len(found)
    assert sorted((m.topic, m.log_time, m.data) for m in found if m.topic.startswith("aeroloop/")) == sorted(
        (m.topic, m.log_time, m.data) for m in raw
    )
    for name in ("measurement", "pose", "command"):
        assert len([m for m in found if m.topic == f"/{VEHICLE}/{name}"]) == TICKS
    assert Recording([tmp_path / "out.mcap"]).descriptions == files.descriptions
    assert review(tmp_path / "out.mcap").z_track == review(log).z_track
    with pytest.raises(ExportError, match="--session"):
        export([log], "mcap", tmp_path / "other.mcap", session=SESSION)

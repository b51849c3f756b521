"""Stored logs and what readers find in them: `uv run python -m tests.golden.make` makes them anew.

Each is a lockstep run: every run on any machine gives the same figures. A deliberate change of format or arithmetic
makes them anew in a commit of its own. `--expected` keeps the logs and stores what today's readers find in them;
`--described` leaves keys that are gone out of the logs' descriptions and the plant's changes, and all else as it was.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from mcap.reader import make_reader
from mcap.writer import Writer

from aeroloop.protocol.messages.models import Description
from aeroloop.protocol.messages.trace import PlantChange
from aeroloop.service.config import Settings
from aeroloop.service.logs.mcap_file import DESCRIPTION_METADATA, with_checksum
from aeroloop.service.testing.hil import Hil

HERE: Final = Path(__file__).parent
LOGS: Final[dict[str, list[str]]] = {
    "default": [],
    "on-change": ["wire.transmit=on_change", "wire.attitude.bits=10"],
    "can": ["plant.via=can"],
}
"""Name of each, and what is not default in it."""


def aeroloop(*words: str) -> Any:
    """What a command prints as JSON, whatever its exit code."""
    command = [sys.executable, "-m", "aeroloop", *words, "--json"]
    return json.loads(subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False).stdout)


def expected(name: str) -> dict[str, Any]:
    """What readers find in a log."""
    return {verb: aeroloop("log", verb, f"{name}.mcap") for verb in ("review", "replay")}


def make(name: str) -> None:
    """Run the loop of a log: of the emulator with an operator's changes, a fault, a stop and a second session."""
    settings = dict(each.split("=") for each in LOGS[name])
    with TemporaryDirectory() as folder:
        if settings.get("plant.via") == "can":
            words = ("demo", "--lockstep", "--duration", "8", "--set", "plant.via=can")
            aeroloop(*words, "--log", f"{folder}/can.mcap")
        else:
            with Hil(Path(folder), lockstep=True) as hil:
                hil.start(settings=settings)
                hil.run(4)
                hil.set_gains(C2=(0.2, 0.2, 0.2))
                hil.run(1)
                hil.goto(0, 10, -30, in_s=4)
                hil.inject("rate.y:bias=0.05@0..0.5")
                hil.run(4)
                hil.stop()
                hil.arm()
                hil.eventually("a second session", lambda: hil.state("plant") == "granted")
                hil.run(2)
        (log,) = Path(folder).glob("*.mcap")
        (HERE / f"{name}.mcap").write_bytes(log.read_bytes())


def describe(name: str) -> None:
    """Write a log again with the configuration keys that there are now."""
    path = HERE / f"{name}.mcap"
    known = json.loads(json.dumps(Settings().description()))
    with path.open("rb") as file:
        reader = make_reader(file)
        messages = list(reader.iter_messages(log_time_order=False))
        metadata = [(record.name, dict(record.metadata)) for record in reader.iter_metadata()]
        attachments = list(reader.iter_attachments())
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="aeroloop", library="tests.golden.make")
        for attached in attachments:
            writer.add_attachment(
                attached.create_time, attached.log_time, attached.name, attached.media_type, attached.data
            )
        for kind, entries in metadata:
            if kind == DESCRIPTION_METADATA:
                entries["json"] = _described(entries["json"].encode(), known).decode()
                entries = with_checksum(kind, {key: value for key, value in entries.items() if key != "crc32"})
            writer.add_metadata(kind, entries)
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for schema, channel, message in messages:
            if channel.topic not in channels:
                if schema is not None and schema.name not in schemas:
                    schemas[schema.name] = writer.register_schema(schema.name, schema.encoding, schema.data)
                which = schemas[schema.name] if schema is not None else 0
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, which)
            data = message.data
            if "/description/" in channel.topic:
                data = _described(data, known)
            elif channel.topic.endswith("/trace/plant"):
                data = _traced(data)
            number = channels[channel.topic]
            writer.add_message(number, message.log_time, data, message.publish_time, message.sequence)
        writer.finish()


def _described(text: bytes, known: dict[str, Any]) -> bytes:
    """A description without the keys that are gone."""
    content = json.loads(text)
    content["config"] = _kept(content["config"], known)
    return Description.model_validate(content).encode()


def _traced(batch: bytes) -> bytes:
    """A batch of the plant whose changes have the fields that there are now; its tail's length is a u32 at byte 12."""
    size = int.from_bytes(batch[12:16], "little")
    tail = json.loads(batch[-size:]) if size else {}
    if "operations" not in tail:
        return batch
    fields = PlantChange.model_fields
    tail["operations"] = [{key: change[key] for key in change if key in fields} for change in tail["operations"]]
    text = json.dumps(tail, separators=(",", ":"), ensure_ascii=False).encode()
    return batch[:12] + len(text).to_bytes(4, "little") + batch[16:-size] + text


def _kept(config: dict[str, Any], known: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _kept(value, known[key])
        if isinstance(value, dict) and isinstance(known[key], dict) and known[key]
        else value
        for key, value in config.items()
        if key in known
    }


if __name__ == "__main__":
    for each in LOGS:
        if "--described" in sys.argv:
            describe(each)
        elif "--expected" not in sys.argv:
            make(each)
        (HERE / f"{each}.json").write_text(json.dumps(expected(each), indent=1) + "\n")

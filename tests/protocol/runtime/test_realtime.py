"""Real-time set-up: what a loop needs is ready before its first tick."""

from __future__ import annotations

from collections.abc import Iterator

from aeroloop.protocol.messages.operator import Message
from aeroloop.protocol.messages.topics import TOPICS
from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.wire.loop import LoopSettings


def derived(base: type[Message]) -> Iterator[type[Message]]:
    for model in base.__subclasses__():
        yield model
        yield from derived(model)


def test_the_parser_of_every_message_is_built_before_the_first_tick() -> None:
    class Late(Message):
        tick: int

    assert not Late.__pydantic_complete__  # so at import, whatever other tests have used of the others
    prepare_process(LoopSettings(realtime="off"))
    models = set(derived(Message))
    assert {Late, *(topic.model for topic in TOPICS.values() if topic.model)} <= models
    assert all(model.__pydantic_complete__ for model in models)

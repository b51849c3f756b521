"""What the theorem promises stands in the controller's contract, and so in every log."""

from __future__ import annotations

from service.config import load
from service.promise import promise_of, verdict_of


def test_the_contract_says_what_lab_certify_says() -> None:
    promise = promise_of(load(overrides=["wire.attitude.bits=12", "wire.rate.bits=12", "wire.voltage.bits=12"]))
    assert promise is not None
    assert promise["holds"] is True
    assert 3.0 < promise["radius_deg"] < 3.4  # 3.18 in the README
    assert verdict_of(promise).endswith(".")


def test_of_a_live_stream_nothing_is_promised() -> None:
    assert promise_of(load(overrides=['reference={kind = "stream"}'])) is None

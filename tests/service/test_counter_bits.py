"""Counter bits: a frame counter too short to detect late frames is refused, with a remedy."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.service.config import ConfigError, load


@settings(max_examples=80, deadline=None)
@given(
    bits=st.integers(4, 16),
    rate=st.sampled_from([1, 20, 50, 100, 250, 500, 1000, 4000, 10_000]),
    watchdog=st.sampled_from([0.01, 0.1, 0.128, 0.256, 1, 2, 10]),
    stale=st.sampled_from([0.01, 0.1, 0.128, 0.256, 1, 2, 10]),
)
def test_a_counter_counts_twice_the_watchdog_and_the_stale_time_or_the_refusal_states_how_many_bits_would(
    bits: int, rate: int, watchdog: float, stale: float
) -> None:
    loop = (f"loop.rate_hz={rate}", f"plant.watchdog_s={watchdog}", f"controller.stale_s={stale}")
    needed = 2 * max(watchdog, stale) * rate
    if 2**bits >= needed:
        assert load(overrides=[*loop, f"wire.counter_bits={bits}"]).wire.counter_bits == bits
        return
    name = "plant.watchdog_s" if watchdog >= stale else "controller.stale_s"
    with pytest.raises(ConfigError, match=rf"^wire\.counter_bits = {bits} counts .*{name}") as refused:
        load(overrides=[*loop, f"wire.counter_bits={bits}"])
    if found := re.search(r"set it to (\d+)$", str(refused.value)):
        least = int(found[1])
        assert 2 ** (least - 1) < needed <= 2**least
        assert load(overrides=[*loop, f"wire.counter_bits={least}"]).wire.counter_bits == least
    else:
        assert needed > 2**16
        assert f"16 bits are too few; shorten {name}, or lower loop.rate_hz" in str(refused.value)


def test_a_short_counter_is_accepted_in_lockstep_and_on_a_can_bus_whose_frame_holds_no_longer_one() -> None:
    assert load(overrides=["wire.counter_bits=4", "loop.lockstep=true"]).wire.counter_bits == 4
    ten_bits = ("wire.attitude.bits=10", "wire.rate.bits=10", "wire.counter_bits=4")
    assert load(overrides=["plant.via=can", *ten_bits]).wire.counter_bits == 4
    for others in (ten_bits, ["plant.via=can", "can.fd=true", *ten_bits], ["plant.via=can", "wire.counter_bits=4"]):
        with pytest.raises(ConfigError, match=r"set it to 7$"):
            load(overrides=others)

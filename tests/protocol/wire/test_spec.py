"""Spec of the wire: what it refuses, its quantizers, its differences, its JSON form, other bits."""

from __future__ import annotations

from math import nan

import pytest
from hypothesis import given
from pydantic import ValidationError

from aeroloop.protocol.wire.spec import SignalBits, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Transmit
from tests.support.wires import any_width, specs, wires

HELD, GROWING = {"kind": "hysteresis-uniform"}, {"kind": "logarithmic-uniform"}


@pytest.mark.parametrize(
    ("section", "broken", "why"),
    [
        ("attitude", {"bits": 17}, "attitude"),
        ("rate", {"limit": nan}, "rate"),
        ("rate", {"hysteresis": 0.1}, 'hysteresis belongs to kind = "hysteresis-uniform"'),
        ("rate", {**GROWING, "bits": 2}, "at least 3 bits"),
        ("rate", {**HELD, "hysteresis": 1.0}, "less than the limit"),
        ("actuators", 9, "actuators"),
        ("counter_bits", 3, "counter_bits"),
        ("transmit", "sometimes", "transmit"),
    ],
)
def test_a_spec_out_of_bounds_is_refused_by_the_name_of_its_field(section: str, broken: object, why: str) -> None:
    whole = (
        {"bits": 8, "limit": 1.0, **broken} if section in ("attitude", "rate") and isinstance(broken, dict) else broken
    )
    with pytest.raises(ValidationError, match=why):
        WireSpec.model_validate({section: whole})


@given(specs)
def test_a_spec_survives_json(spec: WireSpec) -> None:
    assert spec.measurement.size > 0  # which caches the format; that is no field
    again = WireSpec.model_validate_json(spec.model_dump_json())
    assert (again, hash(again), again.differences(spec)) == (spec, hash(spec), [])
    assert WireSpec.model_validate(spec.agreed()) == spec  # which leaves out what is not in use


def test_two_wires_differ_by_every_field_and_both_values() -> None:
    ours = WireSpec(rate=SignalSpec(bits=8, limit=3.0))
    theirs = WireSpec(
        attitude=SignalSpec(bits=None, limit=1.0),
        rate=SignalSpec(bits=8, limit=1.0, kind="hysteresis-uniform", hysteresis=0.1),
        actuators=3,
        transmit=Transmit(command="on_change"),
        counter_bits=10,
    )
    assert ours.differences(theirs) == [
        "attitude.bits: 8, not None", "rate.limit: 3.0, not 1.0", "rate.kind: uniform, not hysteresis-uniform",
        "rate.hysteresis: None, not 0.1", "actuators: 2, not 3", "transmit.command: periodic, not on_change",
        "counter_bits: 8, not 10",
    ]  # fmt: skip


@given(wires, any_width, any_width, any_width)
def test_with_bits_changes_the_bits_and_nothing_else(
    spec: WireSpec, a: int | None, b: int | None, u: int | None
) -> None:
    bits = SignalBits(a, b, u)
    assert SignalBits.parse(str(bits)) == bits
    changed = spec.with_bits(str(bits))
    assert SignalBits(changed.attitude.bits, changed.rate.bits, changed.voltage.bits) == bits
    assert all(".bits:" in line for line in changed.differences(spec))


def test_other_bits_keep_the_kind_and_are_refused_where_it_takes_none_such() -> None:
    wire = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="logarithmic-uniform", threshold=0.2))
    assert wire.with_bits("10/6").rate == wire.rate.model_copy(update={"bits": 10})
    assert wire.with_bits("cont/6").with_bits("8/6") == wire
    with pytest.raises(ValueError, match=r"^a logarithmic-uniform quantizer has at least 3 bits, not 2$"):
        wire.with_bits("2/6")


@pytest.mark.parametrize("text", ["8", "8/6/4/2", "8/1", "17/6", "8/6/", "a/b", ""])
def test_bits_are_two_or_three_numbers_in_range(text: str) -> None:
    with pytest.raises(ValueError, match="such as 10/6/6"):
        SignalBits.parse(text)

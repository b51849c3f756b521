"""Spec of the wire: what it refuses, its differences, its JSON form, other bits."""

from __future__ import annotations

import re
from math import inf, nan

import pytest
from hypothesis import given
from pydantic import ValidationError

from aeroloop.protocol.wire.quantizer import Continuous, UniformQuantizer
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from tests.support.wires import any_width, signals, specs, wire_of, wires


@pytest.mark.parametrize(
    ("section", "broken"),
    [
        ("attitude", {"bits": 1, "limit": 1.0}),
        ("attitude", {"bits": 17, "limit": 1.0}),
        ("rate", {"bits": 8.5, "limit": 1.0}),
        ("rate", {"bits": "many", "limit": 1.0}),
        ("rate", {"bits": 8, "limit": 0.0}),
        ("rate", {"bits": 8, "limit": -1.0}),
        ("voltage", {"bits": 8, "limit": inf}),
        ("voltage", {"bits": 8, "limit": nan}),
        ("voltage", {"bits": 8}),
        ("voltage", {"limit": 1.0}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": 1.0}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": 1.5}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": 0.0}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": nan}),
        ("rate", {"bits": 8, "limit": 1.0, "offset": 0.0}),
        ("actuators", 0),
        ("actuators", 9),
        ("counter_bits", 3),
        ("counter_bits", 17),
        ("counter_bits", "cont"),
        ("thrust", {"bits": 8, "limit": 1.0}),
    ],
)
def test_a_spec_out_of_bounds_is_refused_by_the_name_of_its_field(section: str, broken: object) -> None:
    with pytest.raises(ValidationError, match=section):
        WireSpec.model_validate({section: broken})


def test_the_word_cont_means_no_quantization() -> None:
    assert SignalSpec.model_validate({"bits": "cont", "limit": 2.0}) == SignalSpec(bits=None, limit=2.0)


@given(signals())
def test_a_signal_gives_its_quantizer(signal: SignalSpec) -> None:
    quantizer = signal.quantizer()
    assert quantizer.limit == signal.limit
    assert signal.quantizer() is not quantizer  # each counts its own saturations
    if signal.bits is None:
        assert isinstance(quantizer, Continuous)
    else:
        assert isinstance(quantizer, UniformQuantizer)
        assert quantizer.bits == signal.bits
        # Half a step, rounded twice, unless given.
        expected = signal.limit / (2**signal.bits - 1) if signal.deadzone is None else signal.deadzone
        assert quantizer.deadzone == pytest.approx(expected, rel=2.0**-50)


@given(specs)
def test_a_spec_survives_json(spec: WireSpec) -> None:
    assert spec.measurement.size > 0  # which caches the format; that is no field
    again = WireSpec.model_validate_json(spec.model_dump_json())
    assert again == spec
    assert hash(again) == hash(spec)
    assert again.differences(spec) == []


@given(specs)
def test_a_spec_cannot_be_changed(spec: WireSpec) -> None:
    with pytest.raises(ValidationError, match="frozen"):
        spec.actuators = 3  # type: ignore[misc]  # that is the point
    with pytest.raises(ValidationError, match="frozen"):
        spec.rate.bits = 4  # type: ignore[misc]  # the same


@pytest.mark.parametrize("field", ["bits", "limit", "deadzone"])
@pytest.mark.parametrize("signal", ["attitude", "rate", "voltage"])
def test_a_difference_names_its_field_and_both_values(signal: str, field: str) -> None:
    mine = {"bits": 8, "limit": 3.0, "deadzone": 0.5}
    theirs = {"bits": 10, "limit": 4.0, "deadzone": 0.25}
    a = WireSpec.model_validate({signal: mine})
    b = WireSpec.model_validate({signal: {**mine, field: theirs[field]}})
    assert a.differences(b) == [f"{signal}.{field}: {mine[field]}, not {theirs[field]}"]
    assert b.differences(a) == [f"{signal}.{field}: {theirs[field]}, not {mine[field]}"]


def test_all_differences_are_reported_in_one_go() -> None:
    lines = wire_of(8, 8, 6, 2).differences(wire_of(None, 8, 4, 3, 10))
    assert [re.split(":", line)[0] for line in lines] == ["attitude.bits", "voltage.bits", "actuators", "counter_bits"]


@given(wires, any_width, any_width)
def test_with_bits_changes_the_bits_and_nothing_else(spec: WireSpec, out: int | None, inp: int | None) -> None:
    changed = spec.with_bits(out, inp)
    assert (changed.attitude.bits, changed.rate.bits, changed.voltage.bits) == (out, out, inp)
    assert changed.with_bits(8, 6) == spec.with_bits(8, 6)
    assert all(".bits:" in line for line in changed.differences(spec))
    assert changed.counter_bits == spec.counter_bits

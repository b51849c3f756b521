"""Spec of the wire: what it refuses, its quantizers, its differences, its JSON form, other bits."""

from __future__ import annotations

from math import inf, nan

import pytest
from hypothesis import given
from pydantic import ValidationError

from aeroloop.protocol.wire.quantizer import (
    Continuous,
    UniformQuantizer,
)
from aeroloop.protocol.wire.spec import SignalBits, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Transmit
from tests.support.wires import any_width, signals, specs, wire_of, wires

HELD, GROWING = {"kind": "hysteresis-uniform"}, {"kind": "logarithmic-uniform"}


@pytest.mark.parametrize(
    ("section", "broken"),
    [
        *(("attitude", {"bits": bits, "limit": 1.0}) for bits in (1, 17, 8.5, "many")),
        *(("rate", {"bits": 8, "limit": limit}) for limit in (0.0, -1.0, inf, nan)),
        *(("attitude", {"bits": 8, "limit": 1.0, "deadzone": deadzone}) for deadzone in (0.0, 1.0, 1.5, nan)),
        ("voltage", {"bits": 8}),
        ("voltage", {"limit": 1.0}),
        ("rate", {"bits": 8, "limit": 1.0, "offset": 0.0}),
        *(("actuators", number) for number in (0, 9)),
        *(("counter_bits", bits) for bits in (3, 17, "cont")),
        ("thrust", {"bits": 8, "limit": 1.0}),
    ],
)
def test_a_spec_out_of_bounds_is_refused_by_the_name_of_its_field(section: str, broken: object) -> None:
    with pytest.raises(ValidationError, match=section):
        WireSpec.model_validate({section: broken})


@pytest.mark.parametrize(
    ("signal", "why"),
    [
        ({"hysteresis": 0.1}, 'hysteresis belongs to kind = "hysteresis-uniform"'),
        ({**GROWING, "hysteresis": 0.1}, "hysteresis belongs to"),
        ({**HELD, "threshold": 0.1}, 'threshold belongs to kind = "logarithmic-uniform"'),
        ({"bits": "cont", "threshold": 0.1}, "threshold belongs to"),
        ({**GROWING, "bits": 2}, "at least 3 bits"),
        ({**HELD, "hysteresis": 1.0}, "less than the limit"),
        ({"kind": "logarithm"}, "kind"),
    ],
)
def test_a_parameter_that_does_not_belong_to_the_kind_is_refused(signal: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        SignalSpec.model_validate({"bits": 8, "limit": 1.0, **signal})


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
def test_a_spec_survives_json_and_cannot_be_changed(spec: WireSpec) -> None:
    assert spec.measurement.size > 0  # which caches the format; that is no field
    again = WireSpec.model_validate_json(spec.model_dump_json())
    assert (again, hash(again), again.differences(spec)) == (spec, hash(spec), [])
    with pytest.raises(ValidationError, match="frozen"):
        spec.actuators = 3  # type: ignore[misc]  # that is the point
    with pytest.raises(ValidationError, match="frozen"):
        spec.rate.bits = 4  # type: ignore[misc]  # the same


def test_the_default_wire_is_the_paper_s() -> None:
    assert WireSpec() == wire_of(8, 8, 6, 2)


@pytest.mark.parametrize(
    ("ours", "theirs", "differences"),
    [
        (
            wire_of(8, 8, 6, 2),
            wire_of(None, 8, 4, 3, 10),
            [
                "attitude.bits: 8, not None",
                "voltage.bits: 6, not 4",
                "actuators: 2, not 3",
                "counter_bits: 8, not 10",
            ],
        ),
        (
            WireSpec(rate=SignalSpec(bits=8, limit=3.0, deadzone=0.5)),
            WireSpec(rate=SignalSpec(bits=8, limit=4.0, deadzone=0.25)),
            ["rate.limit: 3.0, not 4.0", "rate.deadzone: 0.5, not 0.25"],
        ),
        (
            WireSpec(),
            WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="hysteresis-uniform", hysteresis=0.1)),
            ["rate.kind: uniform, not hysteresis-uniform", "rate.hysteresis: None, not 0.1"],
        ),
        (
            WireSpec(),
            WireSpec(transmit=Transmit(command="on_change", heartbeat_s=0.02)),
            ["transmit.command: periodic, not on_change", "transmit.heartbeat_s: 0.03, not 0.02"],
        ),
    ],
)
def test_two_wires_differ_by_every_field_and_both_values(
    ours: WireSpec, theirs: WireSpec, differences: list[str]
) -> None:
    assert ours.differences(theirs) == differences


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


def test_the_agreement_leaves_out_what_is_not_in_use() -> None:
    wire = WireSpec(
        rate=SignalSpec(bits=8, limit=1.0, kind="logarithmic-uniform"), transmit=Transmit(measurement="on_change")
    )
    published = wire.agreed()
    assert published["attitude"] == {"bits": 8, "limit": 1.0, "deadzone": None}
    assert published["rate"] == {
        "bits": 8, "limit": 1.0, "deadzone": None, "kind": "logarithmic-uniform", "hysteresis": None, "threshold": None
    }  # fmt: skip
    assert WireSpec.model_validate(published) == wire
    assert "transmit" not in WireSpec().agreed()


@pytest.mark.parametrize("text", ["8", "8/6/4/2", "8/1", "17/6", "8/6/", "a/b", ""])
def test_bits_are_two_or_three_numbers_in_range(text: str) -> None:
    with pytest.raises(ValueError, match="such as 10/6/6"):
        SignalBits.parse(text)

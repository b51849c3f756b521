"""Kinds of quantizers in a wire spec, and the comparison of both ends' specs."""

from __future__ import annotations

import pytest

from aeroloop.protocol.wire.quantizer import CodedQuantizer, HysteresisQuantizer, LogarithmicQuantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import Kind, SignalSpec, WireSpec


@pytest.mark.parametrize(
    ("kind", "made"),
    [
        ("uniform", UniformQuantizer),
        ("hysteresis-uniform", HysteresisQuantizer),
        ("logarithmic-uniform", LogarithmicQuantizer),
    ],
)
def test_a_signal_has_the_quantizer_that_it_names(kind: Kind, made: type[CodedQuantizer]) -> None:
    assert type(SignalSpec(bits=8, limit=1.0, kind=kind).quantizer()) is made
    assert SignalSpec(bits=None, limit=1.0, kind=kind).quantizer().bound == 0


def test_the_parameters_reach_the_quantizer() -> None:
    held = SignalSpec(bits=8, limit=2.0, kind="hysteresis-uniform", deadzone=0.1, hysteresis=0.25).quantizer()
    assert isinstance(held, HysteresisQuantizer)
    assert (held.deadzone, held.hysteresis) == (0.1, 0.25)
    grown = SignalSpec(bits=8, limit=2.0, kind="logarithmic-uniform", deadzone=0.01, threshold=0.75).quantizer()
    assert isinstance(grown, LogarithmicQuantizer)
    assert (grown.deadzone, grown.threshold) == (0.01, 0.75)


@pytest.mark.parametrize(
    ("signal", "why"),
    [
        ({"hysteresis": 0.1}, 'hysteresis belongs to kind = "hysteresis-uniform"'),
        ({"kind": "logarithmic-uniform", "hysteresis": 0.1}, "hysteresis belongs to"),
        ({"kind": "hysteresis-uniform", "threshold": 0.1}, 'threshold belongs to kind = "logarithmic-uniform"'),
        ({"bits": "cont", "threshold": 0.1}, "threshold belongs to"),
        ({"kind": "logarithmic-uniform", "bits": 2}, "at least 3 bits"),
        ({"kind": "hysteresis-uniform", "hysteresis": 1.0}, "less than the limit"),
        ({"kind": "logarithm"}, "kind"),
    ],
)
def test_a_parameter_that_does_not_belong_to_the_kind_is_refused(signal: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        SignalSpec.model_validate({"bits": 8, "limit": 1.0, **signal})


def test_other_bits_keep_the_kind_and_are_refused_where_it_takes_none_such() -> None:
    wire = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="logarithmic-uniform", threshold=0.2))
    assert wire.with_bits(10, 6).rate == wire.rate.model_copy(update={"bits": 10})
    assert wire.with_bits(None, 6).with_bits(8, 6) == wire
    with pytest.raises(ValueError, match=r"^a logarithmic-uniform quantizer has at least 3 bits, not 2$"):
        wire.with_bits(2, 6)


def test_two_wires_differ_in_kind_and_its_parameters() -> None:
    uniform = WireSpec()
    held = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="hysteresis-uniform", hysteresis=0.1))
    assert uniform.differences(held) == ["rate.kind: uniform, not hysteresis-uniform", "rate.hysteresis: None, not 0.1"]


def test_a_uniform_signal_is_published_as_it_was_before_there_were_other_kinds() -> None:
    published = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="logarithmic-uniform")).agreed()
    assert published["attitude"] == {"bits": 8, "limit": 1.0, "deadzone": None}
    assert published["rate"] == {
        "bits": 8, "limit": 1.0, "deadzone": None, "kind": "logarithmic-uniform", "hysteresis": None, "threshold": None
    }  # fmt: skip
    assert WireSpec.model_validate(published).rate.kind == "logarithmic-uniform"

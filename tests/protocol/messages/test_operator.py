"""Operator's verbs: what their messages refuse, each with one clear line, and what they just accept."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from aeroloop.protocol.messages.operator import (
    MAX_GAINS,
    MAX_POINTS,
    Gains,
    Hold,
    Message,
    Points,
    Request,
    Setpoint,
    Sinusoid,
    Stream,
    Track,
)


def complaint(model: type[Message], **fields: Any) -> str:
    """The one message that a person gets."""
    with pytest.raises(ValidationError) as refused:
        model.model_validate(fields)
    (error,) = refused.value.errors()
    return f"{error['loc'][0] if error['loc'] else model.__name__}: {error['msg'].removeprefix('Value error, ')}"


TWO = [(0.0, 0.0, 0.0)] * 2
NUMBER = "every element must be a number"
MILLISECOND = "Points: times must rise by at least a millisecond"


@pytest.mark.parametrize(
    ("model", "fields", "expected"),
    [
        (Gains, {"C1": (math.nan, 0.3, 0.3)}, f"C1: {NUMBER}"),
        (Gains, {"C1": (math.inf, 0.3, 0.3)}, f"C1: {NUMBER}"),
        (Gains, {"K": math.nan}, f"K: {NUMBER}"),
        (Gains, {"C1": ()}, "C1: Tuple should have at least 1 item"),
        (Gains, {"C1": (0.3,) * (MAX_GAINS + 1)}, f"C1: Tuple should have at most {MAX_GAINS} items"),
        (Gains, {"C1": "0.3, 0.3, 0.3"}, "C1: Input should be a valid tuple"),
        (Gains, {f"K{i}": 0.3 for i in range(MAX_GAINS + 1)}, f"Gains: a law has {MAX_GAINS} gains at the most"),
        (Points, {"times": [0, 1, 2], "attitudes": TWO}, "Points: 3 times for 2 attitudes"),
        (Points, {"times": [1, 2], "attitudes": TWO}, "Points: the first time must be 0, and every time a number"),
        (
            Points,
            {"times": [0, math.nan], "attitudes": TWO},
            "Points: the first time must be 0, and every time a number",
        ),
        (
            Points,
            {"times": [0, math.inf], "attitudes": TWO},
            "Points: the first time must be 0, and every time a number",
        ),
        (Points, {"times": [0, 0], "attitudes": TWO}, MILLISECOND),
        (Points, {"times": [0, 2, 1], "attitudes": [*TWO, TWO[0]]}, MILLISECOND),
        (Points, {"times": [0, 0.0009], "attitudes": TWO}, MILLISECOND),
        (Points, {"times": [0, 1], "attitudes": [TWO[0], (0, math.nan, 0)]}, f"attitudes: {NUMBER}"),
        (Points, {"times": [0], "attitudes": TWO}, "times: List should have at least 2 items after validation, not 1"),
        (
            Points,
            {"times": range(MAX_POINTS + 1), "attitudes": TWO},
            f"times: List should have at most {MAX_POINTS} items after validation, not more",
        ),
        (Hold, {"attitude": (0.0, math.inf, 0.0)}, f"attitude: {NUMBER}"),
        (Setpoint, {"attitude": (0.0, math.nan, 0.0)}, f"attitude: {NUMBER}"),
        (Sinusoid, {"amplitude": (0.0, math.nan, 0.0)}, f"amplitude: {NUMBER}"),
        (Sinusoid, {"frequency": (0.0, -0.1, 0.0)}, "frequency: Input should be greater than or equal to 0"),
        (Sinusoid, {"frequency": (0.0, math.inf, 0.0)}, "frequency: Input should be less than or equal to 100"),
        (Stream, {"timeout_s": 0.0}, "timeout_s: Input should be greater than 0"),
        (Stream, {"within_s": 0.01}, "within_s: Input should be greater than or equal to 0.02"),
        (Track, {"reference": Hold(), "within_s": 0.0}, "within_s: Input should be greater than or equal to 0.02"),
        (Request, {"by": "a" * 65}, "by: String should have at most 64 characters"),
        (Request, {"by": "\x1b[2J"}, "by: every character must be printable"),
        (Track, {"reference": Hold(), "within_s": math.nan}, "within_s: Input should be less than or equal to 600"),
    ],
)
def test_a_verb_that_makes_no_sense_is_refused_with_one_clear_message(
    model: type[Message], fields: dict[str, Any], expected: str
) -> None:
    said = complaint(model, **fields)
    assert said == expected or said.startswith(expected)


@pytest.mark.parametrize(
    ("model", "fields"),
    [
        (Gains, {}),
        (Gains, {"C1": (20.0, 1e-9, 0.3)}),
        (Points, {"times": [0, 0.001], "attitudes": TWO}),
        (Points, {"times": range(MAX_POINTS), "attitudes": TWO[:1] * MAX_POINTS}),
        (Request, {"by": "ä" * 64}),
        (Stream, {"timeout_s": 60.0, "within_s": 0.02}),
        (Track, {"reference": Hold(), "within_s": 600.0}),
    ],
)
def test_what_is_just_within_the_bounds_is_taken(model: type[Message], fields: dict[str, Any]) -> None:
    model.model_validate(fields)


def test_points_a_millisecond_apart_are_taken() -> None:
    Points(times=[n / 1000 for n in range(20)], attitudes=TWO[:1] * 20)

"""Remedies: the fewest bits, or the least change of a gain, with which condition (C.66) holds, found by search.

Nothing is solved: each candidate is a whole configuration, which the certificate's own function checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from math import ceil, exp, floor, log, log10
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.messages.operator import MAX_GAIN
from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.law import LawSettings

Holds = Callable[[WireSpec, LawSettings], bool]

SIGNALS: Final = ("attitude", "rate", "voltage")
GAINS: Final = ("C1", "C2")
_STEP: Final = 1.1
"""Gains are tried in steps of this factor; then the step that satisfies the condition is bisected."""
_MOST_STEPS: Final = 80
_HALVINGS: Final = 20


class Remedy(BaseModel):
    """One change that satisfies the condition, or the statement that none of a kind does."""

    model_config = ConfigDict(frozen=True)

    text: str = Field(description="one line for a person")
    overrides: list[str] = Field(description="the change as `--set` takes it; empty where none does")


def remedies(wire: WireSpec, law: LawSettings, holds: Holds) -> list[Remedy]:
    """The least changes that would satisfy the condition: of one signal's bits, of all bits, of C₁, of C₂, of both.

    The wire does not satisfy it with the law; `holds` returns whether a configuration does.
    """
    return [*_by_bits(wire, law, holds), *_by_gains(wire, law, holds)]


def _by_bits(wire: WireSpec, law: LawSettings, holds: Holds) -> Iterator[Remedy]:
    quantized = [name for name in SIGNALS if getattr(wire, name).bits is not None]
    if not quantized:
        yield Remedy(text="nothing is quantized: no bits are to blame", overrides=[])
        return
    choices = [[name] for name in quantized] + ([quantized] if len(quantized) > 1 else [])
    found = False
    for names in choices:
        fewest = next((bits for bits, tried in _with_any_bits(wire, names) if holds(tried, law)), None)
        if fewest is not None:
            found = True
            which = f"wire.{names[0]}" if len(names) == 1 else "all of them"
            yield Remedy(text=f"{fewest} bits for {which}", overrides=[f"wire.{name}.bits={fewest}" for name in names])
    if not found:
        yield Remedy(text=f"no number of bits up to {MAX_BITS} would do", overrides=[])


def _with_any_bits(wire: WireSpec, names: list[str]) -> Iterator[tuple[int, WireSpec]]:
    """The wire with every number of bits allowed for the signals named."""
    tree = wire.model_dump()
    for bits in range(MIN_BITS, MAX_BITS + 1):
        for name in names:
            tree[name]["bits"] = bits
        try:
            tried = WireSpec.model_validate(tree)
        except ValueError:
            continue  # some kinds of quantizer need more bits
        yield bits, tried


def _by_gains(wire: WireSpec, law: LawSettings, holds: Holds) -> Iterator[Remedy]:
    found = False
    for name in GAINS:
        factor = _least_factor(lambda f, name=name: holds(wire, scaled(law, {name: f})))  # type: ignore[misc]
        if factor is not None:
            found = True
            yield _gains_remedy(law, {name: factor})
    if found:
        return
    steps = range(-_MOST_STEPS, _MOST_STEPS + 1, 4)  # one gain alone is tried finely, two together coarsely
    for m, n in sorted(product(steps, steps), key=lambda pair: (abs(pair[0]) + abs(pair[1]), pair)):
        factors = {"C1": _STEP**m, "C2": _STEP**n}
        if _allowed(law, factors) and holds(wire, scaled(law, factors)):
            yield _gains_remedy(law, factors)
            return
    yield Remedy(text="no gains C1 and C2 would do", overrides=[])


def _least_factor(holds: Callable[[float], bool]) -> float | None:
    """The factor nearest to 1 by which a gain must grow or shrink; None if none does."""
    for n in range(1, _MOST_STEPS + 1):
        for direction in (1, -1):
            good, bad = log(_STEP) * n * direction, log(_STEP) * (n - 1) * direction
            if not holds(exp(good)):
                continue
            for _ in range(_HALVINGS):
                middle = (good + bad) / 2
                good, bad = (middle, bad) if holds(exp(middle)) else (good, middle)
            return exp(good)
    return None


def _allowed(law: LawSettings, factors: dict[str, float]) -> bool:
    return all(max(getattr(law, name)) * factor <= MAX_GAIN for name, factor in factors.items())


def scaled(law: LawSettings, factors: dict[str, float]) -> LawSettings:
    """The law with some gains multiplied."""
    changed = {name: tuple(gain * factor for gain in getattr(law, name)) for name, factor in factors.items()}
    return law.model_copy(update=changed)


def _gains_remedy(law: LawSettings, factors: dict[str, float]) -> Remedy:
    changed = {name: [_rounded(gain, gain * f) for gain in getattr(law, name)] for name, f in factors.items()}
    return Remedy(
        text=" and ".join(f"law.{name} = {gains}" for name, gains in changed.items()),
        overrides=[f"law.{name}={gains}" for name, gains in changed.items()],
    )


def _rounded(before: float, after: float) -> float:
    """Rounded to four digits, away from the old value, so that rounding does not undo the change."""
    unit = 10.0 ** (floor(log10(after)) - 3)
    steps = ceil(after / unit) if after > before else floor(after / unit)
    return float(f"{steps * unit:.4g}")

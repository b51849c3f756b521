"""Remedies: the fewest bits, or the least change of gains or of the damping's bound, with which a certificate holds.

Nothing is solved: each candidate is a whole configuration, which the certificate's own function checks. Where no single
change would do, bits and the damping's bound are changed together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import ceil, exp, floor, hypot, log, log10
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.interface import MAX_GAIN
from aeroloop.service.theorem.configured import Configured

Holds = Callable[[Configured], bool]

SIGNALS: Final = ("attitude", "rate", "voltage")
GAINS: Final = ("C1", "C2")
_STEP: Final = 1.5
"""Gains are tried in steps of this factor; then the step that satisfies the condition is bisected."""
_MOST_STEPS: Final = 10
_HALVINGS: Final = 8


class Remedy(BaseModel):
    """One change that satisfies the condition, or the statement that none of a kind does."""

    model_config = ConfigDict(frozen=True)

    text: str = Field(description="one line for a person")
    overrides: list[str] = Field(description="the change as `--set` takes it; empty where none does")


def remedies(settings: Configured, holds: Holds) -> list[Remedy]:
    """The least changes with which it would hold: of a signal's bits, of all bits, of a gain, of the damping's bound.

    The settings do not satisfy it; `holds` returns whether a configuration does.
    """
    found = list(_by_gains(settings, holds))
    if holds(_most_generous(settings)):
        found = [*_by_bits(settings, holds), *found, *_by_damping(settings, holds)]
        found = found or list(_by_bits_and_damping(settings, holds))
    return found or [Remedy(text="no bits, no gain and no damping bound would do", overrides=[])]


def _most_generous(settings: Configured) -> Configured:
    """The most bits and the smallest bound of the damping: where this fails, fewer bits fail as well."""
    names = [name for name in SIGNALS if getattr(settings.wire, name).bits is not None]
    least = {"damping_bound": min(settings.law.damping_bound, *_bounds(settings.law), settings.law.damping_bound)}
    smaller = _with_law(settings, settings.law.model_copy(update=least))
    return list(_with_any_bits(smaller, names))[-1][1] if names else smaller


def _by_bits(settings: Configured, holds: Holds) -> Iterator[Remedy]:
    quantized = [name for name in SIGNALS if getattr(settings.wire, name).bits is not None]
    choices = [[name] for name in quantized] + ([quantized] if len(quantized) > 1 else [])
    for names in choices:
        fewest = next((bits for bits, tried in _with_any_bits(settings, names) if holds(tried)), None)
        if fewest is not None:
            which = f"wire.{names[0]}" if len(names) == 1 else "all of them"
            yield Remedy(text=f"{fewest} bits for {which}", overrides=[f"wire.{name}.bits={fewest}" for name in names])


def _with_any_bits(settings: Configured, names: list[str]) -> Iterator[tuple[int, Configured]]:
    """The settings with every number of bits allowed for the signals named."""
    tree = settings.wire.model_dump()
    for bits in range(MIN_BITS, MAX_BITS + 1):
        for name in names:
            tree[name]["bits"] = bits
        try:
            wire = type(settings.wire).model_validate(tree)
        except ValueError:
            continue  # some kinds of quantizer need more bits
        yield bits, settings.model_copy(update={"wire": wire})


def _by_gains(settings: Configured, holds: Holds) -> Iterator[Remedy]:
    law = settings.law
    for name in GAINS:
        factor = _least_factor(lambda f, name=name: holds(_with_law(settings, scaled(law, {name: f}))))  # type: ignore[misc]
        if factor is not None and max(getattr(law, name)) * factor <= MAX_GAIN:
            yield _gains_remedy(law, {name: factor})


def _by_damping(settings: Configured, holds: Holds) -> Iterator[Remedy]:
    for bound in _bounds(settings.law):
        if holds(_with_law(settings, settings.law.model_copy(update={"damping_bound": bound}))):
            yield _damping_remedy("", bound, [])
            return


def _by_bits_and_damping(settings: Configured, holds: Holds) -> Iterator[Remedy]:
    quantized = [name for name in SIGNALS if getattr(settings.wire, name).bits is not None]
    for bound in _bounds(settings.law):
        smaller = _with_law(settings, settings.law.model_copy(update={"damping_bound": bound}))
        for bits, tried in _with_any_bits(smaller, quantized):
            if holds(tried):
                names = [f"wire.{name}.bits={bits}" for name in quantized]
                yield _damping_remedy(f"{bits} bits and ", bound, names)
                return


def _bounds(law: AdaptiveSettings) -> list[float]:
    """Smaller bounds of the damping that still hold the first estimate, the largest first."""
    least = hypot(*law.damping_estimate)
    tried = [_rounded(law.damping_bound, law.damping_bound * 0.85**n) for n in range(1, 25)]
    return [bound for bound in tried if bound >= least]


def _damping_remedy(also: str, bound: float, overrides: list[str]) -> Remedy:
    return Remedy(
        text=f"{also}law.damping_bound = {bound:g}, if ‖θ‖ is known to be within it",
        overrides=[*overrides, f"law.damping_bound={bound:g}"],
    )


def _with_law(settings: Configured, law: AdaptiveSettings) -> Configured:
    return settings.model_copy(update={"law": law})


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


def scaled(law: AdaptiveSettings, factors: dict[str, float]) -> AdaptiveSettings:
    """The law with some gains multiplied."""
    changed = {name: tuple(gain * factor for gain in getattr(law, name)) for name, factor in factors.items()}
    return law.model_copy(update=changed)


def _gains_remedy(law: AdaptiveSettings, factors: dict[str, float]) -> Remedy:
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

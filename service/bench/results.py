"""Results of the bench: measures items, keeps the figures as JSON, and compares them with those of an earlier run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from math import isfinite
from pathlib import Path
from subprocess import SubprocessError
from typing import Final, NamedTuple

from pydantic import BaseModel, Field, RootModel, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.bench.item import Item, Margin, NotMeasuredError

INTERRUPTED: Final = "interrupted"
"""Reason of what ^C left out."""


class BenchError(AeroloopError):
    """An item or an earlier run that is not there; one line with the reason."""


class Measured(BaseModel, frozen=True, extra="forbid"):
    """An item that was measured."""

    ours: float
    floor: float
    ratio: float = Field(description="ours over floor")
    aim: float | None = Field(description="the largest ratio wanted; null where there is none")
    unit: str = Field(description="of ours and floor")
    note: str = Field(default="", exclude=True, description="for the table")


class NotMeasured(BaseModel, frozen=True, extra="forbid"):
    """An item that was not."""

    ours: None = None
    floor: None = None
    ratio: None = None
    aim: float | None
    unit: str
    reason: str


class Results(RootModel[dict[str, Measured | NotMeasured]]):
    """Figures by the item's name, in the order of the table."""

    @property
    def interrupted(self) -> bool:
        """Whether ^C ended the run."""
        return any(isinstance(line, NotMeasured) and line.reason == INTERRUPTED for line in self.root.values())

    def ratios(self) -> dict[str, float]:
        """The ratios of what was measured."""
        return {name: line.ratio for name, line in self.root.items() if line.ratio is not None}


def chosen(items: Sequence[Item], words: Sequence[str]) -> list[Item]:
    """The items with these names, or in these groups; all if there are no words.

    Raises:
        BenchError: A word stands for no item.
    """
    for word in words:
        if not any(_is_in(item, word) for item in items):
            names = [item.name for item in items]
            alike = get_close_matches(word, {*names, *(name.partition("-")[0] for name in names)}, 1)
            hint = f"did you mean {alike[0]}?" if alike else f"there are {', '.join(names)}"
            raise BenchError(f"no item of the bench is called {word!r}; {hint}")
    return [item for item in items if not words or any(_is_in(item, word) for word in words)]


def _is_in(item: Item, word: str) -> bool:
    return f"{item.name}-".startswith(f"{word}-")


def measure(items: Sequence[Item], *, quick: bool, progress: Callable[[str], None] = lambda _: None) -> Results:
    """Measure items one after the other. One that fails costs no other; ^C ends with what is measured until then.

    `progress` is called with a line before each item, and with its figures after it.
    """
    found: dict[str, Measured | NotMeasured] = {}
    interrupted = False
    for item in items:
        try:
            if interrupted:
                raise NotMeasuredError(INTERRUPTED)
            if quick and not item.quick:
                raise NotMeasuredError("full runs only")
            progress(f"{item.name}: {item.what}")
            ours, floor, note = item.measure(quick)
            if not (isfinite(ours) and floor > 0):
                raise NotMeasuredError(f"{ours:g} over {floor:g}")
            figures = {"ours": _short(ours), "floor": _short(floor), "ratio": _short(ours / floor)}
            found[item.name] = Measured(aim=item.aim, unit=item.unit, note=note, **figures)
            progress(f"  {ours:.4g} / {floor:.4g} {item.unit} = {ours / floor:.3g}")
        except KeyboardInterrupt:
            interrupted = True
            found[item.name] = NotMeasured(aim=item.aim, unit=item.unit, reason=INTERRUPTED)
        except (AeroloopError, OSError, ValueError, SubprocessError) as error:  # such as a process that ended
            found[item.name] = NotMeasured(aim=item.aim, unit=item.unit, reason=str(error))
    return Results(found)


def _short(figure: float) -> float:
    """Four digits: no figure here is better than that."""
    return float(f"{figure:.4g}")


def read_results(path: Path) -> Results:
    """Results that `host bench --json` printed.

    Raises:
        BenchError: The file cannot be read, or holds something else.
    """
    try:
        return Results.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BenchError(f"cannot read {path}: {error.strerror}") from None
    except ValidationError:
        raise BenchError(f"{path} is not what `aeroloop host bench --json` prints") from None


class Change(NamedTuple):
    """An item in this run and in an earlier one.

    Attributes:
        name: Of the item.
        before: The earlier ratio; None if it was not measured.
        now: This run's; likewise.
        margin: Of the item.
    """

    name: str
    before: float | None
    now: float | None
    margin: Margin

    @property
    def limit(self) -> float | None:
        """The largest ratio that is not worse than the earlier one."""
        return None if self.before is None else self.margin.limit(self.before)

    @property
    def worse(self) -> bool:
        """Whether the ratio worsened beyond its margin; an item that one of the runs lacks has not."""
        return self.now is not None and self.limit is not None and self.now > self.limit

    def __str__(self) -> str:
        return (
            f"{self.name} is worse: its ratio is {self.now:.2f}, was {self.before:.2f}, and may be {self.limit:.2f} "
            f"({self.margin.why})"
        )


def compared(now: Results, before: Results, items: Sequence[Item]) -> list[Change]:
    """These items in both runs."""
    new, old = now.ratios(), before.ratios()
    return [Change(item.name, old.get(item.name), new.get(item.name), item.margin) for item in items]

"""Axes of a sweep: `--vary` as text, and every combination of its values as a configuration with a name.

Values are given as `--set` takes them, so an error in one reads as any error of the configuration. All combinations are
checked before the first experiment runs.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Sequence
from fractions import Fraction
from hashlib import sha256
from inspect import getfile
from itertools import product
from math import prod
from os.path import expanduser, isfile
from pathlib import Path
from typing import Any, Final, NamedTuple

from aeroloop.plant_emulator.plant import EMULATED, class_of
from aeroloop.service.config import ConfigError, Settings, load_over
from aeroloop.service.control.laws.registry import BUILT_IN, CustomLawSettings, law_class

LIMIT: Final = 10_000_000
"""Experiments of a sweep, at most: what fits into memory."""
SECTIONS: Final = ("law", "loop", "plant", "reference", "wire")
"""Sections of the configuration that an experiment depends on."""
_NUMBER: Final = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,2})?"
_RANGE: Final = re.compile(rf"({_NUMBER})\.\.({_NUMBER})\*(\d+)")


class Axis(NamedTuple):
    """A key of the configuration and its values, as `--set` takes them.

    With a `*` at its end, such as `law.C2*`, the values are factors of what is configured.
    """

    key: str
    values: tuple[str, ...]


class Configuration(NamedTuple):
    """One combination."""

    overrides: tuple[str, ...]  # of the sweep's configuration
    values: tuple[Any, ...]  # of the axes, as the configuration has them; text where it has a section or a list
    digest: str


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """Axes of `section.key=a,b,c` or `section.key=a..b*n`, n values evenly from a to b; `section.key*=` has factors.

    Raises ConfigError for neither of them, no value, or a key that stands twice or that no experiment depends on.
    """
    axes = dict[str, Axis]()
    for axis in map(_axis, texts):
        key = axis.key.removesuffix("*")
        if key in axes:
            raise ConfigError(f"--vary gives {key} twice: put all its values into one")
        if key in ("plant.wind.seed", "plant.sensors.seed"):
            raise ConfigError(f"--vary {key}: --seeds sets it")
        if key.partition(".")[0] not in SECTIONS:
            raise ConfigError(f"--vary {key}: an experiment depends on {', '.join(SECTIONS)} only")
        axes[key] = axis
    return list(axes.values())


def _axis(text: str) -> Axis:
    key, equals, values = map(str.strip, text.partition("="))
    if not (key and equals and values):
        raise ConfigError(f"--vary takes section.key=a,b,c or section.key=a..b*n, not {text!r}")
    try:  # values as in a list of TOML, which may themselves be lists, or strings with commas
        listed = tomllib.loads(f"values = [{values}]")["values"]
    except tomllib.TOMLDecodeError:
        return Axis(key, tuple(each for part in values.split(",") for each in _spread(part.strip(), text)))
    return Axis(key, tuple(json.dumps(value, ensure_ascii=False, default=str) for value in listed))


def _spread(part: str, text: str) -> list[str]:
    """The values of a range, exact in decimals and whole where both ends are; or the one value that stands there."""
    if not part:
        raise ConfigError(f"--vary {text}: a value is missing")
    if not re.match(rf"{_NUMBER}\.\.", part):
        return [part]
    found = _RANGE.fullmatch(part)
    if found is None or not 2 <= int(found[3]) <= LIMIT or Fraction(found[1]) == Fraction(found[2]):
        raise ConfigError(f"--vary {text}: a range is a..b*n, of n values from 2 to {LIMIT}, not {part!r}")
    low, high, last = Fraction(found[1]), Fraction(found[2]), int(found[3]) - 1
    whole = all(re.fullmatch(r"[+-]?\d+", end) for end in (found[1], found[2]))
    values = (low + (high - low) * i / last for i in range(last + 1))
    return [str(int(value)) if whole and value.denominator == 1 else repr(float(value)) for value in values]


def configurations(settings: Settings, axes: Sequence[Axis], seeds: int, duration_s: float) -> list[Configuration]:
    """Every combination of the axes' values, the last axis fastest.

    Raises ConfigError if one is no configuration, two are the same, or they are too many.
    """
    total = prod(len(axis.values) for axis in axes) * seeds
    if total > LIMIT:
        raise ConfigError(f"these are {total} experiments; a sweep has at most {LIMIT}")
    configured, found = settings.description(), dict[str, Configuration]()
    for values in product(*(axis.values for axis in axes)):
        pairs = [(axis.key, value) for axis, value in zip(axes, values, strict=True)]
        overrides = tuple(_scaled(configured, *pair) if pair[0].endswith("*") else "=".join(pair) for pair in pairs)
        description = load_over(settings, overrides).description()
        columns = tuple(_column(description, *pair) for pair in pairs)
        digest = digest_of(description, duration_s)
        if digest in found:
            first, second = (" ".join(each) or "the configuration" for each in (found[digest].overrides, overrides))
            raise ConfigError(f"--vary gives the same twice: {first} and {second}")
        found[digest] = Configuration(overrides, columns, digest)
    return list(found.values())


def _scaled(configured: dict[str, Any], key: str, factor: str) -> str:
    """The override that multiplies a configured number, or every number of a list."""
    name = key.removesuffix("*").strip()
    try:
        return f"{name}={json.dumps(_times(_value(configured, name), float(factor)))}"
    except (ValueError, TypeError):
        raise ConfigError(f"--vary {key}={factor}: factors are numbers, of a number or a list of numbers") from None


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, list | tuple):
        return [_times(each, factor) for each in value]
    return float(value) * factor


def _value(description: dict[str, Any], key: str) -> Any:
    value: Any = description
    for name in key.split("."):
        value = value[name] if isinstance(value, dict) and name in value else None
    return value


def _column(description: dict[str, Any], key: str, given: str) -> Any:
    if key.endswith("*"):
        return float(given)
    value = _value(description, key)
    return given if isinstance(value, dict | list) else value


def digest_of(description: dict[str, Any], duration_s: float) -> str:
    """SHA-256 of what an experiment depends on but for the seed, however it was configured.

    Of a law or a plant of one's own, the file of its class is part of it, and each file that `plant.own` names, such as
    an MJCF or FMU; what these import is not. Raises PluginError if there is no such class.
    """
    parts: dict[str, Any] = {name: description[name] for name in SECTIONS}
    law, plant = CustomLawSettings.model_validate(description["law"]), description["plant"]
    files = list[str]()
    if law.kind not in BUILT_IN:
        files.append(getfile(law_class(law)))
    if plant["kind"] not in EMULATED:
        named = (value for value in plant["own"].values() if isinstance(value, str | Path))
        files += [getfile(class_of(plant["kind"])), *filter(isfile, map(expanduser, named))]
    parts["files"] = [sha256(Path(file).read_bytes()).hexdigest() for file in files]
    parts["plant"] = plant | {name: {**plant[name], "seed": None} for name in ("wind", "sensors")}
    canonical = json.dumps({**parts, "duration_s": duration_s}, sort_keys=True, separators=(",", ":"))
    return sha256(canonical.encode()).hexdigest()

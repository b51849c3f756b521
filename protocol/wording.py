"""Wording: a validation error as a sentence that names the key, says what it must be, and shows what it was given.

pydantic's own texts are for programmers. Here the sentence follows from the JSON schema of the model that refused: the
schema at the error's place says what the value must be, whatever pydantic has found.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from difflib import SequenceMatcher
from functools import cache
from typing import Any, Final

from pydantic import BaseModel, ValidationError

Shape = dict[str, Any]
"""A node of a JSON schema."""

SHOWN: Final = 60
"""Characters of a refused value that are shown."""

_ALIKE: Final = 0.6
"""Likeness of two keys, 0…1, above which one may be a slip of the other: `C3` for `C1` in the same section is 0.67."""

_COUNTS: Final = ("no", "one", "two", "three", "four", "five", "six")


class Shapes:
    """The JSON schema of a model, read by key.

    Attributes:
        root: The model's own node.
    """

    def __init__(self, model: type[BaseModel]) -> None:
        self.root = _schema(model)

    def resolved(self, shape: Shape) -> Shape:
        """The node that a reference stands for, also one that may be null, under the referring field's description."""
        references = [each for each in shape.get("anyOf", []) if "$ref" in each]
        if len(references) == 1:
            shape = {**references[0], **{name: value for name, value in shape.items() if name != "anyOf"}}
        if "$ref" not in shape:
            return shape
        target = self.root["$defs"][shape["$ref"].rpartition("/")[2]]
        return {**target, **{name: value for name, value in shape.items() if name != "$ref"}}

    def kinds(self, shape: Shape) -> dict[str, Shape]:
        """By `kind`, the sections that may stand here; empty unless there are several."""
        choices = [shape, *shape.get("anyOf", [])]  # the latter where it may be null
        mapping: dict[str, str] = next(
            (each["discriminator"]["mapping"] for each in choices if "discriminator" in each), {}
        )
        return {kind: self.resolved({"$ref": ref}) for kind, ref in mapping.items()}

    def fields(self, shape: Shape) -> dict[str, Shape]:
        """The fields of a section, of all its kinds together."""
        found: dict[str, Shape] = {}
        for each in self.kinds(shape).values() or [shape]:
            found |= {name: self.resolved(field) for name, field in each.get("properties", {}).items()}
        return found

    def every_key(self, shape: Shape | None = None, prefix: str = "") -> Iterator[tuple[str, Shape]]:
        """Every section and key of the model, `section.key`, with its node."""
        for name, field in self.fields(self.root if shape is None else shape).items():
            yield f"{prefix}{name}", field
            yield from self.every_key(field, f"{prefix}{name}.")

    def at(self, place: Sequence[str | int]) -> tuple[str, Shape]:
        """The key of an error's place, and its node: an empty one if the schema does not say what belongs there."""
        key, shape = "", self.root
        for part in place:
            if isinstance(part, int):
                items = shape.get("prefixItems", [])
                shape = self.resolved(items[part] if part < len(items) else shape.get("items", {}))
                key = f"element {part + 1} of {key}"
            elif part in (kinds := self.kinds(shape)):
                shape = kinds[part]
            else:
                shape = self.fields(shape).get(part, {})
                key = f"{key}.{part}" if key else part
        return key, shape


@cache
def _schema(model: type[BaseModel]) -> Shape:
    return model.model_json_schema()


def words(shape: Shape) -> str:
    """What a value must be, such as `a number from 1 to 10000`; empty if anything will do."""
    if choices := shape.get("enum", [shape["const"]] if "const" in shape else []):
        return either([_shown(choice) for choice in choices])
    if kinds := shape.get("discriminator", {}).get("mapping"):
        return f"a section whose kind is {either([_shown(kind) for kind in kinds])}"
    if options := shape.get("anyOf"):
        return either([words(option) for option in options if option.get("type") != "null"])
    match shape.get("type"):
        case "number" | "integer" as kind:
            return f"a{' whole' * (kind == 'integer')} number{_bounds(shape)}"
        case "boolean":
            return "true or false"
        case "string":
            if "pattern" in shape:
                return f"a string of the form {shape['pattern'].strip('^$')}"
            return "a path" if shape.get("format") == "path" else "a string"
        case "array":
            return _elements(shape)
        case "object":
            return "a section"
    return ""


def problems(error: ValidationError, *models: type[BaseModel]) -> list[str]:
    """What is wrong, a sentence for each error.

    Args:
        error: From one of the models.
        models: Found by its name; the last one if the name is another.
    """
    model = next((each for each in models if each.__name__ == error.title), models[-1])
    shapes = Shapes(model)
    return [_problem(shapes, dict(each)) for each in error.errors(include_url=False)]


def problem(error: ValidationError, model: type[BaseModel]) -> str:
    """What is wrong first: a sentence for one error, however many there are. The error is from the model."""
    return _problem(Shapes(model), dict(error.errors(include_url=False)[0]))


def closest(key: str, known: Iterable[str]) -> str | None:
    """The known key that is most like an unknown one: in its last part and in its section. None if none is."""
    section, _, name = key.rpartition(".")
    best, found = _ALIKE, None
    for other in known if len(key) <= 2 * SHOWN else ():
        its_section, _, its_name = other.rpartition(".")
        likeness = _likeness(name, its_name)
        if section:
            likeness = (2 * likeness + _likeness(section, its_section)) / 3
        if other == key:
            return None
        if likeness > best:
            best, found = likeness, other
    return found


def _likeness(one: str, other: str) -> float:
    return SequenceMatcher(None, one.lower(), other.lower()).ratio()


def _problem(shapes: Shapes, error: dict[str, Any]) -> str:
    place, kind, given = error["loc"], error["type"], error["input"]
    key, shape = shapes.at(place)
    if kind == "extra_forbidden":
        return _unknown(shapes, place, key)
    if kind in ("value_error", "assertion_error"):
        text = str(error["ctx"]["error"])
        named = isinstance(given, dict | BaseModel)  # of a section the text names the values
        named |= isinstance(given, list) and any(isinstance(each, str) and each in text for each in given)
        joint = " " if text.startswith("must ") else ": "
        return f"{key}{joint if key else ''}{text}{'' if named else f', not {_shown(given)}'}"
    if kind == "json_invalid":
        return f"{key}: it is not JSON" if key else "it is not JSON"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        expected = either([_shown(kind) for kind in shapes.kinds(shape)])
        tag = error["ctx"].get("tag")
        return f"{key}.kind must be {expected}{'' if tag is None else f', not {_shown(tag)}'}"
    expected = words(shape) or "another value"
    if kind == "finite_number":
        expected = expected.replace("number", "finite number", 1)
    if kind == "missing":
        return f"{key} is missing: it must be {expected}"
    return f"{key or 'it'} must be {expected}, not {_shown(given)}"


def _unknown(shapes: Shapes, place: Sequence[str | int], key: str) -> str:
    if len(key) > SHOWN or not key.isprintable():  # the line stays one line, and no search for what is like it
        key = _shown(key)
    found = closest(key, (name for name, _ in shapes.every_key()))
    if found is not None:
        return f"unknown key {key}: did you mean {found}?"
    within, section = shapes.at(place[:-1])
    return f"unknown key {key}; {within or 'a configuration'} has {', '.join(shapes.fields(section))}"


def _bounds(shape: Shape) -> str:
    low, high = shape.get("minimum"), shape.get("maximum")
    above, below = shape.get("exclusiveMinimum"), shape.get("exclusiveMaximum")
    if low is not None and above is high is below is None:
        return f" from {low:g} up"
    limits = (("from", low), ("above", above), ("to" if low is not None else "up to", high), ("below", below))
    return "".join(f" {sign} {bound:g}" for sign, bound in limits if bound is not None)


def _elements(shape: Shape) -> str:
    if items := shape.get("prefixItems"):
        return f"{_COUNTS[len(items)]} {_many(words(items[0]), items[0])}"
    least, most = shape.get("minItems"), shape.get("maxItems")
    limit = "" if most is None else f"{least} to {most} " if least else f"up to {most} "
    return f"a list of {limit}{_many(words(shape.get('items', {})), shape.get('items', {}))}"


def _many(one: str, shape: Shape) -> str:
    """The plural of what `words` gives."""
    if shape.get("type") == "array":
        return f"lists of {one.removeprefix('a list of ')}"
    plural, found = re.subn(r"^a (whole number|number|path|section|string)", r"\1s", one)
    return plural if found else f"values, each {one}" if one else "values"


def either(options: Sequence[str]) -> str:
    """Choices in words: `a, b or c`."""
    *most, last = dict.fromkeys(options) or [""]
    return f"{', '.join(most)} or {last}" if most else last


def _shown(value: object) -> str:
    """A value as TOML or JSON has it, shortened."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):
        text = repr(value)
    text = " ".join(text.split())
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}…"

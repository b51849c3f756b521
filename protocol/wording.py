"""Wording: a validation error as one line, in pydantic's own words, with the key and what was given."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from typing import Any, Final, get_args

from pydantic import BaseModel, BeforeValidator, ValidationError
from pydantic.fields import FieldInfo

from aeroloop.protocol.printable import printable

SHOWN: Final = 60  # characters of a refused value or an unknown key
_SAID: Final = 600  # characters of pydantic's words, which may quote what was given


def keys(model: type[BaseModel], section: str = "") -> dict[str, FieldInfo]:
    """Every section and key of a model, `section.key`; of a section of several kinds, those of all of them."""
    found: dict[str, FieldInfo] = {}
    for name, field in model.model_fields.items():
        found[f"{section}{name}"] = field
        for each in (field.annotation, *field.metadata):
            for inner in _models(each):
                found |= keys(inner, f"{section}{name}.")
    return found


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models in an annotation, and in what a validator in it takes."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    inner = (annotation.json_schema_input_type,) if isinstance(annotation, BeforeValidator) else get_args(annotation)
    for each in inner:
        yield from _models(each)


def closest(key: str, known: Iterable[str]) -> str | None:
    """The known key that is most like an unknown one; None if none is like it, or if it is too long for any."""
    lowered = {each.lower(): each for each in known} if len(key) <= 2 * SHOWN else {}
    return next((lowered[each] for each in get_close_matches(key.lower(), lowered, n=1, cutoff=0.7)), None)


def problems(error: ValidationError, *models: type[BaseModel]) -> Iterator[str]:
    """What is wrong, a line for each key; `models` are those that the error may be from."""
    known, seen = {key for model in models for key in keys(model)}, set[str]()
    for each in error.errors(include_url=False):
        unknown = each["type"] == "extra_forbidden"
        shown, path = "", ""
        for part in each["loc"]:  # a union's parts name its kinds, too, which are no keys
            if isinstance(part, int):
                shown += f"[{part}]"
            elif f"{path}.{part}".strip(".") in known or (unknown and part is each["loc"][-1]):
                shown, path = f"{shown}.{part}".strip("."), f"{path}.{part}".strip(".")
        if shown in seen:
            continue
        seen.add(shown)
        if unknown and shown not in known:
            near = closest(shown, known)
            yield f"unknown key {_line(shown, SHOWN)}" + (f": did you mean {near}?" if near else "")
        elif unknown:
            yield f"{shown} is no key of this kind"
        else:
            said = _line(each["msg"].removeprefix("Value error, ").removeprefix("Input "), _SAID)
            value = json.dumps(each["input"], ensure_ascii=False, default=repr, skipkeys=True)
            of_whole = each["type"] in ("missing", "json_invalid") or isinstance(each["input"], dict | BaseModel)
            yield f"{shown}: {said}".removeprefix(": ") + ("" if of_whole else f", not {_line(value, SHOWN)}")


def problem(error: ValidationError, *models: type[BaseModel]) -> str:
    """What is wrong first: one line, however many errors there are."""
    return next(problems(error, *models))


def _line(text: str, length: int) -> str:
    """A text as one printable line, shortened."""
    shown = printable(text[:length])
    return shown if len(text) <= length else f"{shown}…"

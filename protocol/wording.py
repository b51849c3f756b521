"""Wording: a validation error as one line, in pydantic's own words, with the key and what was given."""

from __future__ import annotations

import json
from collections.abc import Collection, Container, Iterable, Iterator
from difflib import get_close_matches
from itertools import groupby
from typing import Any, Final, get_args

from pydantic import BaseModel, BeforeValidator, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

SHOWN: Final = 60  # characters of a refused value or an unknown key
_SAID: Final = 600  # characters of pydantic's words, which may quote what was given
_PLAIN: Final = {"missing": "is missing", "model_type": "should be a section", "tuple_type": "should be a list"}


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
    """The known key that is most like an unknown one, first in its last part; None if none is."""
    by_name: dict[str, list[str]] = {}
    for each in known if len(key) <= 2 * SHOWN else ():
        by_name.setdefault(each.rpartition(".")[2].lower(), []).append(each)
    near = get_close_matches(key.rpartition(".")[2].lower(), by_name)
    lowered = {each.lower(): each for name in near for each in by_name[name]}
    return next((lowered[each] for each in get_close_matches(key.lower(), lowered, n=1, cutoff=0.0)), None)


def problems(error: ValidationError, *models: type[BaseModel]) -> Iterator[str]:
    """What is wrong, a line for each key; `models` are those that the error may be from."""
    known = {key for model in models for key in keys(model)}
    for key, errors in groupby(error.errors(include_url=False), lambda each: _key(each, known)):
        first, *others = errors
        if first["type"] == "extra_forbidden":
            yield _unknown(key, known)
            continue
        said = " or ".join(dict.fromkeys(_said(each) for each in (first, *others)))
        given = first["input"]
        of_whole = first["type"] in ("missing", "json_invalid") or isinstance(given, dict | BaseModel)
        yield f"{key}: {said}".removeprefix(": ") + (
            "" if of_whole else f", not {_line(json.dumps(given, ensure_ascii=False, default=repr), SHOWN)}"
        )


def problem(error: ValidationError, *models: type[BaseModel]) -> str:
    """What is wrong first: one line, however many errors there are."""
    return next(problems(error, *models))


def _key(error: ErrorDetails, known: Container[str]) -> str:
    """The key of an error, such as `faults[2].kind`, without what pydantic adds for a union."""
    kind, place = error["type"], error["loc"]
    shown, path = "", ""
    for part in place[:-1] if kind == "extra_forbidden" else place:
        if isinstance(part, int):
            shown += f"[{part}]"
        elif (inner := f"{path}.{part}".removeprefix(".")) in known:
            shown, path = f"{shown}.{part}".removeprefix("."), inner
    last = place[-1] if kind == "extra_forbidden" else "kind" if kind.startswith("union_tag") else ""
    return f"{shown}.{last}".strip(".")


def _unknown(key: str, known: Collection[str]) -> str:
    if key in known:
        return f"{key} is no key of this kind"
    found = closest(key, known)
    return f"unknown key {_line(key, SHOWN)}" + (f": did you mean {found}?" if found else "")


def _said(error: ErrorDetails) -> str:
    said = _PLAIN.get(error["type"]) or error["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return _line(said, _SAID)


def _line(text: str, length: int) -> str:
    """A text as one printable line, shortened."""
    shown = "".join(character if character.isprintable() else " " for character in text[:length])
    return shown if len(text) <= length else f"{shown}…"

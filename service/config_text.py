"""Text of a configuration: TOML that loads to the same settings, with a comment on every key, or without."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from textwrap import wrap
from typing import Any, Final

from aeroloop.protocol.wording import Shape, Shapes, either, words

WIDTH: Final = 100
"""Columns of a comment and of a list in one line."""

_EVIDENT: Final = ("", "true or false", "a string", "a path", "a list of strings")


def toml(tree: dict[str, Any], shapes: Shapes | None = None) -> str:
    """A configuration as TOML.

    Args:
        tree: The description of the settings.
        shapes: Of the settings' model: then a comment gives each key's description with its unit, and its bounds.
    """
    return "\n".join(_section(tree, "", shapes, shapes.root if shapes else {})).strip() + "\n"


def _section(tree: dict[str, Any], path: str, shapes: Shapes | None, shape: Shape) -> Iterator[str]:
    kinds = shapes.kinds(shape) if shapes else {}
    if shapes is not None and kinds:
        shape = {**kinds[tree["kind"]], "description": shape.get("description", "")}
    fields = shapes.fields(shape) if shapes else {}
    if path:
        yield ""
        yield from _comment(shape.get("description", ""))
        yield f"[{path}]"
    for name, value in tree.items():
        if isinstance(value, dict):
            continue
        field = fields.get(name, {})
        expected = either(list(map(json.dumps, kinds))) if kinds and name == "kind" else words(field)
        bounds = "" if expected in _EVIDENT else f" ({expected})"
        yield from _comment(field.get("description", "") + bounds)
        if value is not None or name == "bits":
            yield f"{_key(name)} = {_value('cont' if value is None else value)}"  # TOML has no null
        elif shapes:
            yield f"# {name} = (not set)"
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _section(value, f"{path}.{_key(name)}".removeprefix("."), shapes, fields.get(name, {}))


def _comment(text: str) -> list[str]:
    return wrap(" ".join(text.split()), WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)


def _value(value: Any) -> str:
    if isinstance(value, list):
        items = [_value(item) for item in value]
        line = f"[{', '.join(items)}]"
        return line if len(line) <= WIDTH else "[\n    " + ",\n    ".join(items) + ",\n]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{_key(name)} = {_value(item)}' for name, item in value.items())} }}"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")

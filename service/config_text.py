"""Text of a configuration: TOML that loads to the same settings, with a comment on every key, or without."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from textwrap import wrap
from typing import Any, Final

from pydantic import BaseModel

WIDTH: Final = 100
"""Columns of a comment and of a list in one line."""

_BOUNDS: Final = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}


def toml(tree: dict[str, Any], settings: BaseModel | None = None) -> str:
    """A configuration as TOML.

    Args:
        tree: The description of the settings.
        settings: What it describes: then a comment gives each key's description with its unit, and its bounds.
    """
    return "\n".join(_section(tree, "", settings, {})).strip() + "\n"


def _section(tree: dict[str, Any], path: str, settings: object, node: dict[str, Any]) -> Iterator[str]:
    """Lines of a section; `settings` is its model's instance, `node` describes it in the JSON schema of its parent."""
    nodes = type(settings).model_json_schema()["properties"] if isinstance(settings, BaseModel) else {}
    if path:
        yield ""
        yield from _comment(node.get("description", ""))
        yield f"[{path}]"
    for name, value in tree.items():
        if isinstance(value, dict):
            continue
        kinds = node.get("discriminator", {}).get("mapping", ()) if name == "kind" else ()
        bounds = expected({"enum": list(kinds)} if kinds else nodes.get(name, {}))
        yield from _comment(nodes.get(name, {}).get("description", "") + (f" ({bounds})" if bounds else ""))
        if value is not None or name == "bits":
            yield f"{_key(name)} = {_value('cont' if value is None else value)}"  # TOML has no null
        elif nodes:
            yield f"# {name} = (not set)"
    for name, value in tree.items():
        if isinstance(value, dict):
            inner = f"{path}.{_key(name)}".removeprefix(".")
            yield from _section(value, inner, getattr(settings, name, None), nodes.get(name, {}))


def expected(node: dict[str, Any]) -> str:
    """What a JSON schema's node allows, such as `number from 1 to 10000`; empty where the description says enough."""
    if choices := node.get("enum", [node["const"]] if "const" in node else []):
        return " or ".join(map(json.dumps, choices))
    if options := node.get("anyOf"):
        return " or ".join(filter(None, map(expected, options)))
    match node.get("type"):
        case "number" | "integer" as kind:
            limits = [f" {word} {node[bound]:g}" for bound, word in _BOUNDS.items() if bound in node]
            return ("whole " if kind == "integer" else "") + "number" + "".join(limits)
        case "string" if "pattern" in node:
            return f"string of the form {node['pattern'].strip('^$')}"
        case "array":
            items = node.get("prefixItems") or [node.get("items", {})]
            inner = expected(items[0])
            most = len(items) if "prefixItems" in node else node.get("maxItems")
            least = node.get("minItems", 0)
            count = "list of" if most is None else f"{most} ×" if most == least else f"{least} to {most} ×"
            return f"{count} {inner}" if inner else ""
    return ""


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

"""Text of a configuration: TOML that loads to the same settings, with a comment on every key, or without."""

from __future__ import annotations

import json
from textwrap import wrap
from typing import Any, Final

import tomlkit
from pydantic import BaseModel
from tomlkit.items import Table

WIDTH: Final = 100
"""Columns of a comment and of a list in one line."""

_BOUNDS: Final = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}


def toml(tree: dict[str, Any], settings: BaseModel | None = None) -> str:
    """A description of settings as TOML; with the settings, a comment gives each key's meaning, unit and bounds."""
    document = tomlkit.document()
    _fill(document, tree, settings, {})
    return tomlkit.dumps(document).strip() + "\n"


def _fill(table: tomlkit.TOMLDocument | Table, tree: dict[str, Any], settings: object, node: dict[str, Any]) -> None:
    """Put a section into a table; `settings` is its model, `node` describes it in the JSON schema of its parent."""
    nodes = type(settings).model_json_schema()["properties"] if isinstance(settings, BaseModel) else {}
    for name, value in tree.items():
        if isinstance(value, dict):
            continue
        kinds = node.get("discriminator", {}).get("mapping", ()) if name == "kind" else ()
        bounds = expected({"enum": list(kinds)} if kinds else nodes.get(name, {}))
        _comment(table, nodes.get(name, {}).get("description", "") + (f" ({bounds})" if bounds else ""))
        if value is not None or name == "bits":
            table.add(name, _item("cont" if value is None else value))  # TOML has no null
        elif nodes:
            table.add(tomlkit.comment(f"{name} = (not set)"))
    for name, value in tree.items():
        if isinstance(value, dict):
            inner = tomlkit.table()
            if description := nodes.get(name, {}).get("description"):
                _comment(inner, description)
                inner.add(tomlkit.nl())
            _fill(inner, value, getattr(settings, name, None), nodes.get(name, {}))
            table.add(name, inner)


def expected(node: dict[str, Any]) -> str:
    """What a JSON schema's node allows, such as `number from 1 to 10000`; empty where the description says enough."""
    if choices := node.get("enum", [node["const"]] if "const" in node else []):
        return " or ".join(map(json.dumps, choices))
    if options := node.get("anyOf"):
        return " or ".join(filter(None, map(expected, options)))
    kind = node.get("type")
    if kind in ("number", "integer"):
        limits = [f" {word} {node[bound]:g}" for bound, word in _BOUNDS.items() if bound in node]
        return ("whole " if kind == "integer" else "") + "number" + "".join(limits)
    if (items := node.get("prefixItems")) and (inner := expected(items[0])):
        return f"{len(items)} × {inner}"
    return f"string of the form {node['pattern'].strip('^$')}" if "pattern" in node else ""


def _comment(table: tomlkit.TOMLDocument | Table, text: str) -> None:
    for line in wrap(" ".join(text.split()), WIDTH - 2, break_on_hyphens=False):
        table.add(tomlkit.comment(line))


def _item(value: Any) -> Any:
    item = tomlkit.item(value)
    return item.multiline(multiline=True) if isinstance(value, list) and len(item.as_string()) > WIDTH else item

"""Messages section of SPEC.md, from the models: `uv run python -m tests.protocol.spec_messages` writes it anew."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from aeroloop.protocol.messages import models, operator, topics, trace

SPEC: Final = Path("protocol/SPEC.md")
BEGIN, END = "<!-- messages, written by tests/protocol/spec_messages.py -->\n", "<!-- end of messages -->\n"
ANSWERS: Final[tuple[type[BaseModel], ...]] = (models.Grant, models.Refusal, operator.Answer, trace.Tail)
"""Models that no row of the topics names, and no other message has within it."""


def section() -> str:
    """A table for each message, and for what stands within others: field, JSON type, what it is."""
    schemas: dict[str, dict[str, Any]] = {}
    for model in (*(topic.model for topic in topics.TOPICS.values()), *ANSWERS):
        if model is not None:
            schema = model.model_json_schema()
            parts = {name: part for name, part in schema.get("$defs", {}).items() if "enum" not in part}
            schemas |= {model.__name__: schema} | parts
    return "\n".join(_table(name, schemas[name]) for name in sorted(schemas))


def _table(name: str, schema: dict[str, Any]) -> str:
    about = " ".join(schema.get("description", "").split("\n\n")[0].split())
    rows = [
        f"| `{field}` | {_type(shape)} | {_default(field, shape, schema)} | {shape.get('description', '')} |"
        for field, shape in schema.get("properties", {}).items()
    ]
    if schema.get("additionalProperties"):
        rows.append(f"| any other | {_type(schema['additionalProperties'])} | may be left out | |")
    if not rows:
        return f"**{name}.** {about} It has no fields.\n"
    head = f"**{name}.** {about}\n\n| field | type | if left out | what it is |\n|---|---|---|---|\n"
    return head + "\n".join(rows).replace("|  |", "| |") + "\n"


def _default(name: str, field: dict[str, Any], schema: dict[str, Any]) -> str:
    if name in schema.get("required", []):
        return "refused"
    return "empty" if "default" not in field else f"`{json.dumps(field['default'])}`"


def _type(shape: dict[str, Any]) -> str:
    if "$ref" in shape:
        return str(shape["$ref"]).rpartition("/")[2]
    if options := shape.get("anyOf", shape.get("oneOf")):
        return " or ".join(dict.fromkeys(_type(option) for option in options))
    if "const" in shape:
        return f"`{json.dumps(shape['const'])}`"
    if "enum" in shape:
        return ", ".join(f"`{choice}`" for choice in shape["enum"])
    kind = shape.get("type", "any")
    if kind == "array":
        items = shape.get("prefixItems")
        return f"[{', '.join(_type(item) for item in items)}]" if items else f"list of {_type(shape.get('items', {}))}"
    if kind == "object" and isinstance(shape.get("additionalProperties"), dict):
        return f"object of {_type(shape['additionalProperties'])}"
    bounds = [f"{sign} {shape[key]:g}" for key, sign in _BOUNDS.items() if key in shape]
    longest = [f"at most {shape['maxLength']} characters"] if "maxLength" in shape else []
    form = [f"`{shape['pattern']}`".replace("|", "\\|")] if "pattern" in shape else []
    return " ".join([kind, *([", ".join([*bounds, *longest, *form])] if bounds or longest or form else [])])


_BOUNDS: Final = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


if __name__ == "__main__":
    text = SPEC.read_text()
    before, after = text.partition(BEGIN)[0], text.partition(END)[2]
    SPEC.write_text(f"{before}{BEGIN}{section()}{END}{after}")

"""Setup of the runs: differences, every key of the configuration, and facts about software and host."""

from __future__ import annotations

from collections.abc import Sequence
from json import dumps
from typing import Any

from aeroloop.service.report.page.markup import Html, joined, tag
from aeroloop.service.report.page.verdict import run_name
from aeroloop.service.review.report import Report, differences, flat


def differing(reports: Sequence[Report]) -> Html:
    """Keys whose value is not the same in every run."""
    if rows := differences(reports):
        return _keys(reports, rows, "")
    return tag("p", "Nothing: the configurations are the same.", class_="quiet")


def shown(value: Any) -> str:
    """A value as the configuration writes it: `true`, `"text"`, `[1, 2]`; None is a dash."""
    if value is None:
        return "–"
    return value if isinstance(value, str) else dumps(value, ensure_ascii=False, default=str)


def sections(reports: Sequence[Report], tables: Sequence[dict[str, Any]]) -> Html:
    """Every key of each run's nested tables, in a searchable table per section."""
    keys_of: dict[str, dict[str, None]] = {}
    flattened = [flat(table) for table in tables]
    for keys in flattened:
        for key in keys:
            section, dot, _ = key.partition(".")
            keys_of.setdefault(section if dot else "", {})[key] = None
    if not keys_of:
        return tag("p", "Not in the log.", class_="quiet")
    parts = []
    for section, found in sorted(keys_of.items()):
        rows = [(key, [keys.get(key) for keys in flattened]) for key in found]
        prefix = f"{section}." if section else ""
        count = tag("span", f"{len(rows)} key{'s' * (len(rows) > 1)}", class_="quiet")
        title = tag("summary", section or "general", count)
        parts.append(tag("details", title, _keys(reports, rows, prefix), class_="keys"))
    return joined(parts)


def _keys(reports: Sequence[Report], rows: Sequence[tuple[str, Sequence[Any]]], prefix: str) -> Html:
    several = len(reports) > 1
    head = tag("thead", tag("tr", tag("th", "Key"), [
        tag("th", run_name(report, index, len(reports))) for index, report in enumerate(reports)
    ])) if several else None  # fmt: skip
    body = []
    for key, values in rows:
        differs = several and any(value != values[0] for value in values)
        cells = [tag("td", shown(value)) for value in values]
        name = tag("th", tag("code", key.removeprefix(prefix)), scope="row", title=key)
        body.append(tag("tr", name, cells, data_key=key.lower(), class_="differs" if differs and prefix else None))
    return tag("div", tag("table", head, tag("tbody", body)), class_="scroll")

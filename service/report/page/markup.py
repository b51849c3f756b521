"""HTML builder that escapes every text, except markup that `tag` itself returned."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Final

from aeroloop.service.report.rows import seconds

VOID: Final = frozenset({"br", "col", "hr", "img", "input", "link", "meta"})
"""Elements without an end tag."""


class Html(str):
    """Text that is markup already."""

    __slots__ = ()


Child = str | Iterable["Html | str"] | None


def tag(name: str, *children: Child, **attributes: str | float | bool | None) -> Html:
    """An element, of children that are markup, text to be escaped, or several of them; None is nothing.

    Attributes are such as `class_="number"` or `data_time=1.5`; True gives a bare one, False and None none.
    """
    inside = "".join(_markup(child) for child in children)
    start = "".join([name, *(_attribute(key, value) for key, value in attributes.items())])
    return Html(f"<{start}>" if name in VOID else f"<{start}>{inside}</{name}>")


def joined(parts: Iterable[Html | str]) -> Html:
    """Several pieces of markup or text as one."""
    return Html("".join(_markup(part) for part in parts))


def jump(time_s: float, run: int, what: str) -> Html:
    """A button that moves every time axis to a time of a run."""
    shown = seconds(time_s)
    return tag("button", shown, type="button", class_="jump", data_time=time_s, data_run=run,
               aria_label=f"Show {shown} s: {what}")  # fmt: skip


def _markup(child: Child) -> str:
    if child is None:
        return ""
    if isinstance(child, Html):
        return str(child)
    return escape(child) if isinstance(child, str) else joined(child)


def _attribute(key: str, value: str | float | bool | None) -> str:
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{escape(str(value))}"'

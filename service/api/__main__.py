"""The command `aeroloop`, as `python -m aeroloop`."""

from __future__ import annotations

from aeroloop.service.cli.entry import main

main()

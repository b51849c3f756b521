"""Log lines on stderr: plain text, or one JSON object per line for a log collector.

The keys are in `service/host/README.md`, and stable.
"""

from __future__ import annotations

import json
import logging
import time

_OWN = ("event", "role", "vehicle", "session", "tick")
"""Keys of `log_event`'s records."""


class _JsonLines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            **{key: getattr(record, key, None) for key in _OWN},
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def set_up_logging(level: int, *, as_json: bool = False) -> None:
    """Log to stderr from this level up."""
    handler = logging.StreamHandler()
    text = logging.Formatter("%(asctime)s %(levelname)s %(role)s: %(message)s", defaults={"role": "aeroloop"})
    handler.setFormatter(_JsonLines() if as_json else text)
    logging.basicConfig(level=level, handlers=[handler])

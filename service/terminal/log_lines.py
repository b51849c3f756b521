"""Log lines on stderr: plain text, or one JSON object per line for a log collector.

The keys are in `service/host/README.md`, and stable.
"""

from __future__ import annotations

import json
import logging
import time

_OWN = ("event", "role", "vehicle", "session", "tick")
"""Keys of `log_event`'s records."""


class JsonLines(logging.Formatter):
    """A record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
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


def set_up_logging(*, as_json: bool = False) -> None:
    """Log to stderr, from `info` up."""
    handler = logging.StreamHandler()
    text = logging.Formatter("%(asctime)s %(levelname)s %(role)s: %(message)s", defaults={"role": "aeroloop"})
    handler.setFormatter(JsonLines() if as_json else text)
    logging.basicConfig(level=logging.INFO, handlers=[handler])

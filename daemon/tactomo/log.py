"""Structured logs: readable lines on a terminal, one JSON object a line for a journal.

Every log line is an event name and key-value pairs. Everything goes to standard error, so that a
program's own output stays clean.
"""

from __future__ import annotations

import logging
import sys
from typing import Literal

import structlog

LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["auto", "text", "json"]


def configure_logging(level: LogLevel = "info", form: LogFormat = "auto") -> None:
    """Set up the process's logs.

    Args:
        level: the least severe level shown.
        form: ``text`` for people, ``json`` for journald and collectors; ``auto`` takes ``text``
            where standard error is a terminal and ``json`` elsewhere.

    """
    as_text = form == "text" or (form == "auto" and sys.stderr.isatty())
    render: list[structlog.typing.Processor] = (
        [
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(),
                pad_event_to=20,
                # The default one prints every local variable, whole matrices among them.
                exception_formatter=structlog.dev.plain_traceback,
            ),
        ]
        if as_text
        else [
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ]
    )
    structlog.configure(
        processors=[structlog.processors.add_log_level, *render],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelName(level.upper())),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=False,
    )

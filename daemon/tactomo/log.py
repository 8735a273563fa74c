"""Structured logs: readable lines on a terminal, journald's own kind under systemd, JSON elsewhere.

Every log line is an event name and key-value pairs. Everything goes to standard error, so that a
program's own output stays clean.

journald has times of its own. One event is one line there; of a traceback, each line has the
priority.
"""

from __future__ import annotations

import logging
import sys
from typing import Any, Literal

import structlog

from tactomo.plain import is_journal, plain, with_priority

LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["auto", "text", "json", "journal"]

_logfmt = structlog.processors.LogfmtRenderer()


def configure_logging(
    level: LogLevel = "info",  # the least severe level shown
    # ``text`` for people, ``journal`` for journald, ``json`` for collectors; ``auto`` takes
    # ``journal`` where standard error is journald's, ``text`` where it is a terminal, and ``json``
    # elsewhere
    form: LogFormat = "auto",
    sensor: str = "",  # named in each line, where several write to one log; empty for none
) -> None:
    """Set up the process's logs."""

    def name_sensor(
        _: Any, __: str, event: structlog.typing.EventDict
    ) -> structlog.typing.EventDict:
        return {**event, "sensor": sensor} if sensor else event

    structlog.configure(
        processors=[structlog.processors.add_log_level, name_sensor, _plain, *_renderers(form)],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelName(level.upper())),
        # A line is one write: several processes may share the log.
        logger_factory=structlog.WriteLoggerFactory(sys.stderr),
        cache_logger_on_first_use=False,
    )


def _plain(_: Any, __: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
    return {key: plain(value) if isinstance(value, str) else value for key, value in event.items()}


def _renderers(form: LogFormat) -> list[structlog.typing.Processor]:
    if form == "journal" or (form == "auto" and is_journal()):
        return [structlog.processors.format_exc_info, _journal_line]
    if form == "text" or (form == "auto" and sys.stderr.isatty()):
        return [
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(),
                pad_event_to=20,
                # The default one prints every local variable, whole matrices among them.
                exception_formatter=structlog.dev.plain_traceback,
            ),
        ]
    return [
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.format_exc_info,
        structlog.processors.JSONRenderer(),
    ]


def _journal_line(logger: Any, method: str, event: structlog.typing.EventDict) -> str:
    """Return the event's name and its pairs as ``name key="value"``, then its traceback."""
    level = event.pop("level")
    traceback = event.pop("exception", "")
    name = str(event.pop("event"))
    pairs = {key: _one_line(value) for key, value in event.items()}
    line = f"{name} {_logfmt(logger, method, pairs)}".rstrip()
    return with_priority(f"{line}\n{traceback}" if traceback else line, level)


def _one_line(value: Any) -> Any:
    return value if isinstance(value, bool | int | float) else " ".join(str(value).split())

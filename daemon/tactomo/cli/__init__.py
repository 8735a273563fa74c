"""The `tactomo` command: what runs it, and how its errors are printed.

`tactomo.cli.commands` lists the commands, whose modules are imported when they are called. What is
heavy is imported inside the functions that need it, so that `tactomo status` and each `--help`
answer at once.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback

from tactomo.cli.commands import app
from tactomo.ending import watch_parent
from tactomo.errors import explain
from tactomo.plain import is_journal, plain, with_priority

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line; exits with 0 (good), 1 (failure), 2 (usage) or 130 (Ctrl-C)."""
    watch_parent()
    try:
        try:
            app(prog_name="tactomo")
        finally:
            _flush()
    except Exception as error:
        words = explain(error)
        _print_error(error if words is None else f"tactomo: {words}")
        sys.exit(1)


def _flush() -> None:
    """Write what was printed, while a failure can still be told; no more is tried at the exit."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if error.errno != errno.EPIPE:  # who reads no further knows why
            raise


def _print_error(what: Exception | str) -> None:
    """Print an error, or the traceback of a mistake of ours; as an error, where journald reads."""
    text = (
        plain(what) if isinstance(what, str) else "".join(traceback.format_exception(what)).rstrip()
    )
    print(with_priority(text, "error") if is_journal() else text, file=sys.stderr)

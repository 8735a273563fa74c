"""The `tactomo` command: one module a group of commands, and the door they share.

Everything heavy is imported inside the commands that need it, so that `tactomo --help` and
`tactomo status` answer at once.
"""

from __future__ import annotations

import sys
import traceback

from tactomo.cli import (
    bench,
    bench_solves,
    calibrate,
    demo,
    doctor,
    evaluate,
    evaluate_drift,
    evaluate_measured,
    evaluate_paper,
    evaluate_stability,
    export,
    files,
    foxglove,
    keys,
    models,
    models_drawing,
    models_training,
    plot,
    ports,
    programs,
    recover,
    steer,
    systemd,
    watch,
)
from tactomo.cli.app import app
from tactomo.cli.failure import explain
from tactomo.cli.lifeline import hold_lifeline

__all__ = ["app", "main"]

# Importing a module registers its commands.
COMMANDS = (
    bench,
    bench_solves,
    calibrate,
    demo,
    doctor,
    evaluate,
    evaluate_drift,
    evaluate_measured,
    evaluate_paper,
    evaluate_stability,
    export,
    files,
    foxglove,
    keys,
    models,
    models_drawing,
    models_training,
    plot,
    ports,
    programs,
    recover,
    steer,
    systemd,
    watch,
)


def main() -> None:
    """Run the command line; exits with 0 (good), 1 (failure), 2 (usage) or 130 (Ctrl-C)."""
    hold_lifeline()
    try:
        app(prog_name="tactomo")
    except Exception as error:
        told = explain(error)
        _tell(error if told is None else f"tactomo: {told}")
        sys.exit(1)


def _tell(what: Exception | str) -> None:
    """Print an error, or the traceback of a mistake of ours; as an error, where journald reads."""
    from tactomo.log import is_journal, with_priority

    text = what if isinstance(what, str) else "".join(traceback.format_exception(what)).rstrip()
    print(with_priority(text, "error") if is_journal() else text, file=sys.stderr)

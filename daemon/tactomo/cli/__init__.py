"""The `tactomo` command: one module a group of commands, and the door they share.

Everything heavy is imported inside the commands that need it, so that `tactomo --help` and
`tactomo status` answer at once.
"""

from __future__ import annotations

import sys

from tactomo.cli import (
    bench,
    bench_solves,
    demo,
    doctor,
    evaluate,
    evaluate_measured,
    evaluate_paper,
    evaluate_stability,
    files,
    keys,
    models,
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
    demo,
    doctor,
    evaluate,
    evaluate_measured,
    evaluate_paper,
    evaluate_stability,
    files,
    keys,
    models,
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
        if told is None:  # a mistake of ours: the traceback belongs in a bug report
            raise
        print(f"tactomo: {told}", file=sys.stderr)
        sys.exit(1)

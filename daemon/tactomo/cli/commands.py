"""The `tactomo` command: a table of its commands, each of which is imported when it is called.

A command is a `typer.Typer` in a module, see `tactomo.cli.options.typer_app`. Another distribution
adds commands by entry points, as the laboratory does::

    [project.entry-points."tactomo.commands"]
    evaluate = "tactomo_lab.commands.evaluate:app"        # tactomo evaluate ...
    "models.train" = "tactomo_lab.commands.training:app"  # tactomo models train
    "evaluate.ktc" = "tactomo_lab.commands.measured:app"  # tactomo evaluate ktc

The entry point's name is the command's; a dot leads into a group of commands. A Typer that holds
several commands gives the one of that name; one without it becomes a group of this name.
"""

from __future__ import annotations

import copy
import functools
import math
import os
from collections.abc import Mapping
from importlib import import_module
from typing import Annotated, Any, Final, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from tactomo.cli.output import say
from tactomo.errors import TactomoError

ENTRY_POINTS = "tactomo.commands"
OTHERS = "Of other distributions"


class Line(NamedTuple):
    """One command in the help of `tactomo`; no module: the laboratory's, by an entry point."""

    panel: str
    name: str
    help: str
    module: str


RUN, STEER, FILES = "Run", "Steer a running daemon", "Recordings and files"
SERVICE, BUILD = "On a robot", "Models and measures"
COMMANDS = {
    name: Line(panel, name, help_, f"tactomo.cli.{module}" if module else "")
    for panel, name, help_, module in (
        (RUN, "demo", "Start a simulated skin to press in the browser.", "run.demo"),
        (RUN, "daemon", "Read a skin's ports and publish maps and contacts.", "run.daemon"),
        (RUN, "ports", "List serial adapters and their problems.", "run.ports"),
        (RUN, "zenoh", "Carry streams beyond this computer by Zenoh.", "run.serve"),
        (RUN, "twin", "Simulate a skin behind simulated firmware.", "run.demo"),
        (RUN, "viewer", "Serve a web page with a daemon's maps and contacts.", "run.serve"),
        (RUN, "foxglove", "Serve maps, contacts and events to Foxglove.", "run.serve"),
        (STEER, "status", "Show the daemon's state, problems first.", "steer.steer"),
        (STEER, "doctor", "Examine a skin at rest, with next steps.", "doctor.doctor"),
        (STEER, "watch", "Show map, contacts and health in the terminal.", "steer.watch"),
        (STEER, "tare", "Take a new reference of the unloaded skin.", "steer.steer"),
        (STEER, "calibrate", "Calibrate the pressure with a load cell.", "calibrate.calibrate"),
        (STEER, "teach", "Correct places by presses at known places.", "calibrate.teach"),
        (STEER, "record", "Record the bytes of the ports into a file.", "steer.steer"),
        (STEER, "method", "Choose the reconstruction method.", "steer.steer"),
        (STEER, "poke", "Press, release and break a running twin.", "steer.steer"),
        (STEER, "keys", "Manage keys of clients on other computers.", "steer.keys"),
        (FILES, "info", "Describe a recording, a folder or a sensor.", "files.recording"),
        (FILES, "import", "Turn measured scans into a recording.", "files.recording"),
        (FILES, "replay", "Play a recording through the daemon.", "run.daemon"),
        (FILES, "recover", "Repair a cut or damaged recording.", "files.recording"),
        (FILES, "reconstruct", "Reconstruct a file of scans.", "files.reconstruct"),
        (FILES, "plot", "Draw a recording on one page.", "plot.plot"),
        (FILES, "export", "Write a recording's frames for other programs.", "files.export"),
        (SERVICE, "service", "Let systemd run a skin's daemon.", "service.service"),
        (BUILD, "models", "Build, list and draw the models of sensors.", "models.models"),
        (BUILD, "bench", "Measure speed on this machine.", "bench.bench"),
        (BUILD, "evaluate", "Measure accuracy where the truth is known.", ""),
    )
}
OF_LABORATORY = {"models.simulate", "models.train"}


@functools.cache
def _entry_points() -> Mapping[str, Any]:
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def _build(name: str, app: typer.Typer) -> Any:
    command: Any = get_command(app)
    command = getattr(command, "commands", {}).get(name, command)
    command.name = name
    _refuse_nonsense(command)
    return command


def _refuse_nonsense(command: Any) -> None:
    """Have a command refuse what types let through: numbers without end, and paths without name."""
    for each in getattr(command, "commands", {}).values():
        _refuse_nonsense(each)
    for parameter in command.params:
        parameter.type = copy.copy(parameter.type)
        parameter.type.convert = functools.partial(_checked, parameter.type.convert)


def _checked(convert: Any, value: Any, parameter: Any, context: Any) -> Any:
    made = convert(value, parameter, context)
    if isinstance(made, float) and not math.isfinite(made):
        raise typer.BadParameter(f"{value!r} is not a finite number", context, parameter)
    if parameter is not None and parameter.type.name in ("path", "file") and not os.fspath(value):
        raise typer.BadParameter("the path is empty", context, parameter)
    return made


class Group(TyperGroup):
    """A group to which entry points may add commands; each is imported when it is looked up."""

    @property
    def _prefix(self) -> str:
        return "" if self.name == "tactomo" else f"{self.name}."

    def list_commands(self, ctx: typer.Context | None) -> list[str]:  # type: ignore[override]
        """Return the names in the order of the table."""
        begin = self._prefix
        points = [p.removeprefix(begin) for p in _entry_points() if p.startswith(begin)]
        points = [point for point in points if "." not in point]
        lines = () if begin else COMMANDS.values()
        ours = [line.name for line in lines if line.module or line.name in points]
        return list(dict.fromkeys([*ours, *self.commands, *sorted(points)]))

    def get_command(self, ctx: typer.Context | None, cmd_name: str) -> Any:  # type: ignore[override]
        """Return a command, or None where there is none of that name."""
        if cmd_name not in self.commands and (app := self._load(self._prefix + cmd_name)):
            self.commands[cmd_name] = _build(cmd_name, app)
        return self.commands.get(cmd_name)

    def _load(self, path: str) -> Any:
        line = COMMANDS.get(path)
        if line is not None and line.module:
            return import_module(line.module).app
        if path in _entry_points():
            return _entry_points()[path].load()
        if line is not None or path in OF_LABORATORY:
            raise not_installed(path.replace(".", " "))
        return None


class _Top(Group):
    """The commands at the top: help and completion show the table and import no command."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help as plain text: drawing boxes takes longer than all else."""
        super(TyperGroup, self).format_help(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a list of commands for each panel."""
        lines = [self._line(name) for name in self.list_commands(ctx)]
        width = max(len(line.name) for line in lines)
        for panel in dict.fromkeys(line.panel for line in lines):
            with formatter.section(panel):
                rows = [(f"{n:{width}}", h) for p, n, h, _ in lines if p == panel]
                formatter.write_dl(rows)

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Complete a command's name."""
        names = self.list_commands(ctx)
        shown = {name: TyperCommand(name, help=self._line(name).help) for name in names}
        ctx.command = TyperGroup(name=self.name, commands=shown, params=self.params)  # type: ignore[arg-type]
        return ctx.command.shell_complete(ctx, incomplete)

    def _line(self, name: str) -> Line:
        if name in COMMANDS:
            return COMMANDS[name]
        return Line(OTHERS, name, self.get_command(None, name).get_short_help_str(), "")


def _commit() -> str:
    """Return the commit that a wheel was built from, or that a checkout is at; or nothing."""
    import subprocess
    from pathlib import Path

    here = Path(__file__).parent
    describe = ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=12"]
    is_checkout = (here.parents[2] / "hatch_build.py").is_file()
    try:
        if is_checkout:
            commit = subprocess.check_output(describe, stderr=subprocess.DEVNULL, text=True)
        else:
            commit = here.with_name("commit.txt").read_text("ascii")
    except (OSError, subprocess.CalledProcessError):
        return ""
    return f"(commit {commit.strip()})"


app = typer.Typer(
    name="tactomo",
    cls=_Top,
    help=(
        "Tactile tomography: reads stacked EIT skins, reconstructs what presses on them, and "
        "streams pressure maps and contacts.\n\n"
        "New here? `tactomo demo` starts a simulated skin that you can press in the browser."
    ),
    epilog="`tactomo COMMAND --help` explains a command with examples.",
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _start(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        say(" ".join(filter(None, ("tactomo", version_of("tactomo"), _commit()))))
        raise typer.Exit
    if context.invoked_subcommand is None:
        say(context.get_help())
        raise typer.Exit(2)


BENCH: Final = "tactomo.bench"  # entry points: functions that measure for `tactomo bench`


def not_installed(what: str) -> TactomoError:
    """Return the error that says where to get what only the laboratory has."""
    return TactomoError(
        f"{what} is part of the laboratory, which is not installed",
        "pip install tactomo-lab, or `make setup` in a checkout",
    )


def measurement(name: str) -> Any:
    """Return the laboratory's function of this name for `tactomo bench`, or raise TactomoError."""
    from importlib.metadata import entry_points

    for entry in entry_points(group=BENCH, name=name):
        return entry.load()
    raise not_installed(f"bench --{name}")

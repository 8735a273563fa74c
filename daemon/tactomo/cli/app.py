"""The application object that every module of commands registers with, and shared options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer
from typer.core import TyperGroup

DEFAULT_NAME = "skin"
DEFAULT_DESCRIPTION = "paper_square"
DEFAULT_STREAM = "tcp://127.0.0.1:5560"
DEFAULT_CONTROL = "tcp://127.0.0.1:5561"
DEFAULT_TWIN_CONTROL = "tcp://127.0.0.1:5562"
DEFAULT_PROXY_STREAM = "tcp://127.0.0.1:5570"
DEFAULT_VIEWER_PORT = 8750
KEYS_VARIABLE = "TACTOMO_KEYS"

RUN = "Run"
STEER = "Steer a running daemon"
FILES = "Recordings and files"
BUILD = "Models and measures"
SERVICE = "On a robot"

ORDER = (
    *("demo", "daemon", "ports", "proxy", "twin", "viewer", "foxglove"),
    *("status", "doctor", "watch", "tare", "calibrate", "record", "tier", "poke", "keys"),
    *("info", "import", "replay", "recover", "reconstruct", "plot", "export"),
    "service",
    *("models", "bench", "bench-solves", "evaluate"),
)


class _Ordered(TyperGroup):
    """Lists the commands as a newcomer meets them, not as the modules are imported."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override]
        return sorted(super().list_commands(ctx), key=ORDER.index)


app = typer.Typer(
    name="tactomo",
    cls=_Ordered,
    help=(
        "Tactile tomography: reads stacked EIT skins, reconstructs what presses on them, and "
        "streams pressure maps and contacts.\n\n"
        "New here? `tactomo demo` starts a simulated skin that you can press in the browser."
    ),
    epilog="`tactomo COMMAND --help` explains a command with examples.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)

# The models' METHODS, which are not imported for a command line that only shows its help.
Method: TypeAlias = Literal[
    "auto",
    "tikhonov",
    "noser",
    "pls-paper",
    "fit",
    "levelset",
    "network",
    "hybrid",
    "cnn-single",
    "cnn-multimodal",
]
# The daemon's PROTOCOLS, likewise.
Protocol: TypeAlias = Literal["tactomo", "sciospec", "openeit", "matrix"]
SensorName: TypeAlias = Annotated[
    str, typer.Option("--sensor", "-s", help="The sensor's name in the stream.")
]
Description: TypeAlias = Annotated[
    str,
    typer.Option(
        "--description",
        "-d",
        help="What the sensor is made of: a shipped name or a TOML file.",
    ),
]
StreamAddress: TypeAlias = Annotated[
    str, typer.Option("--stream", help="Address of the daemon's stream.")
]
ControlAddress: TypeAlias = Annotated[
    str, typer.Option("--control", help="Address of the daemon's control socket.")
]
KeysFolder: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        envvar=KEYS_VARIABLE,
        help="Folder of keys, for a daemon beyond this computer: see `tactomo keys`.",
        show_default=False,
    ),
]
JsonOutput: TypeAlias = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
Announce: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--announce", help="Print one line of JSON with the addresses when ready, for programs."
    ),
]
RecordingFile: TypeAlias = Annotated[Path, typer.Argument(help="A recording (.mcap).")]


def examples(*lines: str) -> str:
    """Return an epilog that lists example commands, each on a line of its own."""
    return "**Examples**\n\n" + "\n\n".join(f"`{line}`" for line in lines)


@app.callback(invoke_without_command=True)
def _start(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"tactomo {version_of('tactomo')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(2)

"""What the modules of commands share: a Typer each, every option under one name, and defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import typer

from tactomo.errors import RecordingError, os_errors_as

DEFAULT_NAME = "skin"
DEFAULT_DESCRIPTION = "paper_square"
DEFAULT_STREAM = "tcp://127.0.0.1:5560"
DEFAULT_CONTROL = "tcp://127.0.0.1:5561"
DEFAULT_TWIN_CONTROL = "tcp://127.0.0.1:5562"
DEFAULT_VIEWER_PORT = 8750
KEYS_VARIABLE = "TACTOMO_KEYS"

METHODS = ("auto", "tikhonov", "noser", "fit", "levelset", "network")
"""Those of `tactomo_models`, which takes too long to import for completion."""


def typer_app(**settings: Any) -> typer.Typer:
    """Return a Typer for one module's commands; see `tactomo.cli.commands` for how it is found."""
    return typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        **settings,
    )


def examples(*lines: str) -> str:
    """Return an epilog that lists example commands, each on a line of its own."""
    return "**Examples**\n\n" + "\n\n".join(f"`{line}`" for line in lines)


def method_names() -> list[str]:
    """Return the methods that are installed, for completion."""
    return [*METHODS, *_installed("tactomo.methods")]


def _installed(group: str) -> list[str]:
    from importlib.metadata import entry_points

    return sorted(entry_points(group=group).names)


def description_names() -> list[str]:
    """Return the shipped sensor descriptions, for completion; without importing the models."""
    from importlib.util import find_spec

    spec = find_spec("tactomo_models")
    folders = [Path(each) for each in (spec and spec.submodule_search_locations) or ()]
    return sorted(path.stem for each in folders for path in each.glob("sensor/shipped/*.toml"))


def _known_method(context: typer.Context, name: str | None) -> str | None:
    if name is None or name in METHODS or context.resilient_parsing:
        return name
    from tactomo_models.errors import MethodError
    from tactomo_models.methods.registry import find_method

    try:
        find_method(name)
    except MethodError as error:
        raise typer.BadParameter(str(error)) from error
    return name


def _known_methods(context: typer.Context, names: list[str] | None) -> list[str] | None:
    """Refuse as wrong usage what is no method, of several, one after another or with commas."""
    split = [name.strip() for each in names or () for name in each.split(",")]
    for name in split:
        _known_method(context, name)
    return split or None


def method_option(default: str = "") -> Any:
    """Return the option --method; `default` says what happens without the option."""
    words = f"Reconstruction method: a name, or your own my_module:MyMethod.{default}"
    return typer.Option("--method", help=words, autocompletion=method_names, callback=_known_method)


def methods_option(default: str, **settings: Any) -> Any:
    """Return the option --method of a command that sets methods beside each other."""
    words = (
        f"Reconstruction method: a name, or your own my_module:MyMethod; may be repeated.{default}"
    )
    return typer.Option(
        "--method", help=words, autocompletion=method_names, callback=_known_methods, **settings
    )


def _protocol(default: str = "") -> Any:
    words = f"Protocol of the device: a name, or your own my_module:MyProtocol.{default}"
    return typer.Option(
        "--protocol", help=words, autocompletion=lambda: _installed("tactomo.protocols")
    )


def description_option(default: str = "") -> Any:
    """Return the option --description; `default` says what counts without the option."""
    words = f"Sensor description: a shipped name or a TOML file.{default}"
    return typer.Option("--description", "-d", help=words, autocompletion=description_names)


Method: TypeAlias = Annotated[str, method_option()]
GivenMethod: TypeAlias = Annotated[str | None, method_option(" [auto]")]
Protocol: TypeAlias = Annotated[str, _protocol()]
GivenProtocol: TypeAlias = Annotated[str | None, _protocol(" [tactomo]")]
Description: TypeAlias = Annotated[str, description_option()]
GivenDescription: TypeAlias = Annotated[str | None, description_option(f" [{DEFAULT_DESCRIPTION}]")]
RecordedDescription: TypeAlias = Annotated[str | None, description_option(" [the recorded one]")]
ReferenceFrames: TypeAlias = Annotated[
    str | None, typer.Option(metavar="FIRST:END", help="Unpressed frames, from 0: the reference.")
]
GivenChannel: TypeAlias = Annotated[
    Literal["magnitude", "structure"] | None,
    typer.Option(help="Channel of a file with one channel. [the sensor's only one]"),
]
Sensor: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--sensor",
        "-s",
        envvar="TACTOMO_SENSOR",
        help="The sensor's name. [the only one that runs]",
        show_envvar=False,
    ),
]
Address: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--address",
        "-a",
        envvar="TACTOMO_ADDRESS",
        help="Address of the stream, such as tcp://robot:5560. [found on this computer]",
        show_envvar=False,
    ),
]
NewName: TypeAlias = Annotated[
    str, typer.Option("--sensor", "-s", help="The sensor's name in the stream.")
]
ServeStream: TypeAlias = Annotated[
    str | None,
    typer.Option("--stream", help=f"Address of the stream. [{DEFAULT_STREAM}, or the next free]"),
]
ServeControl: TypeAlias = Annotated[
    str | None,
    typer.Option("--control", help=f"Address for commands. [{DEFAULT_CONTROL}, or the next free]"),
]
ViewerPort: TypeAlias = Annotated[
    int | None,
    typer.Option(
        "--viewer-port",
        min=0,
        max=65535,
        help=f"Port of the page; 0 takes a free port. [{DEFAULT_VIEWER_PORT}, or the next free]",
    ),
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
Rate: TypeAlias = Annotated[float, typer.Option(help="Dual scans a second.")]
DeviceIds: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--device-id", help="Device of the calibration; repeat. [the recording's, or any]"
    ),
]
KeptFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--output", "-o", dir_okay=False, help="Keep it in this file. [where the daemon looks]"
    ),
]
DryRun: TypeAlias = Annotated[bool, typer.Option("--dry-run", help="Do not keep the result.")]
ShownFile: TypeAlias = Annotated[
    Path | None,
    typer.Argument(metavar="[FILE]", help="[the one that the sensor's daemon uses]"),
]
Force: TypeAlias = Annotated[
    bool, typer.Option("--force", "-f", help="Overwrite an existing file without asking.")
]

RecordingFile: TypeAlias = Annotated[Path, typer.Argument(help="A recording (.mcap).")]
RecordingFiles: TypeAlias = Annotated[
    Path, typer.Argument(help="A recording (.mcap), or the folder of one in several files.")
]


def need_recording(path: Path) -> None:
    """Refuse a path that leads nowhere, before the modules that read recordings are imported."""
    step = "give the path of a .mcap file"
    with os_errors_as(RecordingError, f"cannot open the recording {path}", step):
        path.stat()


def frame_slice(text: str | None) -> slice | None:
    """Return the slice that "0:20" means."""
    if text is None:
        return None
    first, colon, end = text.partition(":")
    try:
        if not colon:
            raise ValueError
        frames = slice(int(first or 0), int(end) if end else None)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not FIRST:END, such as 0:20") from None
    return frames

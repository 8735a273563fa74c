"""The command line's surface: help, completion, usage errors, and that it starts quickly."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
from fixture_types import Run
from tactomo.cli import app, commands
from tactomo.cli.options import METHODS, description_names
from tactomo.config import DaemonConfig
from tactomo_models import METHODS as METHODS_THERE
from tactomo_models import shipped_descriptions
from typer.main import get_command
from typer.testing import CliRunner

TOP: Any = get_command(app)
HEAVY = {"numpy", "scipy", "zmq", "pydantic", "aiohttp", "serial", "skfem", "matplotlib", "rich"}
HEAVY |= {"asyncio", "structlog"}
GOLDEN = str(Path(__file__).parents[1] / "golden/recording-1.mcap")


def leaves(group: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every command that is no group, as the words that call it."""
    found: list[tuple[str, ...]] = []
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        below = hasattr(command, "commands")
        found += leaves(command, (*path, name)) if below else [(*path, name)]
    return found


@pytest.mark.parametrize("words", leaves(TOP), ids=" ".join)
def test_every_command_explains_itself_in_80_columns(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    result = CliRunner().invoke(app, [*words, "--help"], prog_name="tactomo")
    assert result.exit_code == 0
    assert f"Usage: tactomo {' '.join(words)}" in result.output
    if words != ("models", "list"):
        assert "Examples" in result.output
    assert "…" not in result.output  # nothing is cut off
    margin = 2  # of the help's left and right edge
    examples = re.findall(r"`(tactomo [^`]+)`", command_of(words).epilog or "")
    assert [line for line in examples if len(line) > 80 - margin] == []  # each can be copied


def command_of(words: tuple[str, ...]) -> Any:
    command = TOP
    for word in words:
        command = command.get_command(None, word)
    return command


def test_every_option_has_one_name_and_one_meaning() -> None:
    meanings: dict[str, set[str]] = {}
    for option in (each for words in leaves(TOP) for each in command_of(words).params):
        for flag in option.opts:
            meanings.setdefault(flag, set()).add(max(option.opts, key=len))
    assert meanings["--sensor"] == meanings["-s"] == {"--sensor"}
    assert meanings["--description"] == meanings["-d"] == {"--description"}
    assert meanings["--port"] == meanings["-p"] == {"--port"}
    assert meanings.keys() & {"--tier", "--name", "--twin", "--ask-for"} == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "needed"),
    [
        (["--help"], set()),
        (["status"], set()),
        (["info", "paper_square"], {"numpy", "pydantic", "rich"}),
        (["info", GOLDEN], {"numpy", "rich", "zmq"}),
        (["ports"], {"serial"}),
        (["status", "--address", "ipc://@nobody"], {"zmq"}),
        (["tare", "--address", "ipc://@nobody"], {"zmq"}),
        *(
            ([command, "none.mcap"], set())
            for command in ("doctor", "info", "plot", "recover", "replay")
        ),
        (["export", "none.mcap", "none.csv"], set()),
    ],
)
def test_nothing_heavy_is_imported_to_answer(words: list[str], needed: set[str]) -> None:
    program = (
        f"import sys; sys.argv = ['tactomo', *{words!r}]\n"
        "from tactomo.cli import main\n"
        "try: main()\n"
        f"finally: print(sorted({HEAVY!r} & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert result.stdout.splitlines()[-1] == str(sorted(needed)), result.stdout + result.stderr


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["ta"], {"tare"}),
        (["reconstruct", "a", "b", "--method", "t"], {"tikhonov"}),
        (["daemon", "--protocol", "op"], {"openeit"}),
        (["replay", "-d", "paper"], {"paper_square"}),
        (["method", "le"], {"levelset"}),
    ],
)
def test_the_shell_completes(
    tactomo: Run, monkeypatch: pytest.MonkeyPatch, words: list[str], offered: set[str]
) -> None:
    monkeypatch.setenv("_TACTOMO_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", " ".join(["tactomo", *words]))
    monkeypatch.setenv("COMP_CWORD", str(len(words)))
    assert offered == set(tactomo(status=0).stdout.split())


def test_what_is_completed_is_what_there_is() -> None:
    assert set(METHODS) <= set(METHODS_THERE)
    assert set(description_names()) == set(shipped_descriptions())


def test_a_distribution_adds_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    added = {
        name: EntryPoint(name, "tactomo.cli.files.reconstruct:app", commands.ENTRY_POINTS)
        for name in ("mend", "models.mend")
    }
    monkeypatch.setattr(commands, "_entry_points", lambda: added)
    shown = CliRunner().invoke(app, ["--help"]).output
    assert "mend" in shown.split(commands.OTHERS)[1]
    assert "Usage: tactomo mend" in CliRunner().invoke(app, ["mend", "--help"]).output
    assert "mend" in CliRunner().invoke(app, ["models", "--help"]).output


def test_without_the_laboratory_it_says_how_to_get_it(
    tactomo: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "_entry_points", dict)
    for words in (["evaluate", "field"], ["models", "train"]):
        result = tactomo(*words, status=1)
        assert "is part of the laboratory, which is not installed" in result.stderr
        assert "pip install tactomo-lab" in result.stderr
    assert "evaluate" not in tactomo("--help").stdout


def test_without_a_command_it_shows_the_help(tactomo: Run) -> None:
    result = tactomo(status=2)
    assert "tactomo demo" in result.stdout + result.stderr
    version = tactomo("--version")
    assert (version.returncode, version.stdout[:10]) == (0, "tactomo 0.")


@pytest.mark.parametrize(
    "arguments",
    [
        ["dance"],
        ["daemon", "--method", "best"],
        ["daemon", "--set", "lossless"],
        ["record", "stop", "here.mcap"],
        ["record", "start", "--seconds", "3"],
        ["poke", "press", "x_mm"],
        ["import", "in.npz", "out.mcap", "--reference-frames", "20"],
    ],
)
def test_wrong_usage_exits_with_2(tactomo: Run, arguments: list[str]) -> None:
    result = tactomo(*arguments, status=2)
    assert result.stdout == ""


@pytest.mark.parametrize(
    "words",
    [
        ["bench", "--seconds", "1e308"],
        ["bench", "--count", "1000000000000"],
        ["doctor", "--seconds", "1e308"],
        ["watch", "--seconds", "1e308"],
        ["record", "a.mcap", "--seconds", "1e308"],
        ["twin", "--noise-uv", "1e308"],
        ["ports", "--ask", "--baud", "1000000000000"],
        ["export", GOLDEN, "frames.csv", "--from", "nan"],
        ["plot", GOLDEN, "--to", "inf"],
        ["import", "scans.npz", "scans.mcap", "--rate", "-inf"],
        ["replay", GOLDEN, "--start", "nan"],
        ["replay", GOLDEN, "--start", "1e308"],
        ["replay", GOLDEN, "--start", "1e6"],
        ["replay", GOLDEN, "--speed", "1e308"],
        ["replay", GOLDEN, "--speed", "1e-300"],
        ["export", GOLDEN, "frames", "--lerobot", "--fps", "1000000000000"],
        ["evaluate", "field", "--count", "1000000000000"],
        ["evaluate", "paper", "--count", "1000000000000"],
        ["evaluate", "paper", "--sheets", "1000000000000"],
        ["models", "simulate", "scenes", "--scenes", "1000000000000"],
        ["models", "simulate", "scenes", "--jobs", "1000000000000"],
        ["models", "train", "scenes", "--epochs", "1000000000000"],
    ],
    ids=" ".join,
)
def test_no_option_takes_an_absurd_number(words: list[str]) -> None:
    """Taken, each ends in a traceback or never."""
    result = CliRunner().invoke(app, words, prog_name="tactomo")
    assert result.exit_code == 2, result.output


@pytest.mark.parametrize(
    "words", [["recover", GOLDEN], ["calibrate", "live"], ["teach", "live"]], ids=" ".join
)
@pytest.mark.parametrize("folder", ["", ".", "/"])
def test_a_folder_is_no_file_to_write(words: list[str], folder: str) -> None:
    """An empty variable of a shell's is the folder that one is in."""
    result = CliRunner().invoke(app, [*words, "-o", folder], prog_name="tactomo")
    assert result.exit_code == 2, result.output
    assert "is a directory" in result.output or "the path is empty" in result.output


LONG = "x" * 5000


@pytest.mark.parametrize(
    "words",
    [
        ["info", LONG],
        ["reconstruct", LONG, "maps.npz"],
        ["import", LONG, "scans.mcap"],
        ["recover", GOLDEN, "-o", LONG],
        ["status", "-a", "tcp://127.0.0.1:1", "--keys", LONG],
        ["watch", "--address", "\udce9"],
    ],
    ids=lambda words: words[0],
)
def test_a_path_or_address_that_cannot_be_is_told(tactomo: Run, words: list[str]) -> None:
    result = tactomo(*words)
    assert result.returncode in (1, 2)
    assert "Traceback" not in result.stderr
    assert re.search("name too long|it is no text", result.stderr), result.stderr[-300:]


@pytest.mark.parametrize(
    ("options", "unbuffered"),
    [
        (["--json"], ""),
        ([], "1"),
        pytest.param(["--json"], "1", marks=pytest.mark.slow),
        pytest.param([], "", marks=pytest.mark.slow),
    ],
)
def test_what_cannot_be_written_to_is_told(options: list[str], unbuffered: str) -> None:
    """A disk that the output was directed to is full."""
    program = [sys.executable, "-m", "tactomo.cli", "info", GOLDEN, *options]
    with Path("/dev/full").open("wb") as full:
        result = subprocess.run(
            program,
            stdout=full,
            stderr=subprocess.PIPE,
            check=False,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        )
    assert (result.returncode, b"Traceback" in result.stderr) == (1, False), result.stderr
    assert re.fullmatch(b"tactomo: cannot .*: No space left .*\n", result.stderr)


def test_who_reads_no_further_is_told_nothing() -> None:
    program = [sys.executable, "-m", "tactomo.cli", "info", GOLDEN]
    environment = {**os.environ, "PYTHONUNBUFFERED": ""}
    with subprocess.Popen(
        program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""


def test_every_key_of_the_configuration_can_be_set(tactomo: Run) -> None:
    """Given a table, which none of these takes, each is refused for its value and not its name."""
    for key in DaemonConfig.model_fields.keys() - {"baseline", "curve", "recording"}:
        result = tactomo("daemon", "--set", f"{key}.is=1", status=1)
        assert f"command line: {key}" in result.stderr
        assert "unknown" not in result.stderr, key

"""`tactomo status`: what is wrong with a running daemon, and all that it says of itself."""

from __future__ import annotations

from typing import Any, Final

import typer

from tactomo.cli import options
from tactomo.cli.output import print_json, say
from tactomo.cli.sensors import newest_status
from tactomo.plain import plain

MAX_SHOWN: Final = 16  # entries of a list; longer ones, such as outlines, are for --json

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo status",
        "tactomo status -s left_forearm",
        "tactomo status --address tcp://robot:5560 --keys ~/keys/robot",
        "tactomo status --json | jq .latency_ms",
    )
)
def status(
    sensor: options.Sensor = None,
    address: options.Address = None,
    keys: options.KeysFolder = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Show the daemon's state: problems with their next steps first, then all values.

    STREAM.md says under Status what each value means. `tactomo doctor` examines the skin itself.
    """
    answer = newest_status(sensor, address, keys)
    if as_json:
        print_json(answer)
        return
    from tactomo_client.schema import Status, wire_fields

    for issue in answer.get("issues") or []:
        colour = "red" if issue["severity"] == "error" else "yellow"
        typer.secho(plain(issue["what"]), fg=colour, bold=True)
        say(f"    {issue['next_step']}")
    say(f"{answer['sensor']}: {str(answer['state']).replace('_', ' ')}")
    for name in wire_fields(Status):
        if name in ("sensor", "state", "issues"):
            continue
        value = answer.get(name)
        for each in value if isinstance(value, list) and name == "ports" else [value]:
            words = plain(_words(each) or "none")
            typer.echo(f"{typer.style(f'{name:<16} ', bold=True)}{words}")


def _words(value: Any) -> str:
    """Return a value on one line; what is not known or empty is left out of maps."""
    if isinstance(value, dict):
        inner = {name: _words(each) for name, each in value.items() if each not in (None, [], {})}
        return ", ".join(
            f"{name} ({words})" if isinstance(value[name], dict) else f"{name} {words}"
            for name, words in inner.items()
        )
    if isinstance(value, list | tuple):
        is_long = len(value) > MAX_SHOWN or any(isinstance(each, list) for each in value)
        return f"{len(value)} values" if is_long else "; ".join(map(_words, value))
    if isinstance(value, float):
        return f"{value:.4g}"
    return "-" if value is None else str(value)

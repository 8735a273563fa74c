"""`tactomo service`: a skin's daemon as a service that starts at boot and stays."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from tactomo_client.messages import check_sensor_name

from tactomo.acquisition.adapters import list_adapters
from tactomo.cli.options import examples, typer_app
from tactomo.cli.output import say
from tactomo.errors import ServiceError
from tactomo.service.installation import (
    PROGRAM,
    Plan,
    check_running_systemd,
    plan_install,
    plan_uninstall,
    shipped,
    this_program,
    udev_rules,
)

app = typer_app(
    help="Let systemd run a skin's daemon: at boot, restarted, in a sandbox.",
    name="service",
    no_args_is_help=True,
    epilog=examples(
        "tactomo service install left_forearm --port /dev/ttyACM0 --dry-run",
        "tactomo service example > skin.toml",
    ),
)
Name = Annotated[str, typer.Argument(help="The skin's name: left_forearm.")]
Ports = Annotated[
    list[str],
    typer.Option("--port", "-p", help="The skin's serial port, plugged in; twice for two boards."),
]
Root = Annotated[
    Path, typer.Option(help="Where the robot's disk is mounted, to prepare an image of it.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show the steps without doing them.")]


@app.command(
    epilog=examples(
        "tactomo service install left_forearm --port /dev/ttyACM0 --dry-run",
        "sudo tactomo service install left_forearm --port /dev/ttyUSB0 --port /dev/ttyUSB1",
        "sudo tactomo service install palm --port /dev/ttyACM0 --root /mnt/robot "
        "--program /usr/bin/tactomo",
    )
)
def install(
    name: Name,
    port: Ports,
    dry_run: DryRun = False,
    root: Root = Path("/"),
    program: Annotated[
        str | None, typer.Option(help="Path of `tactomo` on the robot. [this one]")
    ] = None,
) -> None:
    """Install, enable and start the service of one skin: `tactomo@NAME`.

    A udev rule gives a connected adapter the permanent name /dev/tactomo/NAME. The configuration,
    /etc/tactomo/NAME.toml, is yours: a second installation does not change it. Install several
    skins one by one, each with addresses of its own, or write one configuration for all skins
    (deploy/examples/robot.toml).
    """
    check_sensor_name(name, "skin")
    rules, names = udev_rules(name, port, list_adapters())
    for unnamed in set(port).intersection(names):
        if not unnamed.startswith(("/dev/serial/", "/dev/tactomo/")):
            say(f"No USB adapter is at {unnamed}: the service keeps this name.\n", err=True)
    root = root.absolute()
    plan = plan_install(name, names, rules, root, program or _program(dry_run))
    _carry_out(plan, dry_run)
    if not dry_run:
        say(f"tactomo@{name} is installed; `systemctl status tactomo@{name}` shows its state")


@app.command(
    epilog=examples(
        "sudo tactomo service uninstall left_forearm", "tactomo service uninstall --dry-run"
    )
)
def uninstall(
    name: Annotated[
        str | None, typer.Argument(help="The skin's name. [all skins and shared files]")
    ] = None,
    dry_run: DryRun = False,
    root: Root = Path("/"),
) -> None:
    """Stop the service of a skin, or of all, and remove it. Configuration and recordings stay."""
    if name is not None:
        check_sensor_name(name, "skin")
    _carry_out(plan_uninstall(name, root.absolute()), dry_run)


@app.command(epilog=examples("tactomo service example > skin.toml"))
def example() -> None:
    """Print a daemon's configuration with every key and its meaning."""
    say(shipped("daemon.example.toml"), nl=False)


def _program(dry_run: bool) -> str:
    """Return the program that the service is to call; who only looks may do so from anywhere."""
    try:
        return this_program()
    except ServiceError as error:
        if not dry_run:
            raise
        say(f"Not from here: {error}. From {PROGRAM}:\n", err=True)
        return PROGRAM


def _carry_out(plan: Plan, dry_run: bool) -> None:
    _show(plan, with_text=dry_run)
    if dry_run:
        return
    if plan.root == Path("/"):
        check_running_systemd()
        if os.geteuid() != 0:
            raise ServiceError(
                "only root may do this", "run it with sudo, or see the steps with --dry-run"
            )
    plan.carry_out()


def _show(plan: Plan, with_text: bool) -> None:
    for file in plan.files:
        effect = file.effect(plan.root)
        say(f"{effect:9}  {plan.root / file.path}")
        if with_text and effect in ("write", "replace"):
            say("".join(f"    {line}\n" for line in (file.text or "").splitlines()))
    for command in plan.commands:
        say(f"run        {' '.join(command)}")

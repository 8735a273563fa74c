"""Commands over a control socket, the daemon's or the twin's: checked before they are obeyed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from tactomo_models.errors import explain

from tactomo.errors import CommandError

Outcome = TypeVar("Outcome")


class Arguments(BaseModel):
    """Arguments of a command; what is not listed is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Nothing(Arguments):
    """No arguments."""


def obey(
    command: str,
    arguments: Mapping[str, Any],
    commands: Mapping[str, type[BaseModel]],
    handlers: Mapping[str, Callable[[Any], Outcome]],
) -> Outcome:
    """Check a command's arguments and return its handler's outcome, or raise CommandError."""
    if command not in commands:
        raise CommandError(
            f"unknown command {command[:40]!r}",
            f"known commands: {', '.join(commands)}",
            "unknown_command",
        )
    takes = commands[command]
    try:
        checked = takes.model_validate(arguments)
    except ValidationError as error:
        raise CommandError(
            f"{command}: {explained(error)}", f"its arguments: {described(takes)}", "bad_argument"
        ) from error
    return handlers[command](checked)


def explained(error: ValidationError) -> str:
    """Return what a validation finds wrong, each as "key = value: what is allowed"."""
    return "; ".join(explain(item) for item in error.errors())


def described(takes: type[BaseModel]) -> str:
    """Return a command's arguments with their defaults, as people read them."""
    fields = takes.model_fields.items()
    named = (name if field.is_required() else f"{name}={field.default}" for name, field in fields)
    return ", ".join(named) or "none"

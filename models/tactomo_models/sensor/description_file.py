"""Sensor descriptions as files: those that are shipped, by name, and a user's own, by path.

The shipped ones lie in `tactomo_models/sensors`; who has another sheet copies one and changes it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tactomo_models.errors import DescriptionError, explain_all
from tactomo_models.foreign_file import MAX_TEXT_BYTES, read_regular
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.toml_file import parse_toml, read_toml


def shipped_descriptions() -> list[str]:
    """Names of the descriptions that come with tactomo."""
    folder = resources.files("tactomo_models.sensor.shipped")
    return sorted(
        f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")
    )


def shipped_text(name: str) -> str:
    """The TOML text of a shipped description, comments and all.

    Raises DescriptionError where there is none of that name.
    """
    if name not in shipped_descriptions():
        raise DescriptionError(
            f"no description is shipped as {name!r}; choose one of: "
            f"{', '.join(shipped_descriptions())}"
        )
    return (
        resources.files("tactomo_models.sensor.shipped").joinpath(f"{name}.toml").read_text("utf-8")
    )


def load_description(source: str | Path) -> SensorDescription:
    """Read a sensor description by its shipped name or from a TOML file.

    Raises DescriptionError where the file cannot be read, is not TOML, or a key is unknown, missing
    or out of range; the message names the key, its value and what is allowed.
    """
    name = str(source)
    with _explained(name):
        return SensorDescription.model_validate(_read(name))


def carried_text(description: SensorDescription, source: str) -> str:
    """Return a description as recordings carry it, see `parse_description`; none if shipped."""
    if source in shipped_descriptions() and load_description(source) == description:
        return ""
    return description.model_dump_json(by_alias=True, exclude_unset=True)


def parse_description(text: str, source: str) -> SensorDescription:
    """Read the text of `carried_text`; `source` names it in errors.

    Raises DescriptionError where a key is unknown, missing or out of range.
    """
    with _explained(source):
        return SensorDescription.model_validate_json(text)


@contextmanager
def _explained(name: str) -> Iterator[None]:
    try:
        yield
    except ValidationError as error:
        raise DescriptionError(
            "\n".join(f"{name}: {each}" for each in explain_all(error.errors()))
        ) from error


def _read(name: str) -> dict[str, Any]:
    try:
        if name in shipped_descriptions():
            return parse_toml(shipped_text(name))
        return _with_surface(read_toml(Path(name)), Path(name))
    except OSError as error:
        raise _cannot_read(name, error.strerror) from error
    except UnicodeDecodeError as error:
        raise _cannot_read(name, "not UTF-8 text") from error
    except ValueError as error:
        raise DescriptionError(f"{name} is not valid TOML: {error}") from error


def _with_surface(described: dict[str, Any], path: Path) -> dict[str, Any]:
    """Add the text of the surface file that a description names, from beside the description."""
    mount = described.get("mount")
    surface = mount.get("surface") if isinstance(mount, dict) else None
    file = surface.get("file") if isinstance(surface, dict) else None
    if isinstance(surface, dict) and isinstance(file, str) and "obj" not in surface:
        try:
            text = read_regular(path.parent / file, MAX_TEXT_BYTES).decode("utf-8-sig")
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
            raise DescriptionError(
                f"{path}: mount.surface.file = {file!r}: cannot read it: {reason}; name an OBJ "
                "file by its path from the description"
            ) from error
        if not text.strip():
            raise DescriptionError(
                f"{path}: mount.surface.file = {file!r}: it is empty; export the surface's "
                "triangles as OBJ"
            )
        surface["obj"] = text
    return described


def _cannot_read(name: str, reason: str | None) -> DescriptionError:
    return DescriptionError(
        f"cannot read the sensor description {name}: {reason}; give the path of a TOML file "
        f"or one of: {', '.join(shipped_descriptions())}"
    )

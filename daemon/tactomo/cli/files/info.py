"""`tactomo info`: what a recording, a file of arrays or a sensor description is."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.options import JsonOutput, examples, need_recording, typer_app
from tactomo.cli.output import print_json

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

    from tactomo.recordings.recording import Recording

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo info grasp.mcap",
        "tactomo info paper_square",
        "tactomo info my.toml",
    )
)
def info(
    what: Annotated[
        str,
        typer.Argument(
            help="A recording (.mcap), a file that `tactomo reconstruct` reads (.npz, .mat, .csv, "
            ".eit), a built artifact, or a sensor description: a shipped name or a TOML file."
        ),
    ],
    as_json: JsonOutput = False,
) -> None:
    """Describe a recording, a file of scans or a sensor description."""
    facts = _facts(what)
    if as_json:
        print_json(facts)
        return
    from rich.table import Table
    from rich.text import Text

    from tactomo.cli.console import Console

    shown = Table(title=what, show_header=False)
    for name, value in facts.items():
        shown.add_row(Text(name, "bold"), _words(value))
    Console().print(shown)


def _date(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9).isoformat(" ", "seconds") if time_ns else ""


def _facts(what: str) -> dict[str, Any]:
    suffix = Path(what).suffix.lower()
    if suffix == ".mcap":
        need_recording(Path(what))
        from tactomo.recordings.recording import open_recording

        return _recording_facts(open_recording(what))
    from tactomo_models import load_description
    from tactomo_models.array_files import READERS

    if suffix in (".npz", ".eit", *READERS) or Path(what).is_dir():
        return _array_facts(Path(what))
    return _description_facts(load_description(what))


def _recording_facts(recording: Recording) -> dict[str, Any]:
    summary = recording.summary
    facts: dict[str, Any] = {
        "sensor": summary.origin.sensor,
        "description": summary.origin.description,
        "began": _date(summary.start_ns),
        "seconds": round(summary.duration_s, 3),
        "bytes": summary.file_bytes,
        "complete": summary.is_complete,
        "ports": {
            url: f"{summary.port_bytes.get(number, 0)} bytes"
            for number, url in enumerate(summary.origin.ports)
        },
        "scans": dict(summary.scans.items()),
        "devices": [f"{hello.device_id}, {hello.firmware}" for hello in summary.hellos],
        "corrupt packets": summary.corrupt,
        "faulty packets": summary.faulty,
        "reconstructed frames": summary.frames,
        "references": summary.references,
        "recorded by": f"tactomo {summary.origin.version}",
    }
    if summary.ending:
        facts["ends"] = summary.ending
    if summary.recovered_gaps is not None:
        facts["recovered, parts missing"] = summary.recovered_gaps
    return facts


def _array_facts(path: Path) -> dict[str, Any]:
    """Describe a built artifact, or any other file of arrays, by what is in it."""
    from tactomo.recordings.imported_scans import load_arrays

    arrays = load_arrays(path)
    facts = {name: array.item() for name, array in arrays.items() if array.ndim == 0}
    kind = "artifact" if {"sha256", "sensor", "jacobian"} <= arrays.keys() else "arrays"
    shapes = {
        name: f"{array.dtype} {array.shape}" for name, array in arrays.items() if array.ndim > 0
    }
    return {"kind": kind, "bytes": path.stat().st_size, **facts, "arrays": shapes}


def _mount_in_words(description: SensorDescription) -> str:
    mount = description.mount
    assert mount is not None
    words = f"{mount.kind} on {mount.frame}"
    if description.stretching is None:
        return words
    lengths = description.stretching.stretches
    return f"{words}, {lengths.min():.2f} to {lengths.max():.2f} times the sheet's lengths"


def _description_facts(description: SensorDescription) -> dict[str, Any]:
    from tactomo_protocol import MAX_SAMPLES

    width_mm, height_mm = description.width_m * 1e3, description.height_m * 1e3
    magnitude, count = description.magnitude, description.measurements
    return {
        "name": description.name,
        **({"title": description.title} if description.title else {}),
        "sheet": f"{description.sheet.shape}, {width_mm:g} x {height_mm:g} mm",
        "electrodes": description.electrode_count,
        **({"mount": _mount_in_words(description)} if description.mount else {}),
        **({"companions": ", ".join(description.companion)} if description.companion else {}),
        "voltages a scan": count
        if count <= MAX_SAMPLES
        else f"{count}: of files alone, as a live scan has {MAX_SAMPLES} at most",
        "pattern": str(description.pattern),
        "instrument": f"{description.instrument.voltages} voltages",
        "channels": ", ".join(description.channels),
        "map": f"{description.map.nodes_x} x {description.map.nodes_y} nodes",
        "answers to": "no pressure calibration"
        if magnitude is None
        else f"{magnitude.response.pressure_kpa[-1]:g} kPa at most",
        "sha256 of its physics": description.sha256,
    }


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return "\n".join(f"{name}: {each}" for name, each in value.items()) or "none"
    if isinstance(value, list):
        return "\n".join(str(each) for each in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)

"""Write what follows from tactomo_client/schema.py: tables of the documentation, and a C++ header.

`make schema` runs it; a test holds what is committed against it.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from tactomo_client.schema import EVENTS, PRESSURE_RANGES, TOUCHES_SEEN

ROOT: Final = Path(__file__).parents[2]
SOURCE: Final = ROOT / "clients/python/tactomo_client/schema.py"
STREAM: Final = ROOT / "clients/STREAM.md"
FILES: Final = ROOT / "docs/files.md"
HEADER: Final = ROOT / "clients/cpp/include/tactomo/schema.hpp"

TABLES: Final = {
    "### Envelope": ("Envelope",),
    "### `map`": ("Contacts", "Frame"),
    "### `contacts`": ("Contacts",),
    "Each contact:": ("Contact",),
    "### `scan`": ("Scan",),
    "### `status`": ("Status",),
    "`description`:": ("SensorDescription",),
    "`calibration`:": ("Calibration",),
    "Each of `ports`:": ("Port",),
    "### `event`": ("Event",),
}
UNITS: Final = {
    **{
        "ns": "ns",
        "us": "µs",
        "ms": "ms",
        "s": "s",
        "m": "m",
        "mm": "mm",
        "mm2": "mm²",
        "kpa": "kPa",
    },
    **{"n": "N", "hz": "1/s", "ppm": "ppm"},
}
ENVELOPE_ROWS: Final = """\
| `schema` | int | | 1 | Version of this specification. If it is not one you know, do not read on. |
| `sensor` | str | | 1 | As in the topic. |
| `kind` | str | | 1 | As in the topic. |
"""
PLAIN: Final = {
    **{"int": "int", "Unsigned": "int", "float": "float", "str": "str", "bool": "bool"},
    **{"Image": "array (ny, nx) `<f4`", "Volts": "array (M,) `<f8`"},
}
CPP: Final = {
    **{"int": "std::int64_t {} = 0", "Unsigned": "std::uint64_t {} = 0", "float": "double {} = 0"},
    **{"bool": "bool {} = false", "Image | None": "Image {}", "str": "Text<64> {}"},
    **{"int | None": "std::optional<std::int64_t> {}", "float | None": "std::optional<double> {}"},
    **{"str | None": "Text<48> {}", "frozenset[str]": "std::vector<Text<48>> {}"},
    "tuple[Contact, ...]": "std::vector<Contact> {}",
    "tuple[float, float] | Absent": "std::array<double, 2> {}{{}}",
    "tuple[float, float, float] | None": "std::optional<std::array<double, 3>> {}",
}
CPP_OWN: Final = {
    "tier_reason": "Text<255> tier_reason",
    "pressure_range": "PressureRange pressure_range = PressureRange::unknown",
    "frame": "Text<63> frame",
}


class Field(NamedTuple):
    """A field as schema.py has it."""

    name: str
    type: str
    meaning: str
    unit: str
    has_default: bool


def read_schema(source: str) -> dict[str, list[Field]]:
    """Return the fields that each class defines, without those that no message has."""
    lines = source.splitlines()
    classes = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef):
            own = [each for each in node.body if isinstance(each, ast.AnnAssign | ast.Assign)]
            found = [_field(each, lines) for each in own]
            classes[node.name] = [each for each in found if each.name[0] != "_"]
    return classes


def _field(node: ast.AnnAssign | ast.Assign, lines: list[str]) -> Field:
    name = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
    above = node.lineno - 1
    while lines[above - 1].strip().startswith("#:"):
        above -= 1
    comment = [*lines[above : node.lineno - 1], lines[(node.end_lineno or node.lineno) - 1]]
    words = " ".join(each.partition("#: ")[2] for each in comment if "#: " in each).strip()
    meaning, _, unit = words.partition(" Unit: ")
    unit = unit.rstrip(".") or UNITS.get(name.rpartition("_")[2] if "_" in name else "", "")
    is_open = bool(meaning) and meaning[-1] not in ".?"
    return Field(
        name,
        "" if isinstance(node, ast.Assign) else ast.unparse(node.annotation),
        meaning + "." * is_open,
        unit,
        node.value is not None,
    )


def told_type(annotation: str) -> str:
    """Return a type in the words of the tables."""
    if annotation.endswith(" | None"):
        return told_type(annotation.removesuffix(" | None")) + " or nil"
    annotation = annotation.removesuffix(" | Absent")
    if found := re.fullmatch(
        r"(?:tuple\[(.*), \.\.\.|frozenset\[(.*)|Mapping\[str, (.*))\]", annotation
    ):
        inside = told_type(found[1] or found[2] or found[3])
        inside = "maps" if inside == "map" else inside
        return f"{'map' if found[3] else 'list'} of {inside}"
    if annotation.startswith("tuple["):
        return annotation.removeprefix("tuple")
    return PLAIN.get(annotation, "map")


def table(schema: dict[str, list[Field]], names: tuple[str, ...], since: str = "1") -> str:
    """Return the rows of a table: the fields of some classes, but for those of the envelope."""
    enveloped = {"sensor", *(field.name for field in schema["Envelope"])} - {"flags"}
    tabled = {name for table in TABLES.values() for name in table}
    rows = []
    for kind in names:
        for field in schema[kind]:
            if kind != "Envelope" and (field.name in enveloped or not field.meaning):
                continue
            meaning = field.meaning
            inner = next((n for n in re.findall(r"\w+", field.type) if n in schema), "")
            if inner and inner not in tabled:
                holder = "Each holds" if " of " in told_type(field.type) else "It holds"
                meaning = f"{meaning} {holder} {_inside(schema, inner)}."
            if field.has_default and kind in ("Envelope", "Contacts"):
                meaning += " May be absent."
            cells = (
                f"`{field.name}`",
                told_type(field.type),
                field.unit,
                since,
                _markdown(meaning),
            )
            rows.append(re.sub("  +", " ", f"| {' | '.join(cells)} |"))
    return "".join(f"{row}\n" for row in rows)


def event_rows(schema: dict[str, list[Field]]) -> str:
    """Return the rows of the table of events."""
    rows = (
        f"| `{name}` | {kind.severity} | 1 | {_event_words(schema, name)} |\n"
        for name, kind in EVENTS.items()
    )
    return "".join(rows).replace("|  |", "| |")


def _event_words(schema: dict[str, list[Field]], name: str) -> str:
    (meaning,) = (field.meaning for field in schema["Events"] if field.name == name)
    kind = EVENTS[name]
    words = [_markdown(meaning)]
    if kind.end:
        words.append(f"Sent once until `{kind.end}`.")
    if kind.period_s > 1:
        words.append(f"At most once in {kind.period_s:g} s.")
    return " ".join(word for word in words if word)


def _inside(schema: dict[str, list[Field]], kind: str) -> str:
    told = []
    for field in schema[kind]:
        inner = next((n for n in re.findall(r"\w+", field.type) if n in schema), "")
        about = field.meaning.rstrip(".") or told_type(field.type)
        about = about if not field.meaning else f"{told_type(field.type)}: {about}"
        told.append(f"`{field.name}` ({about}{'; ' + _inside(schema, inner) if inner else ''})")
    return ", ".join(told)


def _markdown(text: str) -> str:
    return text.replace("``", "`").replace("|", "\\|")


def stream_page(schema: dict[str, list[Field]], page: str) -> str:
    """Return STREAM.md with its tables of fields written anew."""
    for heading, names in TABLES.items():
        rows = table(schema, names)
        page = _replaced(page, heading, ENVELOPE_ROWS + rows if "Envelope" in names else rows)
    page = _replaced(page, "### `event`", event_rows(schema), "Event")
    return page


def files_page(schema: dict[str, list[Field]], page: str) -> str:
    """Return docs/files.md with the columns of contacts written anew."""
    rows = table({**schema, "Contact": schema["Contact"][1:]}, ("Contact",), "0.1")
    rows = re.sub(r"(?m)^\| `", "| `contact_", rows)
    rows = rows.replace("contact_magnitude_sigma", "contact_sigma")
    rows = rows.replace("`contact_frame` | str or nil", "`contact_mount_frame` | U63 (C,)")
    rows = rows.replace("frame `frame`", "frame `contact_mount_frame`")
    rows = rows.replace("[float, float, float]", "float64 (C, 3)").replace("are nil", "are NaN")
    rows = re.sub(r"\bnil\b", "NaN", rows.replace(" or nil |", " |").replace("Nil ", "NaN "))
    types = {"float": "float64", "str": "U7", "bool": "bool"}
    for of_stream, of_file in types.items():
        rows = rows.replace(f"| {of_stream} |", f"| {of_file} (C,) |")
    start = page.index("| `contact_frame` ")
    start = page.index("\n", start) + 1
    end = page.index("\n\n", start) + 1
    return page[:start] + rows + page[end:]


def _replaced(page: str, heading: str, rows: str, column: str = "Name") -> str:
    at = page.index(f"\n{heading}\n")
    found = re.compile(rf"\| {column} \|.*\n\|[-|]+\n((?:\|.*\n)+)").search(page, at)
    assert found, heading
    return page[: found.start(1)] + rows + page[found.end(1) :]


def header(schema: dict[str, list[Field]]) -> str:
    """Return the C++ client's schema.hpp."""
    seen, ranges = sorted(TOUCHES_SEEN), PRESSURE_RANGES
    frame = {each.name: each for kind in ("Envelope", "Contacts") for each in schema[kind]}
    return f"""\
// The fields of a message, by clients/python/tactomo_client/schema.py: written by `make schema`.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string_view>
#include <vector>

#include "values.hpp"

namespace tactomo {{

/// Flags under which every touch is still seen: see STREAM.md. Of any other nobody knows.
inline constexpr std::array<std::string_view, {len(seen)}> touches_seen{{
    {_quoted(seen)}}};

/// Whether Contact::pressure_kpa can be believed, and what its absence means.
enum class PressureRange {{ {", ".join(ranges)} }};
inline constexpr std::array<std::string_view, {len(ranges)}> pressure_ranges{{
    {_quoted(ranges)}}};

struct Contact;

{_struct("ContactFields", schema["Contact"])}
{_struct("FrameFields", [*frame.values(), *schema["Frame"]])}
namespace detail {{

/// What may stand in place of a field's value.
enum class Allow : unsigned {{ nothing = 0, nil = 1, absence = 2, both = 3 }};

{_each_field("each_field", "contact", schema["Contact"])}
{_each_field("each_field", "frame", list(frame.values()))}
{_each_field("each_image", "frame", schema["Frame"])}
}}  // namespace detail
}}  // namespace tactomo
"""


def _quoted(names: Sequence[str]) -> str:
    return textwrap.fill(", ".join(f'"{name}"' for name in names), 90).replace("\n", "\n    ")


def _struct(name: str, fields: list[Field]) -> str:
    lines = []
    for field in fields:
        words = f"{field.meaning}" + (f" Unit: {field.unit}." if field.unit == "ratio" else "")
        if words:
            lines += [f"    /// {line}" for line in textwrap.wrap(words.replace("``", "`"), 92)]
        declared = CPP_OWN.get(field.name) or CPP[field.type].format(field.name)
        lines.append(f"    {declared};")
    return "\n".join([f"struct {name} {{", *lines, "};", ""])


def _each_field(function: str, of: str, fields: list[Field]) -> str:
    lines = [f'    each("{f.name}", fields.{f.name}, Allow::{_allowed(f)});' for f in fields]
    return "\n".join(
        [
            "/// Calls `each` with every field's name and value, and what may stand in its place.",
            "template <typename Fields, typename Each>",
            f"void {function}_of_{of}(Fields& fields, const Each& each) {{",
            *lines,
            "}",
            "",
        ]
    )


def _allowed(field: Field) -> str:
    if not field.type.endswith(" | None"):
        if field.type.startswith("tuple"):
            return "nothing"
        return "absence" if field.has_default else "nothing"
    return "both" if field.has_default else "nil"


def written(source: str) -> dict[Path, str]:
    """Return the text of each file that follows from the schema."""
    schema = read_schema(source)
    return {
        STREAM: stream_page(schema, STREAM.read_text("utf-8")),
        FILES: files_page(schema, FILES.read_text("utf-8")),
        HEADER: header(schema),
    }


if __name__ == "__main__":
    for path, text in written(SOURCE.read_text("utf-8")).items():
        path.write_text(text, "utf-8")

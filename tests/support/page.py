"""A page of the documentation, and what it tells to run, to write and to save."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from whole_system import SENSOR, Demo, repository


class Page:
    """One page.

    Args:
        name: its path from the root of the checkout.
    """

    def __init__(self, name: str) -> None:
        self.text = (repository() / name).read_text("utf-8")

    def blocks(self, language: str, heading: str = "") -> list[str]:
        """Return the code in a language, of the section whose heading begins so or of all."""
        text = self._section(heading) if heading else self.text
        return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)

    def commands(self, heading: str = "") -> list[str]:
        """Return the shell commands, likewise."""
        return [line for block in self.blocks("sh", heading) for line in block.splitlines() if line]

    def file(self, name: str) -> str:
        """Return the contents of the file that is to be saved under this name."""
        found = re.search(rf"`{re.escape(name)}`:\n\n```\w+\n(.*?)^```", self.text, re.M | re.S)
        assert found, f"{name} is not told to be saved"
        return found[1]

    def _section(self, heading: str) -> str:
        found = re.search(rf"^##+ {re.escape(heading)}\b.*?(?=^##|\Z)", self.text, re.M | re.S)
        assert found, f"there is no section {heading}"
        return found[0]


def first_line_of_the_readme(demo: Demo, folder: Path, python: Path = Path(sys.executable)) -> str:
    """Run the README's client on a demo that is pressed, and return the first line it prints."""
    code = next(block for block in Page("README.md").blocks("python") if "subscribe" in block)
    assert len(code.strip().splitlines()) <= 6
    code = code.replace("subscribe(", f"subscribe(address={demo.stream!r}, sensor=", 1)
    script = folder / "six_lines.py"
    script.write_text(re.sub(r'sensor="\w+"', f'sensor="{SENSOR}"', code))
    with subprocess.Popen([python, "-u", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        process.kill()
    return line

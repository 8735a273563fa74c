"""The terminal: it shows what others wrote, and does nothing of what that says."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

from rich import console
from rich.segment import Segment

from tactomo.plain import plain

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

PAGE_WIDTH: Final = 150  # columns that the widest table takes


class Console(console.Console):
    """Rich's, for which text is text: no markup in it, no emoji's name, no control character.

    What we style ourselves is a `Text`, or printed with `markup=True`.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, **settings)

    def render(
        self, renderable: console.RenderableType, options: console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Render, as Rich does, without what a terminal would obey."""
        for segment in super().render(renderable, options):
            is_ours = segment.control is not None
            yield segment if is_ours else Segment(plain(segment.text), segment.style)


def page() -> Console:
    """The terminal; where there is none, a page as wide as tables are: a file has no width."""
    shown = Console()
    return shown if shown.is_terminal else Console(width=PAGE_WIDTH)


def progress(*columns: str | ProgressColumn, **settings: Any) -> Progress:
    """Return bars for standard error, which are gone in the end; a file or a pipe gets nothing."""
    from rich.progress import Progress

    shown = Console(stderr=True)
    hidden = not shown.is_interactive
    return Progress(*columns, console=shown, transient=True, disable=hidden, **settings)

"""Tables, bars and coloured lines on a terminal. No text is parsed as markup or written unescaped."""

from typing import Any

from rich.console import Console
from rich.text import Text

from ....schemas.runtime.visible_text import visible


class Terminal(Console):
    """Console of rich for texts of users, archives and servers, given as `str`.

    `[scan]` in a text is no markup, `:smile:` no emoji, and control characters become visible
    before rich measures how wide the text is.
    """

    def __init__(self, **options: Any) -> None:
        """Make a console. options: of `rich.console.Console`."""
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text as rich draws it."""
        return super().render_str(visible(text), **options)

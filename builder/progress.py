"""What long work says of itself, and a silent listener. How it looks on a terminal is the command line's."""

from typing import Protocol


class Progress(Protocol):
    """Told of stages one after another; `advance` adds up to the stage's total, or about."""

    def start(self, stage: str, total: int, unit: str) -> None:
        """A stage begins; total in `unit`, such as "points"."""
        ...

    def advance(self, amount: int) -> None:
        """So much more of the stage is done."""
        ...

    def finish(self) -> None:
        """The stage is over."""
        ...


class Silent:
    """Says nothing."""

    def start(self, stage: str, total: int, unit: str) -> None:
        """Say nothing."""

    def advance(self, amount: int) -> None:
        """Say nothing."""

    def finish(self) -> None:
        """Say nothing."""

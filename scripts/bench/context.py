"""What the sections share, made once when first asked for: the façade, its archives, and every side opened on it."""

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from solidcloud.builder.made.facade import build_facade
from solidcloud.builder.made.figure import figure_points
from solidcloud.builder.made.truth import FacadeTruth

from .archives import facade_archives
from .poses import Floats, walk_at
from .results import Part
from .sides import OURS, Place

T = TypeVar("T")
RATE = 30.0  # frames a second of the walk: 1,200 poses


class Bench:
    """One run of the benchmark.

    options: the command line.  folder: scratch.  program: of the peers, or why there is none.  stack: closes what is
    opened.  rng: of every jitter.
    """

    def __init__(
        self, options: argparse.Namespace, folder: Path, program: Path | str, stack: ExitStack
    ) -> None:
        self.options, self.folder, self.program, self.stack = options, folder, program, stack
        self.loops: int = options.loops
        self.rng = np.random.default_rng(options.seed)

    @cached_property
    def truth(self) -> FacadeTruth:
        """Of the façade; its own frame is the world."""
        return build_facade().truth

    @cached_property
    def avatar(self) -> Floats:
        """The figure of 3,617 points."""
        return figure_points()

    @cached_property
    def walk(self) -> Floats:
        """The walk of 1,200 poses."""
        return walk_at(self.truth, RATE)

    @cached_property
    def archives(self) -> dict[int, Path]:
        """Voxel [m] -> archive of the façade; those given, or made."""
        given: list[Path] = self.options.facade
        if given:
            return dict(zip((32, 8), given, strict=True))
        return facade_archives(self.folder)

    @cached_property
    def facade(self) -> Place:
        """The façade with every side ready."""
        archives = {our_name(voxel): path for voxel, path in self.archives.items()}
        return Place(archives, self.avatar, self.walk, self.program, self.folder / "peers", self.stack)


def our_name(voxel: int) -> str:
    """What our side is called with voxels of this size [m]."""
    return f"{OURS}, voxel {voxel} m"


def attempt(part: Part, what: str, call: Callable[[], T]) -> T | None:
    """What `call` gives; None where this engine does not answer that question yet, which is then said."""
    try:
        return call()
    except NotImplementedError as error:
        part.missing.append(f"{what}: {error or 'this engine does not answer it yet'}")
        return None

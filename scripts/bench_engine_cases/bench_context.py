"""State that the sections share, created on first use: the façade, its archives, the opened sides."""

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from measurement.measured_archives import facade_archives
from measurement.query_poses import Floats, walk_at
from solidcloud.builder.synthetic.facade import build_facade
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.builder.synthetic.truth import FacadeTruth
from solidcloud.server.report.common.bench_results import Part

from .compared_sides import OURS, Place

T = TypeVar("T")
RATE = 30.0  # frames per second of the walk: 1,200 poses


class Bench:
    """One run of the benchmark.

    options: the command line.
    folder: scratch.
    program: of the peers, or the reason for its absence.
    stack: closes everything opened.
    rng: of every jitter.
    """

    def __init__(
        self, options: argparse.Namespace, folder: Path, program: Path | str, stack: ExitStack
    ) -> None:
        self.options, self.folder, self.program, self.stack = options, folder, program, stack
        self.loops: int = options.loops
        self.rng = np.random.default_rng(options.seed)

    @cached_property
    def truth(self) -> FacadeTruth:
        """Return the truth of the façade; its own frame is the world."""
        return build_facade().truth

    @cached_property
    def avatar(self) -> Floats:
        """Return the figure of 3,617 points."""
        return figure_points()

    @cached_property
    def walk(self) -> Floats:
        """Return the walk of 1,200 poses."""
        return walk_at(self.truth, RATE)

    @cached_property
    def archives(self) -> dict[int, Path]:
        """Return voxel [m] -> archive of the façade, from the command line or generated."""
        given: list[Path] = self.options.facade
        if given:
            return dict(zip((32, 8), given, strict=True))
        return facade_archives(self.folder)

    @cached_property
    def facade(self) -> Place:
        """Return the façade with every side ready."""
        archives = {our_name(voxel): path for voxel, path in self.archives.items()}
        return Place(archives, self.avatar, self.walk, self.program, self.folder / "peers", self.stack)


def our_name(voxel: int) -> str:
    """Return the name of our side with voxels of this size [m]."""
    return f"{OURS}, voxel {voxel} m"


def attempt(part: Part, what: str, call: Callable[[], T]) -> T | None:
    """Return the result of `call`; None, with a note in `part`, where this engine lacks the query."""
    try:
        return call()
    except NotImplementedError as error:
        part.missing.append(f"{what}: {error or 'this engine does not answer it yet'}")
        return None

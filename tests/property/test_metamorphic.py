"""What changes no contact: a scene moved, turned, shuffled, or cut up otherwise, 40 or 120 draws of each.

No judge is needed: a scene and its image are asked the same. Lattice points and translations are whole multiples of
powers of two, so that an image is exact. Sums of a turned body's coordinates are not: the origin of a turned or shifted
scene may round one the other way, by a unit of 15 nm, once in 2^27 coordinates; the draws are fixed.
"""

from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import archive_cases
import numpy as np
import pytest
from numpy.typing import NDArray
from point_clouds import KINDS, cloud, signed_permutations
from sample_sizes import sample
from solidcloud.server.scene import Scene

# Scenes of an archive, far apart, so that 40 draws take 4 builds.
SCENES = 10
ARCHIVES = sample(4, 12)
APART = 64 * 1024  # [STEP]
STEP = archive_cases.BINARY_STEP
POINTS, BODY = 40, 12
RADIUS, MARGIN = 0.01, 2.0**-8

Contacts = Counter[tuple[int, ...]]


class Drawn(NamedTuple):
    """Scenes of one archive and a question for each.

    lattice: (n, 3) int64 [STEP].  body: (m, 3) [m].  poses: (SCENES, 4, 4).  options: of the build.
    """

    lattice: NDArray[np.int64]
    body: NDArray[np.float64]
    poses: NDArray[np.float64]
    options: dict[str, Any]


def tree_options(rng: np.random.Generator) -> dict[str, Any]:
    """Any voxels and any trees."""
    return {
        "voxel": float(rng.choice([0.2, 0.4, 1.0, 8.0, 300.0])),
        "degree": int(rng.choice([2, 3, 8, 16])),
        "leaf": int(rng.choice([1, 5, 32])),
        "cell_points": int(rng.choice([1, 10, 4096])),
        "cells": str(rng.choice(["octree", "balanced"])),
        "with_slab": bool(rng.integers(2)),
    }


@lru_cache(maxsize=ARCHIVES)
def draw(seed: int) -> tuple[Drawn, Contacts]:
    """Scenes of all kinds, a pose near each, and their contacts."""
    rng = np.random.default_rng(seed)
    body = np.rint(cloud(rng, KINDS[seed % len(KINDS)], BODY) * 0.1 * 2.0**20) * 2.0**-20
    lattices, poses = [], []
    for number in range(SCENES):
        lattice = np.rint(cloud(rng, KINDS[(seed + number) % len(KINDS)], POINTS) * 0.25 / STEP)
        lattice += [number * APART, 0, 0]
        poses.append(archive_cases.near_poses(rng, lattice * STEP, body, 1, 0.03)[0])
        lattices.append(lattice.astype(np.int64))
    asked = np.array(poses)
    asked[:, :3, 3] = np.rint(asked[:, :3, 3] * 2.0**20) * 2.0**-20
    drawn = Drawn(np.concatenate(lattices), body, asked, tree_options(rng))
    return drawn, contacts(drawn)


def contacts(drawn: Drawn, shift: NDArray[np.float64] | float = 0.0) -> Contacts:
    """How often which row of the body touches which lattice point under which pose; shift: of the scene [m]."""
    found: Contacts = Counter()
    with TemporaryDirectory() as folder:
        case = archive_cases.build(
            Path(folder), drawn.lattice * STEP + shift, resolution=STEP, radius=RADIUS, **drawn.options
        )
        with Scene.open(case.archive) as scene:
            scene.add_avatar("body", drawn.body, RADIUS)
            answers = scene.contacts("body", drawn.poses, 10_000, MARGIN)
            verdict = scene.collide("body", drawn.poses, MARGIN).verdict
    assert answers.exact.all() and (np.diff(answers.pair_starts) == answers.pairs_found).all()
    assert verdict.tolist() == (answers.pairs_found > 0).astype(int).tolist()
    pose = np.repeat(np.arange(len(drawn.poses)), answers.pairs_found)
    where = np.rint((answers.cloud_point - shift) / STEP).astype(np.int64)
    found.update(zip(pose.tolist(), answers.avatar_index.tolist(), *where.T.tolist(), strict=True))
    return found


def check(image: Callable[[np.random.Generator, Drawn], Contacts]) -> None:
    """Assert that what `image` finds of each draw's image, told as of the draw itself, are the draw's contacts."""
    touching = 0
    for seed in range(ARCHIVES):
        drawn, expected = draw(seed)
        found = image(np.random.default_rng([seed, 1]), drawn)
        assert found == expected, f"seed {seed}: lost {expected - found}, invented {found - expected}"
        touching += len({pose for pose, *_ in expected})
    assert SCENES * ARCHIVES / 4 < touching < SCENES * ARCHIVES


@pytest.mark.case(27, "200 scenes moved by whole metres up to 10^7: the same set of contacts")
def test_translation_changes_no_contact() -> None:
    def moved(rng: np.random.Generator, drawn: Drawn) -> Contacts:
        shift = rng.integers(-(10**7), 10**7 + 1, 3).astype(float)
        poses = drawn.poses.copy()
        poses[:, :3, 3] += shift
        return contacts(drawn._replace(poses=poses), shift)

    check(moved)


@pytest.mark.case(27, "200 scenes turned by quarter turns about any axes: the same set of contacts")
def test_quarter_turns_change_no_contact() -> None:
    turns = signed_permutations()

    def turned(rng: np.random.Generator, drawn: Drawn) -> Contacts:
        turn = turns[rng.integers(1, 24)]
        poses = drawn.poses.copy()
        poses[:, :3] = turn @ poses[:, :3]
        lattice = (drawn.lattice @ turn.T).astype(np.int64)
        back = turn.T.astype(int)
        found = contacts(drawn._replace(lattice=lattice, poses=poses))
        return Counter({(pose, row, *(back @ point).tolist()): n for (pose, row, *point), n in found.items()})

    check(turned)


@pytest.mark.case(27, "200 scenes and bodies with their points in another order: the same set of contacts")
def test_permutation_changes_no_contact() -> None:
    def shuffled(rng: np.random.Generator, drawn: Drawn) -> Contacts:
        order = rng.permutation(len(drawn.body))
        found = contacts(drawn._replace(lattice=rng.permutation(drawn.lattice), body=drawn.body[order]))
        return Counter({(pose, int(order[row]), *point): n for (pose, row, *point), n in found.items()})

    check(shuffled)


@pytest.mark.case(11, "200 scenes in voxels of 20 cm to 300 m and other trees: the same set of contacts")
def test_voxels_and_trees_change_no_contact() -> None:
    check(lambda rng, drawn: contacts(drawn._replace(options=tree_options(rng))))


@pytest.mark.case(11, "200 scenes with the grid of voxels shifted by a stray point: the same set of contacts")
def test_a_shifted_grid_changes_no_contact() -> None:
    def shifted(rng: np.random.Generator, drawn: Drawn) -> Contacts:
        # Out of reach of everything; the origin, and with it the grid, lie there then.
        stray = drawn.lattice.min(axis=0) - rng.integers(1024, 4096, 3)
        return contacts(drawn._replace(lattice=np.vstack([drawn.lattice, stray])))

    check(shifted)

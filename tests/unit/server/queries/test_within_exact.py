"""`within` to the unit: a point at the reach is found, one beyond is not, and of equal distances the least is named."""

from pathlib import Path

import naive
import numpy as np
import pytest
import query_scenes
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict

pytestmark = pytest.mark.interpreted


def nearest(points: NDArray[np.int64], query: NDArray[np.int64]) -> tuple[int, list[int]]:
    """The least square [exact units^2] and the least (x, y, z) of the points at it, in Python's integers."""
    return min((sum(d * d for d in (row - query).tolist()), row.tolist()) for row in points)


@pytest.mark.parametrize("kind", ["fine", "flat"])
def test_the_nearest_and_the_reach_are_those_of_the_definition(tmp_path: Path, kind: str) -> None:
    with query_scenes.opened(query_scenes.build(tmp_path, kind), "within") as scene:
        info = scene.info()
        origin = np.array(info.origin)
        lattice = naive.lattice_of(query_scenes.scene_points(kind), origin, info.lattice_step)
        units = naive.scan_units(lattice, info.lattice_step)
        # Halfway between two points both are at one distance, and no other is nearer where the two are neighbours.
        near = [
            units[np.argsort(((units - row) ** 2).sum(axis=1).astype(float))[1:3]]
            .mean(axis=0)
            .astype(np.int64)
            for row in units[::9]
        ]
        pairs = np.array([(a + units[0]) // 2 for a in units[1::9]])
        loose = np.rint((query_scenes.loose() - origin) * naive.UNITS).astype(np.int64)
        # Metres away, where float32 tells points apart by no less than some thousandths of a step.
        rng = np.random.default_rng(7)
        away = rng.normal(size=(40, 3))
        away *= (rng.uniform(1, 14, 40) / np.sqrt((away**2).sum(axis=1)))[:, None] * naive.UNITS
        far = units[rng.integers(len(units), size=40)] + away.astype(np.int64)
        queries = np.concatenate([near, pairs, loose, units[:3], far])
        ties = 0
        for query in queries:
            square, least = nearest(units, query)
            ties += int((((units - query).astype(object) ** 2).sum(axis=1) == square).sum() > 1)
            root = int(np.sqrt(float(square)))
            root += next(more for more in range(-3, 4) if (root + more) ** 2 >= square)
            place = (query / naive.UNITS + origin)[None]
            if not np.array_equal(np.rint((place[0] - origin) * naive.UNITS), query):
                continue
            for reach, verdict in ((root, Verdict.CONTACT), (root - 1, Verdict.CLEAR)):
                if reach < 0:
                    continue
                said = scene.within(place, reach / naive.UNITS)
                assert said.verdict[0] == verdict, (query, reach)
            said = scene.within(place, 15.0)
            found = np.rint((said.cloud_point[0] - origin) * naive.UNITS).astype(int).tolist()
            assert found == least
        assert ties > 5

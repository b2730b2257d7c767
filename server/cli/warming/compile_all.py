"""Compilation of all kernels, with all cores: `python -m solidcloud.server.cli.warming.compile_all`.

What a build of a LAZ file, a server of an archive or of a scene with all effects, and the first
queries in one process need is then in the folder of compiled kernels. scripts/build_wheel delivers it
and scripts/bench_compile measures it. Needs the extra `made`.
"""

import os
import tempfile
from pathlib import Path

import numpy as np

from ....builder.config import BuildConfig
from ....builder.pipeline import build_archive
from ....builder.synthetic.scenes import make_facade
from ....schemas.scene.effect_table import ORDER
from ...scene import Scene
from .parallel_warming import warmed_in_parallel

POINTS = 50_000


def write_scene_file(archive: Path) -> Path:
    """Write a scene file with all effects beside an archive; return its path."""
    effects = "".join(f'\n[[effects]]\neffect = "{name}"\n' for name in (*ORDER, "through"))
    box = 'boxes = [{name = "door", low = [-1.0, -1.0, 0.0], high = [1.0, 1.0, 2.0]}]\n'
    path = archive.parent / "effects.toml"
    path.write_text(f'format = 1\n\n[[archives]]\npath = "{archive.name}"\n{effects}{box}')
    return path


def ask_first(archive: Path) -> None:
    """Open an archive and make one `collide`."""
    with Scene.open(archive) as scene:
        points = np.random.default_rng(1).uniform(-0.3, 0.3, (1000, 3))
        scene.add_avatar("user", points, 0.05)
        scene.collide("user", np.eye(4)[None])


def main() -> None:
    """Do everything once whose kernels are to be compiled."""
    with tempfile.TemporaryDirectory(prefix="solidcloud-compile-") as folder:
        archive = Path(folder, "archive")
        scan = make_facade(Path(folder, "scan.laz"), points=POINTS)
        build_archive(scan.paths, archive, BuildConfig(jobs=len(os.sched_getaffinity(0))))
        for what in (write_scene_file(archive), archive):
            with warmed_in_parallel(what), Scene.open(what) as scene:
                scene.warm()
        ask_first(archive)


if __name__ == "__main__":
    main()

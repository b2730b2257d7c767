"""Python interface of the peers program: builds it with a nightly Rust, sends arrays, runs loops."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def build_peers(cache: Path) -> Path | str:
    """Build the program into the folder `cache` and return it; or return the reason why there is none."""
    command = _nightly()
    if command is None:
        return "no nightly cargo found: `rustup toolchain install nightly`, then run this again"
    environment = {**os.environ, "CARGO_TARGET_DIR": str(cache), "RUSTFLAGS": "-C target-cpu=native"}
    command += ["build", "--release", "--locked", "--quiet"]
    done = subprocess.run(command, cwd=Path(__file__).parent, env=environment, capture_output=True, text=True)
    if done.returncode:
        print(done.stderr, file=sys.stderr)
        return "scripts/peers does not build here: the compiler's reason is on standard error"
    return cache / "release" / "peers"


def _nightly() -> list[str] | None:
    """Return the command of a nightly cargo: by rustup's switch, or the only one installed."""
    cargo = shutil.which("cargo")
    for command in ([cargo, "+nightly"], [cargo]) if cargo else ():
        version = subprocess.run([*command, "--version"], capture_output=True, text=True)
        if version.returncode == 0 and "nightly" in version.stdout:
            return command
    return None


def _flat(poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return poses (k, 4, 4) as README.md describes them, (k, 12)."""
    return np.concatenate([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]], axis=1).astype("<f4")


class Peers:
    """Program kept running on one case, which lets its loops alternate with another side's.

    sides: name -> the description of a side as in README.md.
    A context manager: the program ends with it.
    """

    def __init__(
        self,
        program: Path,
        folder: Path,
        scene: NDArray[np.float64],
        avatar: NDArray[np.float64],
        poses: NDArray[np.float64],
        distance: float,
        loops: int,
    ) -> None:
        """Write the case into `folder`, start the program and wait until it has tried every setting.

        scene: (n, 3) and avatar: (m, 3) [m].
        poses: (k, 4, 4), avatar to the scene's frame, whose origin must be near, because everything
        becomes float32.
        distance: sum of both radii [m].
        """
        self.folder = folder
        for name, rows in (("scene", scene), ("avatar", avatar), ("poses", _flat(poses))):
            rows.astype("<f4").tofile(folder / f"{name}.f32")
        words = [program, folder, distance, "--loops", loops, "--per-pose", folder, "--turns"]
        self.process = subprocess.Popen(
            [str(word) for word in words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.sides: dict[str, dict] = json.loads(self._line())["sides"]

    def __enter__(self) -> "Peers":
        """Return the program."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the program's input, which ends it."""
        self.process.communicate()

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"scripts/peers: exit code {self.process.wait()}: its reason is above")
        return line

    def turn(self, name: str, file: Path | None = None) -> float:
        """Run one loop of a side over all poses or a file's, after a warm-up loop; return [us per pose]."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{name} {file}\n" if file else f"{name}\n")
        self.process.stdin.flush()
        return float(self._line())

    def give(self, label: str, poses: NDArray[np.float64]) -> Path:
        """Write other poses (k, 4, 4), avatar to the scene's frame, to a file for `turn`."""
        file = self.folder / f"{label}.f32"
        _flat(poses).tofile(file)
        return file

    def touching_of(self, name: str, file: Path) -> NDArray[np.bool_]:
        """Return which poses (k,) of a file touch, according to a side that has run a turn with it."""
        return np.fromfile(f"{file}.{name}.u8", np.uint8) == 1

    def touching(self, name: str) -> NDArray[np.bool_]:
        """Return which poses (k,) touch, according to this side."""
        return np.fromfile(self.folder / f"{name}.verdicts.u8", np.uint8) == 1

    def each(self, name: str) -> NDArray[np.float32]:
        """Return the least time of each pose (k,) [us]."""
        return np.fromfile(self.folder / f"{name}.us.f32", "<f4")

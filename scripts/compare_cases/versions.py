"""Shared code of comparisons of two versions: cases, names in either version, a checkout of a commit."""

import contextlib
import importlib
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

# Cases whose speed is compared; a build takes much longer than the others.
DEFAULT_CASES = (
    "collide", "single", "distance", "contacts", "sweep", "raycast", "within", "objects", "path",
    "frame", "crowd", "round_trip", "session",
)  # fmt: skip
CASES = (*DEFAULT_CASES, "build")
EFFECTS = ("stop", "sweep", "slide", "step", "ground")


def find(name: str, *modules: str) -> Any:
    """Return a name from the first of these modules that has it; versions differ in where it is defined.

    name: names, separated by spaces, of which one version has one and another another.
    """
    for module in modules:
        with contextlib.suppress(ModuleNotFoundError):
            found = importlib.import_module(f"solidcloud.{module}")
            for each in name.split():
                if hasattr(found, each):
                    return getattr(found, each)
    raise ImportError(f"{name} is in none of {', '.join(modules)}")


def base_checkout(root: Path, commit: str, stack: ExitStack) -> Path:
    """Check out a commit into a temporary folder, install it there, and return the folder."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="solidcloud-base-")), "base")
    subprocess.run(["git", "-C", str(root), "worktree", "add", "--detach", str(folder), commit], check=True)
    stack.callback(
        subprocess.run, ["git", "-C", str(root), "worktree", "remove", "--force", str(folder)], check=False
    )
    subprocess.run([str(folder / "scripts" / "setup")], check=True)
    return folder


def scene_file(archive: Path, *more: str) -> Path:
    """Write the scene file of a walk, with `more` effects, beside the archive; return its path."""
    path = archive.parent / f"{'-'.join(['walk', *more])}{sys.prefix.replace('/', '-')}.toml"
    effects = "".join(f'\n[[effects]]\neffect = "{effect}"\n' for effect in (*EFFECTS, *more))
    path.write_text(f'format = 1\n\n[[archives]]\npath = "{archive}"\n{effects}')
    return path

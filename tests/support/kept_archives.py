"""Archives that this process has built before: copied, not built again."""

import atexit
import functools
import hashlib
import itertools
import shutil
import tempfile
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

import compiled_builds
import pytest
import radius_class_archives
import solidcloud.builder.pipeline as pipeline
from sample_sizes import sample
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.verify import VerifyReport
from solidcloud.builder.pipeline import build_archive

# Larger archives are not kept [bytes of all scans].
MOST_BYTES = 1 << 20
# One in so many archives is verified, which takes a fifth of the build of a small one; with the fixture `builds_here`
# all are.
VERIFIED = sample(8, 1)
_kept: dict[Hashable, Path] = {}
_builds = itertools.count()


def build_or_copy(scans: Sequence[Path], target: Path, config: BuildConfig) -> None:
    """Build an archive of scans in `target`, or copy the one that was built of equal scans with equal options.

    A copy names the paths of the scans that it was built of. Their names are equal, their folders may not be.
    """
    contents = tuple((scan.name, hashlib.sha256(scan.read_bytes()).digest()) for scan in scans)
    key = (contents, repr(config), radius_class_archives.replaced_classes())
    if key in _kept:
        shutil.copytree(_kept[key], target)
        return
    if radius_class_archives.replaced_classes() or not compiled_builds.build_compiled(scans, target, config):
        with nullcontext() if compiled_builds.here or next(_builds) % VERIFIED == 0 else _unverified():
            build_archive(scans, target, config)
    if sum(scan.stat().st_size for scan in scans) <= MOST_BYTES:
        _kept[key] = Path(shutil.copytree(target, _folder() / str(len(_kept))))


@contextmanager
def _unverified() -> Iterator[None]:
    """Let builds in this process end without verifying the archive."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "verify_archive", lambda *_, **__: VerifyReport(0, 0, ()))
        yield


@functools.cache
def _folder() -> Path:
    """Make a folder that lasts as long as the process."""
    folder = Path(tempfile.mkdtemp(prefix="solidcloud-archives-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder

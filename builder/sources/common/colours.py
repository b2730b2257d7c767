"""Colours and classes of points: their names in files, and eight bits of each channel.

Files store a channel in 8 bits, in 16, or as a fraction of 1, and many store 8 bits in fields of 16
without saying so. The brightest channel of a scan decides, as in other programs: readers deliver
the numbers of the file, the survey finds the greatest of a scan, and `eight_bits` converts.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import BadRequestError

# Names of red, green and blue, and of the class, in lower case; the first that a file has are used.
COLOUR_NAMES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
CLASS_NAMES = ("classification", "scalar_classification", "class", "label")
# Columns of a scan besides its coordinates, as `Scan.columns` names them.
INTENSITY, RGB, CLASSIFICATION = "intensity", "rgb", "classification"
# Drop reasons of points that their file flags as deleted, and as made by a program; and, with a
# number, of the points of a class. Withheld points are always left out, the others on request.
WITHHELD, SYNTHETIC, CLASS = "withheld", "synthetic", "class"


def parse_classes(text: str) -> frozenset[int | str]:
    """Parse `--drop-classes`, such as `7,18,synthetic`; raise BadRequestError for anything else."""
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not all(word == SYNTHETIC or (word.isdecimal() and int(word) < 256) for word in words):
        raise BadRequestError(
            f"--drop-classes {text}: expected numbers from 0 to 255, or {SYNTHETIC}, separated by commas"
        )
    return frozenset(word if word == SYNTHETIC else int(word) for word in words)


def class_counts(classes: NDArray[np.uint8] | None) -> Counter[str]:
    """Return how many of points (n,) are in each class, and "points": n."""
    if classes is None:
        return Counter()
    counts = np.bincount(classes, minlength=256)
    return Counter(
        {"points": len(classes), **{f"{CLASS} {k}": int(counts[k]) for k in np.flatnonzero(counts)}}
    )


def find_columns(names: Sequence[str]) -> tuple[tuple[int, ...], int | None]:
    """Return the positions of red, green and blue, () without them, and of the class, or None.

    names: of all columns of a file. A name that occurs twice names nothing.
    """
    lower = [name.lower() for name in names]
    once = {name: at for at, name in enumerate(lower) if lower.count(name) == 1}
    colours = next((tuple(once[n] for n in three) for three in COLOUR_NAMES if once.keys() >= set(three)), ())
    return colours, next((once[name] for name in CLASS_NAMES if name in once), None)


def stack_channels(channels: Sequence[NDArray]) -> NDArray:
    """Return the channels (n,) of a colour as (n, 3) in the type in which a block carries them.

    Bytes stay bytes; other integers become uint16, and floating-point numbers float32.
    """
    kinds = {channel.dtype for channel in channels}
    if kinds == {np.dtype(np.uint8)}:
        return np.stack(channels, axis=1)
    if all(kind.kind in "iu" for kind in kinds):
        return np.stack([np.clip(channel, 0, 65535) for channel in channels], axis=1).astype(np.uint16)
    return np.stack(channels, axis=1, dtype=np.float32, casting="unsafe")


def brightest(rgb: NDArray | None) -> float:
    """Return the greatest finite channel of colours (n, 3), 0 without any."""
    if rgb is None or not rgb.size:
        return 0.0
    return float(np.where(np.isfinite(rgb), rgb, 0).max() if rgb.dtype.kind == "f" else rgb.max())


def eight_bits(rgb: NDArray, greatest: float) -> NDArray[np.uint8]:
    """Return colours (n, 3) in eight bits a channel.

    greatest: the brightest channel of the scan. Bytes are kept. If no channel exceeds 255, other
    numbers are 8-bit values too; if one does, they have 16 bits, and the high byte is kept.
    Fractions, which are floating-point numbers of which none exceeds 1, are multiplied by 255. NaN
    and negative numbers become 0.
    """
    if rgb.dtype == np.uint8:
        return rgb
    if greatest > 255:
        return whole_bytes(rgb // 256)
    return whole_bytes(rgb * np.float32(255) if rgb.dtype.kind == "f" and greatest <= 1 else rgb)


def whole_bytes(values: NDArray) -> NDArray[np.uint8]:
    """Return numbers rounded to whole ones from 0 to 255; NaN becomes 0."""
    if values.dtype.kind == "f":
        values = np.rint(np.nan_to_num(values, nan=0.0))
    return np.clip(values, 0, 255).astype(np.uint8)

"""Sizes of random samples: few in a usual run; as many as documents state with SOLIDCLOUD_SAMPLES=many.

scripts/make_hard_cases sets it, so that the table of hard cases is that of the large samples.
"""

import os
from typing import TypeVar

T = TypeVar("T")
MANY = os.environ.get("SOLIDCLOUD_SAMPLES") == "many"


def sample(few: T, many: T) -> T:
    """Return the size of a sample: `few`, or `many` where the environment asks for it."""
    return many if MANY else few

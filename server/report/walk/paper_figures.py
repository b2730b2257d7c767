"""Measurements of [Fig12], table 1."""

from typing import Any

from ..common.paper_case import PAPER_POINTS

PAPER_MACHINE = (
    "laptop, Core 2 Duo T9300 2.5 GHz, 4 GB, GeForce 8800M GTX, rendering included ([Fig12] section 7)"
)
PAPER_FPS = {4: 18.75, 6: 18.19, 8: 17.38, 10: 21.25, 12: 15.40, 14: 17.88, 16: 16.14}
PAPER_MB = {4: 39.46, 6: 36.84, 8: 35.21, 10: 45.95, 12: 45.15, 14: 36.50, 16: 45.97}


def paper_rows(degrees: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the rows of the paper's table 1.

    Its frames include rendering; its Mb are read as 10^6 bytes.
    """
    return [
        {
            "degree": degree,
            "structure": "paper",
            "fps_30_loop": PAPER_FPS[degree],
            "resident_mb": PAPER_MB[degree],
            "resident_bytes_per_point": PAPER_MB[degree] * 1e6 / PAPER_POINTS,
        }
        for degree in degrees
        if degree in PAPER_FPS
    ]

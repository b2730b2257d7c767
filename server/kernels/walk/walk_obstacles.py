"""Queries about other bodies: in a scene without `crowd`, `Walk.standing` is None, and Python answers them.

The code for bodies is then neither imported nor compiled (NUMERICS.md case 31). numba chooses by the type of
`standing`. The digest of compiled code covers walk_bodies.py too, because the functions below import it.
"""

from typing import Any

from ....schemas.kernels import compiling as nb
from .walk_state import BODIES_SWEPT


def first_body(walk: Any, standing: Any, to: Any, tolerance: float, below: bool, until: float) -> int:
    """Return what `find_first_body` returns: the query for Python; -1 if no body is in the way."""
    if standing is None:
        return BODIES_SWEPT
    from .walk_bodies import find_first_body

    found: int = find_first_body(walk, standing, to, tolerance, below, until)
    return found


def touches_no_body(walk: Any, standing: Any, pose: Any) -> bool:
    """Return what `is_clear_of_bodies` returns; False without bodies, for Python to answer."""
    if standing is None:
        return False
    from .walk_bodies import is_clear_of_bodies

    found: bool = is_clear_of_bodies(walk, standing, pose)
    return found


@nb.overload(first_body)
def _first_body(walk, standing, to, tolerance, below, until):
    if isinstance(standing, nb.types.NoneType):
        return lambda walk, standing, to, tolerance, below, until: BODIES_SWEPT
    from .walk_bodies import find_first_body

    return lambda walk, standing, to, tolerance, below, until: find_first_body(
        walk, standing, to, tolerance, below, until
    )


@nb.overload(touches_no_body)
def _touches_no_body(walk, standing, pose):
    if isinstance(standing, nb.types.NoneType):
        return lambda walk, standing, pose: False
    from .walk_bodies import is_clear_of_bodies

    return lambda walk, standing, pose: is_clear_of_bodies(walk, standing, pose)

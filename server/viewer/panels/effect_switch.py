"""Effects that a scene runs, and the viewer's switch for them.

A session cannot skip effects, and a server reads a scene's effects when it opens it. Effects of a
server that the viewer has not started are therefore shown only.
"""

import inspect
from collections.abc import Sequence
from typing import Protocol, get_args

from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import AnyEffect
from ..page.page_messages import text_message

_KINDS = {str(kind.__struct_config__.tag): kind for kind in get_args(AnyEffect)}


class EffectSwitch(Protocol):
    """Server whose effects can be changed.

    declared: names of the effects that can be switched on, in any order; empty: none can be.
    """

    @property
    def declared(self) -> Sequence[str]: ...

    def change(self, names: Sequence[str]) -> None:
        """Serve the same scene with these of the declared effects. Raise SolidcloudError."""


class NoSwitch:
    """Of a server that others have started."""

    declared: Sequence[str] = ()

    def change(self, names: Sequence[str]) -> None:
        """Raise BadRequestError."""
        raise BadRequestError(
            f"effects {', '.join(names)}: this viewer has not started the server: change [[effects]] in its scene "
            "file, and start it again"
        )


def effects_message(running: Sequence[str], switch: EffectSwitch) -> str:
    """Return the effects of a scene as a message for the page.

    running: names of those that it runs.  switch: of its server.
    """
    names = [*running, *(name for name in switch.declared if name not in running)]
    return text_message(
        "effects",
        switchable=bool(switch.declared),
        effects=[
            {
                "name": name,
                "on": name in running,
                "meaning": meaning(name),
                "needs": list(_KINDS[name].needs) if name in _KINDS else [],
            }
            for name in sorted(names, key=place)
        ],
    )


def place(name: str) -> int:
    """Return the place of an effect in the table; those of a newer server are last."""
    return list(_KINDS).index(name) if name in _KINDS else len(_KINDS)


def meaning(name: str) -> str:
    """Return a sentence on what an effect does: the first one of its documentation."""
    kind = _KINDS.get(name)
    return (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("\n", " ") if kind else ""

"""`solidcloud query`: send collision queries to a server.

The options of questions are written out here and not read from schemas/wire/question_table.py: typer
builds the options of all commands at each start, which importing the declarations would double.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .command_options import (
    AsJson,
    AvatarHollow,
    AvatarUnits,
    AvatarUp,
    KeyFile,
    among,
    avatar_options,
    print_avatar,
    print_error,
    print_json,
    print_warning,
)

if TYPE_CHECKING:
    from ...client import Client
    from ...scene_interface import AvatarShape

# Options that are not parameters of the query.
_NOT_OF_THE_QUESTION = ("scene", "op", "connect", "key_file", "as_json")
_ALONG = ("collide", "distance", "contacts", "sweep")


def query(
    scene: Annotated[str, typer.Option(help="Name of the scene.")],
    op: Annotated[
        str,
        typer.Option(
            help="collide, distance, contacts, sweep, raycast, within, objects, move, or path (answered in parts).",
            autocompletion=among(*_ALONG, "raycast", "within", "objects", "move", "path"),
        ),
    ] = "collide",
    avatar: Annotated[
        Path | None, typer.Option(help="The avatar: points or a mesh, in any format that build reads.")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of poses: t,x,y,z,qw,qx,qy,qz. sweep and move examine the motions from each pose to the "
            "next, the other queries only the poses."
        ),
    ] = None,
    rays: Annotated[Path | None, typer.Option(help="CSV file of rays: x,y,z,dx,dy,dz.")] = None,
    points: Annotated[
        Path | None, typer.Option(help="Points of within: a file in any format that build reads.")
    ] = None,
    objects: Annotated[
        Path | None, typer.Option(help="CSV file of objects: avatar,x,y,z,qw,qx,qy,qz,group,mask.")
    ] = None,
    along: Annotated[
        str | None,
        typer.Option(
            help="Query along a path: collide (default), distance or contacts at its poses, or sweep between them.",
            autocompletion=among(*_ALONG),
        ),
    ] = None,
    connect: Annotated[str, typer.Option(help="Zenoh endpoint of the server.")] = "tcp/127.0.0.1:7447",
    margin: Annotated[
        float | None, typer.Option(help="Gap up to which two spheres count as in contact [m]; default 0.")
    ] = None,
    reach: Annotated[
        float | None, typer.Option(help="Maximum distance to report [m]; distance: 1 by default.")
    ] = None,
    limit: Annotated[
        int | None, typer.Option(help="Contacts listed per pose, deepest first; default 100.")
    ] = None,
    cluster_distance: Annotated[
        float | None, typer.Option(help="Maximum distance between neighbouring points of one cluster [m].")
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option(
            help="Radius of an avatar point [m]; default: half the mean closest-point distance; of a mesh a hundredth "
            "of the square root of its area."
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="collide, distance, contacts, sweep: distance by which contact may be reported early [m]; default "
            "0, for sweep 1e-6."
        ),
    ] = None,
    relative_tolerance: Annotated[
        float | None,
        typer.Option(
            help="distance: allowed error as a share of the gap between centres, 0.3 for 30 %; default 0."
        ),
    ] = None,
    budget_ms: Annotated[
        float | None, typer.Option(help="Time limit of the whole query [ms]; default: none.")
    ] = None,
    radius_model: Annotated[
        str | None,
        typer.Option(
            help="Radii of the scan's points: mean, local, border or local+border, each with an optional factor as "
            "in local:0.8, or fixed:METRES; default: the one radius stored with the scene."
        ),
    ] = None,
    avatar_up: AvatarUp = None,
    avatar_units: AvatarUnits = None,
    avatar_hollow: AvatarHollow = None,
    key_file: KeyFile = None,
    as_json: AsJson = False,
) -> int:
    """Query a server about poses, rays, points.

    Items that lie outside the scan's bounds, even with their reach, are counted in a warning on
    standard error.

    Exit code 1: no answer arrived; only the error is printed. If only some answers arrived, they
    are printed, the others are unknown, and the exit code is also 1. Answers that the server itself
    calls unknown (the time limit was reached, or data in reach could not be read) are counted on standard
    error, with exit code 0.
    """
    options = {name: value for name, value in locals().items() if name not in _NOT_OF_THE_QUESTION}
    from ...avatars.avatar_shape import read_avatar
    from ...client import Client
    from ..input.query_input import ask, check_query, joined
    from ..output.answer_text import answer_lines, answers_json, summary_line, unknown_line, word_of

    question = check_query(op, options)
    avatars = _Avatars(avatar_options(avatar_up, avatar_units, avatar_hollow))
    if op == "move":
        return _ask_moves(connect, scene, question, avatars, as_json, key_file)
    found, asked, printed = [], 0, 0
    with Client(connect, scene=scene, key_file=key_file) as client:
        for part in ask(client, question, lambda points: read_avatar(points).points, avatars.read):
            found.append(part)
            asked += len(part.labels)
            if as_json or client.unanswered == asked:
                continue  # printed once an answer arrives
            for each in found[printed:]:
                for line in answer_lines(each.labels, each.times, each.answers):
                    print(line, flush=op == "path")
            printed = len(found)
        _check_answered(client, asked, op)
        avatars.show()
        whole = joined(found)
        said: Any = whole.answers  # every answer type has verdict and outside
        outside = _warn_outside(client, whole.places, said.outside, said.verdict, word_of(said))
    if as_json:
        print_json(answers_json(whole.times, said, outside))
    else:
        print(summary_line(said, outside))
    return _report_unknown(client, op, word_of(said), asked, unknown_line(said, client.unanswered))


class _Avatars:
    """Avatars of a query. options: of their files."""

    def __init__(self, options: dict[str, Any]) -> None:
        self._options = options
        self._read: dict[Path, AvatarShape] = {}

    def read(self, file: Path, radius: float | None) -> "AvatarShape":
        """Return the shape of a file."""
        from ...avatars.avatar_shape import avatar_shape

        self._read[file] = avatar_shape(file, radius, **self._options)
        return self._read[file]

    def show(self) -> None:
        """Print what was taken of each file."""
        for file, shape in self._read.items():
            print_avatar(file, shape)


def _check_answered(client: "Client", asked: int, op: str) -> None:
    """Raise BusyError if no part of the query was answered."""
    from ....schemas.errors import BusyError

    if asked and client.unanswered == asked:
        raise BusyError(client.silence(op))


def _report_unknown(client: "Client", op: str, word: str, asked: int, line: str) -> int:
    """Warn on standard error about unanswered items, or else print `line` about unknown answers.

    Returns the exit code.
    """
    if client.unanswered:
        return print_error(
            f"{client.unanswered} of {asked} {word} were not answered: {client.silence(op)}", 1
        )
    if line:
        print_warning(line)
    return 0


def _warn_outside(client: "Client", places: Any, leaves: Any, verdicts: Any, word: str) -> Any:
    """Warn on standard error about places outside the scan.

    Returns a mask of them, or None if the server no longer answers.
    """
    from ....schemas.errors import BusyError
    from ..input.scan_bounds import lying_outside, outside_line

    if not leaves.any():
        return leaves
    try:
        info = client.info()
    except BusyError:  # the server has stopped since
        return None
    outside = lying_outside(places, leaves, verdicts, info)
    if outside.any():
        print_warning(outside_line(places, outside, info, word))
    return outside


def _ask_moves(
    connect: str, scene: str, question: Any, avatars: _Avatars, as_json: bool, key_file: Path | None
) -> int:
    """Send one move per frame and print one line each, or all as JSON; return the exit code."""
    import numpy as np

    from ....schemas.wire.answers import Verdict
    from ...client import Client
    from ..input.query_input import ask_moves
    from ..output.answer_text import move_line

    found: list[dict[str, Any]] = []
    waiting: list[str] = []
    with Client(connect, scene=scene, key_file=key_file) as client:
        places, frames = ask_moves(client, question, avatars.read)
        for label, moved in frames:
            found.append(moved.to_dict())
            waiting.append(move_line(label, moved))
            if not as_json and client.unanswered < len(found):
                print("\n".join(waiting))
                waiting.clear()
        _check_answered(client, len(found), "move")
        avatars.show()
        verdicts = np.array([moved.get("verdict", 0) for moved in found])
        outside = _warn_outside(client, places, np.ones(len(found), bool), verdicts, "motions")
    if as_json:
        lie = [None] * len(found) if outside is None else outside.tolist()
        print_json([{**moved, "outside_scan": lies} for moved, lies in zip(found, lie, strict=True)])
    count = int((verdicts == Verdict.UNKNOWN).sum())
    line = f"{count} of {len(found)} motions are unknown: data in reach could not be read" if count else ""
    return _report_unknown(client, "move", "motions", len(found), line)

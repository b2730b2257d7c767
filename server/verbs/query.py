"""`solidcloud query`: ask a server what something touches."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .options import AsJson, KeyFile, complain, print_json

if TYPE_CHECKING:
    from ..client import Client

# Options that are not parameters of what is asked.
_NOT_OF_THE_QUESTION = ("scene", "op", "connect", "key_file", "as_json")


def query(
    scene: Annotated[str, typer.Option(help="Name of the scene.")],
    op: Annotated[
        str,
        typer.Option(
            help="collide, distance, contacts, sweep, raycast, within, objects, move, or path in parts."
        ),
    ] = "collide",
    avatar: Annotated[
        Path | None, typer.Option(help="Points of the avatar: OBJ PLY XYZ and what build reads.")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of poses: t,x,y,z,qw,qx,qy,qz; a sweep or move goes from each to the next."
        ),
    ] = None,
    rays: Annotated[Path | None, typer.Option(help="CSV file of rays: x,y,z,dx,dy,dz.")] = None,
    points: Annotated[Path | None, typer.Option(help="Loose points: PLY XYZ and what build reads.")] = None,
    objects: Annotated[
        Path | None, typer.Option(help="CSV file of objects: avatar,x,y,z,qw,qx,qy,qz,group,mask.")
    ] = None,
    along: Annotated[
        str | None, typer.Option(help="What path asks: collide (default), distance, contacts or sweep.")
    ] = None,
    connect: Annotated[str, typer.Option(help="zenoh endpoint of the server.")] = "tcp/127.0.0.1:7447",
    margin: Annotated[
        float | None, typer.Option(help="Distance below which it is contact [m]; default 0.")
    ] = None,
    reach: Annotated[float | None, typer.Option(help="Farthest distance worth reporting [m].")] = None,
    limit: Annotated[
        int | None, typer.Option(help="Contacts listed for a pose, the deepest; default 100.")
    ] = None,
    cluster_distance: Annotated[
        float | None, typer.Option(help="How far apart points of one cluster may lie [m].")
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option(help="Radius of an avatar point [m]; left out: half the mean closest-point distance."),
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="How early contact may be called [m]; default 0, of a sweep 1e-6.")
    ] = None,
    budget_ms: Annotated[float | None, typer.Option(help="Time for it all [ms]; default none.")] = None,
    budget_visits: Annotated[int | None, typer.Option(help="Node visits a pose; default none.")] = None,
    radius_model: Annotated[
        str | None,
        typer.Option(
            help="Radii of the scan's points: mean, local, border, local+border, each with a factor as in "
            "local:0.8 if wanted, or fixed:METRES; default: the scene's one figure."
        ),
    ] = None,
    key_file: KeyFile = None,
    as_json: AsJson = False,
) -> int:
    """Ask a server what poses of an avatar, rays, points or objects touch.

    Those that lie outside the scan's bounds, reach included, are counted, and said on standard error.

    Exit code 1: nobody answered; then nothing is printed but the error. Where only some answers did not come, what came
    is printed, the rest is unknown, and the exit code is 1 too. What the server itself calls unknown (its budget was
    spent, or what is in reach could not be looked at) is said on standard error, with exit code 0.
    """
    options = {name: value for name, value in locals().items() if name not in _NOT_OF_THE_QUESTION}
    from ..answer_text import answer_lines, answers_json, summary_line, unknown_line, word_of
    from ..client import Client
    from ..query import ask, check_query, joined
    from ..report.points import read_avatar

    question = check_query(op, options)
    if op == "move":
        return _ask_moves(connect, scene, question, as_json, key_file)
    found, asked, printed = [], 0, 0
    with Client(connect, scene=scene, key_file=key_file) as client:
        for part in ask(client, question, read_avatar):
            found.append(part)
            asked += len(part.labels)
            if as_json or client.unanswered == asked:
                continue  # printed once an answer comes
            for each in found[printed:]:
                for line in answer_lines(each.labels, each.times, each.answers):
                    print(line, flush=op == "path")
            printed = len(found)
        _check_answered(client, asked, op)
        whole = joined(found)
        said: Any = whole.answers  # every kind has verdict and outside
        outside = _outside(client, whole.places, said.outside, said.verdict, word_of(said))
    if as_json:
        print_json(answers_json(whole.times, said, outside))
    else:
        print(summary_line(said, outside))
    return _say_unknown(client, op, word_of(said), asked, unknown_line(said, client.unanswered))


def _check_answered(client: "Client", asked: int, op: str) -> None:
    """BusyError: nobody answered anything of what was asked."""
    from ...schemas.errors import BusyError

    if asked and client.unanswered == asked:
        raise BusyError(client.silence(op))


def _say_unknown(client: "Client", op: str, word: str, asked: int, line: str) -> int:
    """Say on standard error what nobody answered, or else `line` of what is unknown; return the exit code."""
    if client.unanswered:
        return complain(f"{client.unanswered} of {asked} {word} were not answered: {client.silence(op)}", 1)
    if line:
        print(f"warning: {line}", file=sys.stderr)
    return 0


def _outside(client: "Client", places: Any, leaves: Any, verdicts: Any, word: str) -> Any:
    """Say on standard error how many places lie outside the scan; return which, or None where that is not known."""
    from ...schemas.errors import BusyError
    from ..scan_bounds import lying_outside, outside_line

    if not leaves.any():
        return leaves
    try:
        info = client.info()
    except BusyError:  # the server has gone since
        return None
    outside = lying_outside(places, leaves, verdicts, info)
    if outside.any():
        print(f"warning: {outside_line(places, outside, info, word)}", file=sys.stderr)
    return outside


def _ask_moves(connect: str, scene: str, question: Any, as_json: bool, key_file: Path | None) -> int:
    """Ask frame after frame and print a line each, or all as JSON; return the exit code."""
    import numpy as np
    from msgspec import json

    from ...schemas.answers import Verdict
    from ...schemas.encoding import JSON, encode
    from ..answer_text import move_line
    from ..client import Client
    from ..query import ask_moves
    from ..report.points import read_avatar

    found: list[dict[str, Any]] = []
    waiting: list[str] = []
    with Client(connect, scene=scene, key_file=key_file) as client:
        places, frames = ask_moves(client, question, read_avatar)
        for label, moved in frames:
            found.append(json.decode(encode(moved, JSON)))
            waiting.append(move_line(label, moved))
            if not as_json and client.unanswered < len(found):
                print("\n".join(waiting))
                waiting.clear()
        _check_answered(client, len(found), "move")
        verdicts = np.array([moved.get("verdict", 0) for moved in found])
        outside = _outside(client, places, np.ones(len(found), bool), verdicts, "motions")
    if as_json:
        lie = [None] * len(found) if outside is None else outside.tolist()
        print_json([{**moved, "outside_scan": lies} for moved, lies in zip(found, lie, strict=True)])
    count = int((verdicts == Verdict.UNKNOWN).sum())
    line = (
        f"{count} of {len(found)} motions are unknown: what is in reach could not be looked at"
        if count
        else ""
    )
    return _say_unknown(client, "move", "motions", len(found), line)

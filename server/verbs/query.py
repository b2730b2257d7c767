"""`solidcloud query`: ask a server what something touches."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from .options import AsJson, print_json

# Options that are not parameters of what is asked.
_NOT_OF_THE_QUESTION = ("scene", "op", "connect", "as_json")


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
    as_json: AsJson = False,
) -> None:
    """Ask a server what poses of an avatar, rays, points or objects touch."""
    options = {name: value for name, value in locals().items() if name not in _NOT_OF_THE_QUESTION}
    from ..answer_text import answer_lines, answers_json, summary_line
    from ..client import Client
    from ..query import ask, check_query, joined
    from ..report.points import read_avatar

    question = check_query(op, options)
    if op == "move":
        _ask_moves(connect, scene, question, as_json)
        return
    found = []
    with Client(connect, scene=scene) as client:
        for part in ask(client, question, read_avatar):
            found.append(part)
            if not as_json:
                for line in answer_lines(*part):
                    print(line, flush=op == "path")
    whole = joined(found)
    if whole.labels and whole.answers.engine_seconds == 0.0:
        print(f"no server of scene {scene!r} answered at {connect}", file=sys.stderr)
    if as_json:
        print_json(answers_json(whole.times, whole.answers))
    else:
        print(summary_line(whole.answers))


def _ask_moves(connect: str, scene: str, question: Any, as_json: bool) -> None:
    """Frame after frame, a line each, or all as JSON."""
    from msgspec import json

    from ...schemas.answers import Verdict
    from ...schemas.encoding import JSON, encode
    from ..answer_text import move_line
    from ..client import Client
    from ..query import ask_moves
    from ..report.points import read_avatar

    found = []
    with Client(connect, scene=scene) as client:
        for label, moved in ask_moves(client, question, read_avatar):
            found.append(json.decode(encode(moved, JSON)))
            if not as_json:
                print(move_line(label, moved))
    if found and not any(
        moved.get("simulated") or moved.get("verdict", 0) < Verdict.UNKNOWN for moved in found
    ):
        print(f"no server of scene {scene!r} answered at {connect}", file=sys.stderr)
    if as_json:
        print_json(found)

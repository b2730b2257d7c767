"""Zenoh keys of queries, motion commands, states and liveliness tokens. WIRE.md lists them."""

import hashlib
import re
from functools import lru_cache
from typing import NamedTuple

from ..errors import BadRequestError
from .question_table import QUESTIONS
from .request_limits import MAX_NAME_LENGTH

# The 1 is WIRE.md's version: servers of two versions can run side by side, and neither receives the
# other's messages.
ROOT = "solidcloud/1"

_NAME = re.compile(rf"[A-Za-z0-9._-]{{1,{MAX_NAME_LENGTH}}}")


# Operations about what a scene looks like.
_PICTURES = ("overview", "voxels", "tile")


class Route(NamedTuple):
    """Parts of a query's key: the scene, the client that sent the query, and the operation."""

    scene: str
    client: str
    operation: str


class User(NamedTuple):
    """One avatar of one client in one scene; it sends motion commands and receives states."""

    client: str
    avatar: str


def check_name(name: str, what: str) -> str:
    """Return the name if it is valid in a key; raise BadRequestError otherwise.

    what: noun for the name in the error message, such as "scene".
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        found = repr(name[:80]) if isinstance(name, str) else f"named by a {type(name).__name__}"
        raise BadRequestError(f"{what} {found}: expected 1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'")
    return name


def operations() -> tuple[str, ...]:
    """Return the names of a scene's operations: all questions, and the other ones."""
    return ("info", "add_avatar", *QUESTIONS, "path", "move", *_PICTURES, "reload", "stats")


def scenes_key() -> str:
    """Return the key under which every server lists the scenes that it serves."""
    return f"{ROOT}/scenes"


def query_key(scene: str, client: str, operation: str) -> str:
    """Return the key under which a client sends one operation to one scene."""
    check_name(scene, "scene")
    check_name(client, "client")
    if operation not in operations():
        raise BadRequestError(f"operation {operation!r}: expected one of {', '.join(operations())}")
    return f"{ROOT}/scene/{scene}/{client}/{operation}"


def all_queries_key(scene: str) -> str:
    """Return the key expression that a server declares: any client, any operation of its scene."""
    return f"{ROOT}/scene/{check_name(scene, 'scene')}/*/*"


@lru_cache(maxsize=4096)
def parse_query_key(key: str) -> Route:
    """Parse a query's key into its route.

    Raises BadRequestError for any other key, wildcards included. Results are cached, because all
    queries of a client use the same few keys.
    """
    prefix = f"{ROOT}/scene/"
    parts = key.removeprefix(prefix).split("/")
    if not key.startswith(prefix) or len(parts) != 3:
        raise BadRequestError(f"key {key!r}: expected {prefix}SCENE/CLIENT/OPERATION")
    route = Route(*parts)
    query_key(*route)
    return route


def server_token_key(scene: str, server: str) -> str:
    """Return the liveliness token key of a server that is warm and answers for this scene."""
    return f"{ROOT}/alive/{check_name(scene, 'scene')}/{check_name(server, 'server')}"


def client_token_key(scene: str, client: str) -> str:
    """Return the liveliness token key of a client.

    When the token disappears, the server drops the client's avatars.
    """
    return f"{ROOT}/client/{check_name(scene, 'scene')}/{check_name(client, 'client')}"


def all_client_tokens_key(scene: str) -> str:
    """Return the key expression of the tokens of all clients of a scene, for a server."""
    return f"{ROOT}/client/{check_name(scene, 'scene')}/*"


def parse_client_token(key: str) -> str:
    """Return the client of a liveliness token's key.

    Raises BadRequestError for any other key, wildcards included.
    """
    return _parse(key, "client", ("scene", "client"))[1]


def public_id(client: str) -> str:
    """Return the name by which other clients learn of a client.

    It is the first 12 hex digits of the SHA-256 of the client's id, or "" for "". The id itself is
    a secret: a program that knows it can send queries and motion commands, or leave, in the
    client's name.
    """
    return hashlib.sha256(client.encode()).hexdigest()[:12] if client else ""


def command_key(scene: str, user: User) -> str:
    """Return the key under which a client publishes the motion commands of its avatar.

    Deleting the key removes the avatar from the scene.
    """
    return _user_key("wish", scene, user)


def all_commands_key(scene: str) -> str:
    """Return the key expression of the motion commands of all users of a scene, for a server."""
    return f"{ROOT}/wish/{check_name(scene, 'scene')}/*/*"


def parse_command_key(key: str) -> User:
    """Return the user whose motion command arrives under a key.

    Raises BadRequestError for any other key, wildcards included.
    """
    return User(*_parse(key, "wish", ("scene", "client", "avatar of a session"))[1:])


def state_key(scene: str, user: User) -> str:
    """Return the key under which a client queries the states of one of its users.

    The server replies with the states under the same key.
    """
    return _user_key("state", scene, user)


def all_states_key(scene: str) -> str:
    """Return the key expression that a server declares: the states of all users of its scene."""
    return f"{ROOT}/state/{check_name(scene, 'scene')}/*/*"


def parse_state_key(key: str) -> User:
    """Return the user whose states are queried under a key.

    Raises BadRequestError for any other key, wildcards included.
    """
    return User(*_parse(key, "state", ("scene", "client", "avatar of a session"))[1:])


def residency_key(scene: str, client: str) -> str:
    """Return the key under which a client queries the changes of what is resident of a scene.

    The server replies with them under the same key.
    """
    return f"{ROOT}/residency/{check_name(scene, 'scene')}/{check_name(client, 'client')}"


def all_residency_key(scene: str) -> str:
    """Return the key expression that a server declares: changes of its scene, for any client."""
    return f"{ROOT}/residency/{check_name(scene, 'scene')}/*"


def parse_residency_key(key: str) -> str:
    """Return the client that queries changes under a key.

    Raises BadRequestError for any other key, wildcards included.
    """
    return _parse(key, "residency", ("scene", "client"))[1]


def _user_key(what: str, scene: str, user: User) -> str:
    check_name(scene, "scene")
    check_name(user.client, "client")
    check_name(user.avatar, "avatar of a session")
    return f"{ROOT}/{what}/{scene}/{user.client}/{user.avatar}"


def _parse(key: str, what: str, names: tuple[str, ...]) -> list[str]:
    """Return the chunks of a key after the chunk `what`, one for each of `names`.

    Raises BadRequestError for another number of chunks, or an invalid name.
    """
    prefix = f"{ROOT}/{what}/"
    parts = key.removeprefix(prefix).split("/")
    if not key.startswith(prefix) or len(parts) != len(names):
        raise BadRequestError(f"key {key!r}: expected {prefix}{'/'.join(names).upper()}")
    return [check_name(part, name) for part, name in zip(parts, names, strict=True)]

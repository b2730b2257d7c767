"""Key expressions: where on zenoh each question is asked, and who is alive. WIRE.md lists them."""

import hashlib
import re
from functools import lru_cache
from typing import NamedTuple

from .errors import BadRequestError

# The 1 is WIRE.md's version: servers of two versions can live side by side, neither hears the other.
ROOT = "solidcloud/1"
OPERATIONS = (
    "info", "add_avatar", "collide", "distance", "contacts", "sweep", "raycast", "within", "objects", "path",
    "move", "reload", "stats",
)  # fmt: skip

_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")


class Route(NamedTuple):
    """What the key of a question says: which scene, which client asks, and what."""

    scene: str
    client: str
    operation: str


class User(NamedTuple):
    """One avatar of one client, in one scene: who wishes, and whom a state is of."""

    client: str
    avatar: str


def check_name(name: str, what: str) -> str:
    """The same name, if it may stand in a key; BadRequestError if not. `what` is what it names."""
    if not _NAME.fullmatch(name):
        raise BadRequestError(f"{what} {name!r}: expected 1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'")
    return name


def scenes_key() -> str:
    """Where every server says which scenes it serves."""
    return f"{ROOT}/scenes"


def question_key(scene: str, client: str, operation: str) -> str:
    """Where one client asks one thing of one scene."""
    check_name(scene, "scene")
    check_name(client, "client")
    if operation not in OPERATIONS:
        raise BadRequestError(f"operation {operation!r}: expected one of {', '.join(OPERATIONS)}")
    return f"{ROOT}/scene/{scene}/{client}/{operation}"


def questions_key(scene: str) -> str:
    """What a server declares: any client, any operation of its scene."""
    return f"{ROOT}/scene/{check_name(scene, 'scene')}/*/*"


@lru_cache(maxsize=4096)
def parse_question(key: str) -> Route:
    """The route of a question's key; BadRequestError where it is not one, wildcards included.

    Remembered, because every question of a client comes under the same few keys.
    """
    prefix = f"{ROOT}/scene/"
    parts = key.removeprefix(prefix).split("/")
    if not key.startswith(prefix) or len(parts) != 3:
        raise BadRequestError(f"key {key!r}: expected {prefix}SCENE/CLIENT/OPERATION")
    route = Route(*parts)
    question_key(*route)
    return route


def server_alive_key(scene: str, server: str) -> str:
    """The liveliness token of a server that is warm and answers for this scene."""
    return f"{ROOT}/alive/{check_name(scene, 'scene')}/{check_name(server, 'server')}"


def client_alive_key(scene: str, client: str) -> str:
    """The liveliness token of a client: when it goes, the server drops the client's avatars."""
    return f"{ROOT}/client/{check_name(scene, 'scene')}/{check_name(client, 'client')}"


def clients_alive_key(scene: str) -> str:
    """What a server listens to: the tokens of all clients of its scene."""
    return f"{ROOT}/client/{check_name(scene, 'scene')}/*"


def parse_client_alive(key: str) -> str:
    """Return the client that a liveliness token is of; BadRequestError for any other key, wildcards included."""
    return _parse(key, "client", ("scene", "client"))[1]


def public_id(client: str) -> str:
    """Return the name under which others are told of a client: 12 hex digits of the SHA-256 of its id, "" of "".

    The id itself is a secret: whoever knows it may ask, wish and leave in the client's name.
    """
    return hashlib.sha256(client.encode()).hexdigest()[:12] if client else ""


def wish_key(scene: str, user: User) -> str:
    """Where a client publishes what its avatar wishes; deleted, the avatar leaves the scene."""
    return _user_key("wish", scene, user)


def wishes_key(scene: str) -> str:
    """What a server listens to: the wishes of all users of its scene."""
    return f"{ROOT}/wish/{check_name(scene, 'scene')}/*/*"


def parse_wish(key: str) -> User:
    """Return the user whose wish comes under a key; BadRequestError for any other key, wildcards included."""
    return User(*_parse(key, "wish", ("scene", "client", "avatar of a session"))[1:])


def state_key(scene: str, user: User) -> str:
    """Return the key under which a client asks for the states of one of its users, and the server replies with them."""
    return _user_key("state", scene, user)


def states_key(scene: str) -> str:
    """Return the key that a server declares: the states of all users of its scene."""
    return f"{ROOT}/state/{check_name(scene, 'scene')}/*/*"


def parse_state(key: str) -> User:
    """Return the user whose states are asked for; BadRequestError for any other key, wildcards included."""
    return User(*_parse(key, "state", ("scene", "client", "avatar of a session"))[1:])


def _user_key(what: str, scene: str, user: User) -> str:
    """A key of one user."""
    check_name(scene, "scene")
    check_name(user.client, "client")
    check_name(user.avatar, "avatar of a session")
    return f"{ROOT}/{what}/{scene}/{user.client}/{user.avatar}"


def _parse(key: str, what: str, names: tuple[str, ...]) -> list[str]:
    """Return the chunks of a key behind `what`; BadRequestError unless they are names, as many as expected."""
    prefix = f"{ROOT}/{what}/"
    parts = key.removeprefix(prefix).split("/")
    if not key.startswith(prefix) or len(parts) != len(names):
        raise BadRequestError(f"key {key!r}: expected {prefix}{'/'.join(names).upper()}")
    return [check_name(part, name) for part, name in zip(parts, names, strict=True)]

"""Limits on the avatars of a scene, and the two client names that no key contains."""

from typing import NamedTuple

# Owner of the avatars that every client may use in requests; no key can name it.
EVERYBODY = "*"
# Owner of the avatars added in the serving process, not by a client.
THIS_PROCESS = ""


class AvatarLimits(NamedTuple):
    """Limits on avatars, for all clients together and for each one.

    bytes: of their arrays.  avatars: their number.  clients: number of clients with avatars.
    """

    bytes: int
    bytes_by_client: int
    avatars: int
    avatars_by_client: int
    clients: int

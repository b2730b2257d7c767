"""Limits on the avatars of a scene, and the clients that no key names."""

from typing import NamedTuple

# The client whose avatars every client may ask about; no key can name it.
EVERYBODY = "*"
# The client of avatars that were added in the process that serves, by no client.
THIS_PROCESS = ""


class AvatarLimits(NamedTuple):
    """How much memory avatars may take; of all clients together, and of each one.

    bytes: of their arrays.  avatars: their number.  clients: how many clients may have any.
    """

    bytes: int
    bytes_by_client: int
    avatars: int
    avatars_by_client: int
    clients: int

"""Channels in which zenoh passes on queries and samples."""

from typing import Any

import zenoh


def take_at_hand(channel: Any) -> Any:
    """Take a query or sample from a zenoh channel without waiting.

    Return None when the channel is empty or has ended.
    """
    try:
        return channel.try_recv()
    except zenoh.ZError:
        return None

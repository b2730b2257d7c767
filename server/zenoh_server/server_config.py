"""Configuration of a server."""

import math
from dataclasses import dataclass
from pathlib import Path

from ...schemas.errors import BadRequestError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS, MAX_POSES
from ..scene_interface import AvatarLimits
from ..zenoh_common.endpoints import DEFAULT_ENDPOINT, check_endpoint, is_loopback


@dataclass(frozen=True)
class ServerConfig:
    """Configuration of one server. Raise BadRequestError for an invalid value.

    listen: zenoh endpoint of the server. It must be on loopback unless `insecure` is set, because
    every client that reaches it may send requests.
    insecure: allow an endpoint that other hosts reach; there is no authentication yet.
    workers: number of requests answered at the same time. The default is 2, because a client that
    does not accept its replies occupies one worker for a time.
    max_slow: requests that run for longer than some 10 ms; they hold no worker. Further ones wait.
    max_request_seconds: time limit for one request or one part of a path; what was not computed by
    then is `unknown`.
    max_in_flight: requests accepted and not yet answered, over all clients; a further one is
    answered `busy`, unless it is small and its client has none in flight. It is also the number of
    liveliness tokens that are heeded.
    max_in_flight_by_client: the same for one client; all clients without a liveliness token count
    as one.
    max_in_flight_bytes: bytes of the payloads of all requests in flight.
    max_paths: paths answered at the same time, at most half of them for one client; a separate
    thread sends the parts of each. A further one is answered `busy`.
    max_poses, max_avatar_points: limits of one request; a larger one is answered `too_large`.
    max_avatar_bytes, max_avatar_bytes_by_client: bytes of the arrays of avatars, some 54 a point.
    max_avatars, max_avatars_by_client: number of avatars.
    max_avatar_clients: number of clients that have avatars.
    avatar_seconds: an avatar unused for this long is dropped, unless its client has a liveliness
    token.
    stop_seconds: how long a stop waits for accepted requests to be answered before it stops them.
    key_file: file with the key that seals replies, shared with clients; None: a key made at the
    start.
    metrics_port: port on which Prometheus metrics are served over HTTP, on loopback unless
    `insecure` is set; 0: none.
    """

    listen: str = DEFAULT_ENDPOINT
    insecure: bool = False
    workers: int = 2
    max_slow: int = 4
    max_request_seconds: float = 2.0
    max_in_flight: int = 1024
    max_in_flight_by_client: int = 64
    max_in_flight_bytes: int = 64 << 20
    max_paths: int = 16
    max_poses: int = MAX_POSES
    max_avatar_points: int = MAX_AVATAR_POINTS
    max_avatar_bytes: int = 512 << 20
    max_avatar_bytes_by_client: int = 256 << 20
    max_avatars: int = 16_384
    max_avatars_by_client: int = 4096
    max_avatar_clients: int = 1024
    avatar_seconds: float = 60.0
    stop_seconds: float = 1.0
    metrics_port: int = 0
    key_file: Path | None = None

    def __post_init__(self) -> None:
        check_endpoint(self.listen, "listen")
        if not self.insecure and not is_loopback(self.listen):
            raise BadRequestError(
                f"listen {self.listen!r}: other hosts could reach it, and there is no authentication: "
                f"listen on loopback such as {DEFAULT_ENDPOINT}, or give --insecure"
            )
        for name, most in (("max_poses", MAX_POSES), ("max_avatar_points", MAX_AVATAR_POINTS)):
            if not 1 <= getattr(self, name) <= most:
                raise BadRequestError(f"{name} is {getattr(self, name)}: expected 1 to {most} (WIRE.md)")
        for name in (
            "workers", "max_slow", "max_in_flight", "max_in_flight_by_client", "max_in_flight_bytes", "max_paths",
            "max_avatar_bytes", "max_avatar_bytes_by_client", "max_avatars", "max_avatars_by_client",
            "max_avatar_clients",
        ):  # fmt: skip
            if getattr(self, name) < 1:
                raise BadRequestError(f"{name} is {getattr(self, name)}: expected at least 1")
        if not 0 < self.max_request_seconds < math.inf:
            raise BadRequestError(
                f"max_request_seconds is {self.max_request_seconds}: expected seconds above 0"
            )
        if not 0 <= self.metrics_port < 1 << 16:
            raise BadRequestError(f"--metrics-port {self.metrics_port}: expected 1 to 65535, or 0 for none")

    @property
    def avatar_limits(self) -> AvatarLimits:
        """Return the limits of one scene's avatars."""
        return AvatarLimits(
            self.max_avatar_bytes,
            self.max_avatar_bytes_by_client,
            self.max_avatars,
            self.max_avatars_by_client,
            self.max_avatar_clients,
        )

    @property
    def metrics_host(self) -> str:
        """Return the address at which metrics are served."""
        return "0.0.0.0" if self.insecure else "127.0.0.1"

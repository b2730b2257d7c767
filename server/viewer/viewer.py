"""The viewer: one process between browsers and the server of a scene.

For the server it is a client like any other, with one session for each browser.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..scene_interface import AvatarShape
from .browser import Browser
from .feeds.residency_feed import ResidencyFeed
from .feeds.scene_link import SceneLink
from .feeds.statistics_feed import StatisticsFeed
from .feeds.tile_source import TileSource
from .page.web_server import WebServer
from .panels.effect_switch import EffectSwitch, NoSwitch
from .panels.path_source import read_given_path
from .panels.voxel_spheres import SphereSource
from .users.starting_place import StartingPlaces
from .users.user_avatar import figure_avatar
from .viewer_parts import Users, ViewerParts

log = logging.getLogger(__name__)


@contextmanager
def viewing(
    endpoint: str,
    scene: str | None = None,
    *,
    port: int = 0,
    avatar: AvatarShape | None = None,
    key_file: Path | None = None,
    switch: EffectSwitch | None = None,
    poses: Path | None = None,
) -> Iterator[str]:
    """Serve the viewer during the block; yield the address of its page.

    endpoint: of the server; it need not run yet.  scene: its name; None: the only one there.
    port: of the page; 0: a free one.  avatar: of the users; None: a figure.
    switch: changes the effects of the server; None: they are shown only.
    poses: file of a path whose clashes the page shows.
    Raise SolidcloudError if the port is in use, and the errors of `read_path`.
    """
    shape = figure_avatar() if avatar is None else avatar
    path = None if poses is None else read_given_path(poses)
    with (
        SceneLink(endpoint, scene, key_file) as link,
        ResidencyFeed(lambda: link.scene) as residency,
        StatisticsFeed(lambda: link.scene) as statistics,
    ):
        parts = ViewerParts(
            link,
            shape,
            StartingPlaces(shape),
            TileSource(lambda: link.scene),
            Users(),
            residency,
            statistics,
            switch or NoSwitch(),
            SphereSource(),
            path,
        )
        server = WebServer(port, lambda connection: Browser(connection, parts).run())
        with server.running():
            yield server.url

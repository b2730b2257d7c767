"""Clash check of one browser: takes a path, checks it in a thread, and writes the files."""

import logging
import queue
import threading
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import SolidcloudError
from ...schemas.wire.answers import ContactsAnswers, Verdict
from ..clash.bcf_file import Topic, bcf_bytes
from ..clash.clash_check import CheckedPath, Clearances, Watcher, check_path
from ..clash.clash_list import Clash
from ..clash.clash_snapshot import draw, png_bytes
from ..clash.clash_surroundings import surroundings
from ..clash.clash_tables import clash_values, clashes_csv, clashes_json
from ..clash.clash_viewpoint import Viewpoint, find_viewpoint
from ..clash.path_motions import TOUCH_MARGIN
from ..client import Client
from ..runtime.threads import start_loop
from .feeds.scene_link import OpenScene
from .page.page_messages import (
    FAILED,
    ClashMessage,
    PathText,
    SaveClashes,
    ShowClash,
    binary_message,
    text_message,
)
from .page.view_frame import ViewFrame
from .panels.path_source import GivenPath, PathParts
from .users.browser_user import rounded
from .viewer_parts import ViewerParts

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Send = Callable[[str | bytes], None]

# Clashes that a page lists, and topics of a BCF file: deepest first. A picture takes about a second.
MOST_LISTED, MOST_TOPICS = 500, 100
# Pairs in contact that are drawn at a clash.
_MOST_PAIRS = 60
_MEDIA = {"csv": "text/csv", "json": "application/json", "bcf": "application/zip"}


class CheckedScene(NamedTuple):
    """A checked path, and what it was checked in.

    client: of the check.  avatar: its name there.
    """

    path: GivenPath
    checked: CheckedPath
    scene: OpenScene
    client: Client
    avatar: str


class ClashSession:
    """Clash check of one browser. Jobs run one after another in a thread; a new path ends the job before."""

    def __init__(self, number: int, parts: ViewerParts, send: Send) -> None:
        """Make a session. number: of the browser.  send: sends messages to its page."""
        self._number, self._parts, self._send = number, parts, send
        self._text = PathParts()
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._open = ExitStack()
        self._client: Client | None = None
        self._last: CheckedScene | None = None
        self._begun = False
        self._shown = 0

    def begin(self) -> None:
        """Check the path of the command line, if there is one; only the first call does."""
        path, begun, self._begun = self._parts.path, self._begun, True
        if path is not None and not begun:
            self._check(path)

    def take(self, message: ClashMessage) -> None:
        """Take a message of the page."""
        if isinstance(message, PathText):
            try:
                path = self._text.take(message)
            except SolidcloudError as error:
                self._stop.set()
                self._failed(message.name, str(error))
                return
            if path is not None:
                self._check(path)
        elif isinstance(message, ShowClash):
            self._shown = message.number
            self._run(partial(self._show, message.number))
        elif isinstance(message, SaveClashes):
            self._stop = threading.Event()
            self._run(partial(self._save, message.form, self._stop))
        else:
            self._stop.set()

    def end(self) -> None:
        """End the session."""
        self._stop.set()
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join()
        self._open.close()

    # --- jobs ------------------------------------------------------------------------------------

    def _check(self, path: GivenPath) -> None:
        """Check a path instead of the one before."""
        self._stop.set()
        self._stop = threading.Event()
        self._run(partial(self._check_path, path, self._stop))

    def _run(self, job: Callable[[], None]) -> None:
        """Run a job in the thread."""
        if self._thread is None:
            self._thread = start_loop(
                f"viewer-{self._number}-clash", self._work, failed=partial(self._failed, "", FAILED)
            )
        self._jobs.put(job)

    def _work(self) -> None:
        """Run jobs until the session ends. Runs in a thread."""
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except SolidcloudError as error:
                self._failed("", str(error))

    def _failed(self, name: str, message: str) -> None:
        """Tell the page why something was not done."""
        self._send(text_message("check", state="failed", name=name, message=message))

    def _check_path(self, path: GivenPath, stop: threading.Event) -> None:
        """Check a path, and send what is found as it is found."""
        scene = self._parts.link.scene
        if scene is None:
            self._send(text_message("check", state="failed", name=path.name, message="no server yet"))
            return
        if stop.is_set():
            return
        avatar = self._parts.avatar
        self._last = None
        client = self._client
        if client is None:
            client = self._open.enter_context(self._parts.link.another_client(scene.info.scene))
            self._client = client
        name = f"clash-{self._number}"
        client.add_avatar(name, avatar)
        middle = (avatar.surface.min(axis=0) + avatar.surface.max(axis=0)) / 2
        places = path.poses[:, :3, :3] @ middle + path.poses[:, :3, 3]
        arrays = {"places": scene.frame.points(places).astype(np.float32).reshape(-1, 3)}
        self._send(binary_message("path", arrays, name=path.name, total=len(path.poses)))
        watcher = Watcher(self._clearances, partial(self._progress, "running"), stop.is_set)
        checked = check_path(client, name, path.times, path.poses, watcher=watcher)
        self._last = CheckedScene(path, checked, scene, client, name)
        self._send(clashes_message(self._last))

    def _clearances(self, found: Clearances) -> None:
        """Send the clearance of some poses."""
        # No motion ends at the first pose of a path.
        missing = (len(found.verdict) - len(found.motions.verdict), 0)
        clearance = np.pad(found.motions.clearance, missing, constant_values=np.inf)
        arrays: dict[str, NDArray] = {
            "distance": found.signed_distance.astype(np.float32),
            "verdict": found.verdict,
            "motion_clearance": clearance.astype(np.float32),
            "motion_verdict": np.pad(found.motions.verdict, missing),
        }
        self._send(binary_message("clearances", arrays, first=found.first))

    def _progress(self, state: str, done: float) -> None:
        """Send how far a job is."""
        self._send(text_message("check", state=state, done=round(done, 3)))

    def _show(self, number: int) -> None:
        """Send the contacts of a clash, and from where it is seen."""
        last = self._last
        # Of several that were asked for meanwhile, the last is shown.
        if last is None or number != self._shown or not 1 <= number <= len(last.checked.clashes):
            return
        clash = last.checked.clashes[number - 1]
        self._send(clash_message(last, number, clash, self._view(last, clash)))

    def _view(self, last: CheckedScene, clash: Clash) -> Viewpoint:
        """Return from where a clash is seen."""
        points = self._parts.avatar.surface
        low, high = points.min(axis=0), points.max(axis=0)
        return find_viewpoint(
            last.client,
            clash,
            last.checked.track.poses,
            (low + high) / 2,
            float(high[2] - low[2]),
            last.scene.info.up,
        )

    def _save(self, form: str, stop: threading.Event) -> None:
        """Send the clashes as a file."""
        last = self._last
        if last is None:
            return
        scene, name = last.scene.info.scene, last.path.name
        if form == "csv":
            content = clashes_csv(last.checked).encode()
        elif form == "json":
            content = clashes_json(last.checked, scene=scene, path=name).encode()
        else:
            topics = self._topics(last, stop)
            if stop.is_set():
                self._progress("stopped", 1.0)
                return
            content = bcf_bytes(last.checked, topics, scene, name, datetime.now(UTC))
        file = f"{PurePath(name).stem or 'path'}-clashes.{form}"
        arrays = {"content": np.frombuffer(content, np.uint8)}
        self._send(binary_message("file", arrays, name=file, media=_MEDIA[form]))

    def _topics(self, last: CheckedScene, stop: threading.Event) -> list[Topic]:
        """Return the clashes with a viewpoint and a picture each."""
        topics: list[Topic] = []
        listed = last.checked.clashes[:MOST_TOPICS]
        for number, clash in enumerate(listed, 1):
            if stop.is_set():
                break
            self._progress("saving", len(topics) / len(listed))
            view = self._view(last, clash)
            pose = last.checked.track.poses[clash.deepest]
            pairs = contacts_of(last, clash)
            up = np.asarray(last.scene.info.up, np.float64)
            clouds = surroundings(last.client, clash, pose, self._parts.avatar.surface, pairs.cloud_point, up)
            topics.append(Topic(number, clash, view, png_bytes(draw(view, clouds))))
        return topics


def clashes_message(last: CheckedScene) -> str:
    """Return the list of clashes as a message, in the world; `at`: place in the page's frame."""
    checked, frame = last.checked, last.scene.frame
    listed = [
        {**clash_values(checked, number, clash), "at": rounded(frame.points(clash.place))}
        for number, clash in enumerate(checked.clashes[:MOST_LISTED], 1)
    ]
    return text_message(
        "clashes",
        name=last.path.name,
        poses=len(checked.poses),
        complete=checked.complete,
        reach=checked.reach,
        clearance=checked.clearance,
        faults=list(checked.faults),
        counts={verdict.name.lower(): checked.count(verdict) for verdict in Verdict},
        motions={verdict.name.lower(): checked.count_motions(verdict) for verdict in Verdict},
        total=len(checked.clashes),
        between=sum(checked.fraction(clash) is not None for clash in checked.clashes),
        topics=MOST_TOPICS,
        clashes=listed,
    )


def contacts_of(last: CheckedScene, clash: Clash) -> ContactsAnswers:
    """Return the pairs in contact at the deepest pose of a clash. Raise the server's errors."""
    margin = 0.0 if last.checked.fraction(clash) is None else TOUCH_MARGIN
    pose = last.checked.track.poses[clash.deepest]
    return last.client.contacts(last.avatar, pose, limit=_MOST_PAIRS, margin=margin)


def clash_message(last: CheckedScene, number: int, clash: Clash, view: Viewpoint) -> str:
    """Return a clash as a message: the pose, its contacts, and the viewpoint, in the page's frame."""
    frame: ViewFrame = last.scene.frame
    pose = last.checked.track.poses[clash.deepest]
    found = contacts_of(last, clash)
    ways = found.cluster_avatar - found.cluster_cloud
    lengths = np.linalg.norm(ways, axis=1, keepdims=True)
    normals = np.divide(ways, lengths, out=np.zeros_like(ways), where=lengths > 0)
    return text_message(
        "clash",
        number=number,
        pose=rounded(frame.pose(pose)),
        eye=rounded(frame.points(view.eye)),
        target=rounded(frame.points(view.target)),
        pairs=int(found.pairs_found[0]),
        places=rounded(frame.points(found.cloud_point)),
        clusters=[
            {
                "place": rounded(frame.points(place)),
                "normal": rounded(frame.directions(normal)),
                "depth": -float(deep),
            }
            for place, normal, deep in zip(found.cluster_cloud, normals, found.cluster_deepest, strict=True)
        ],
    )

"""The memory that clients' avatars may take, and how long they are kept."""

import threading

import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError, TooLargeError, UnknownAvatarError
from solidcloud.schemas.wire.requests import AddAvatarRequest
from solidcloud.server.avatars import client_avatars as avatars_module
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.avatars.client_avatars import Avatars, bytes_of
from solidcloud.server.scene_interface import EVERYBODY, AvatarLimits

LIMITS = AvatarLimits(bytes=100_000, bytes_by_client=60_000, avatars=10, avatars_by_client=4, clients=3)
BODY = np.random.default_rng(5).uniform(-1, 1, (500, 3))  # some 29 kB


def add(avatars, name, points, radius, client):
    return avatars.add(AddAvatarRequest(name, points, radius), client)


@pytest.mark.parametrize("count", [0, 1, 33, 1000])
@pytest.mark.parametrize("kind", ["uniform", "line", "one place"])
def test_what_is_reserved_is_enough(count, kind):
    points = np.random.default_rng(count).uniform(-1, 1, (count, 3))
    points[:, 1:] *= kind == "uniform"
    points *= kind != "one place"
    model = make_avatar(points, 0.01)
    reserved = avatars_module._LEAST_BYTES + avatars_module._BYTES_A_POINT * count
    assert bytes_of(model) <= reserved
    assert bytes_of(model) >= points.nbytes


def test_bytes_and_numbers_are_counted_and_told():
    avatars = Avatars(LIMITS)
    model = add(avatars, "al", BODY, 0.01, "a")
    add(avatars, "own", BODY, 0.01, EVERYBODY)
    stats = avatars.stats()
    assert (stats.bytes, stats.avatars, stats.clients) == (bytes_of(model), 1, 1)
    assert (stats.max_bytes, stats.max_bytes_by_client, stats.max_avatars) == (100_000, 60_000, 10)
    assert (stats.max_avatars_by_client, stats.max_clients) == (4, 3)
    avatars.drop_client("a")
    assert (avatars.stats().bytes, avatars.stats().avatars, avatars.stats().clients) == (0, 0, 0)


def test_a_clients_bytes_are_limited():
    avatars = Avatars(LIMITS)
    held = 2 * bytes_of(add(avatars, "1", BODY, 0.01, "a"))
    add(avatars, "2", BODY, 0.01, "a")
    with pytest.raises(
        TooLargeError, match=rf"'3' of 500 points: {held} bytes of this client.*at most 60000"
    ):
        add(avatars, "3", BODY, 0.01, "a")
    add(avatars, "1", BODY, 0.01, "b")


def test_all_clients_bytes_are_limited():
    avatars = Avatars(LIMITS)
    for client, name in (("a", "1"), ("a", "2"), ("b", "1")):
        add(avatars, name, BODY, 0.01, client)
    with pytest.raises(TooLargeError, match="bytes of all clients' avatars"):
        add(avatars, "2", BODY, 0.01, "b")
    add(avatars, "own", BODY, 0.01, EVERYBODY)


@pytest.mark.parametrize(
    "limits, what",
    [
        (LIMITS, "avatars of this client"),
        (LIMITS._replace(avatars=4), "avatars of this client|avatars of all clients"),
    ],
)
def test_a_clients_avatars_are_limited(limits, what):
    avatars = Avatars(limits)
    for number in range(4):
        add(avatars, str(number), BODY[:2], 0.01, "a")
    with pytest.raises(TooLargeError, match=what):
        add(avatars, "4", BODY[:2], 0.01, "a")
    add(avatars, "3", BODY[:2], 0.01, "a")


def test_the_number_of_clients_is_limited():
    avatars = Avatars(LIMITS)
    for client in "abc":
        add(avatars, "al", BODY[:2], 0.01, client)
    with pytest.raises(TooLargeError, match="3 clients with avatars exist"):
        add(avatars, "al", BODY[:2], 0.01, "d")
    add(avatars, "bo", BODY[:2], 0.01, "c")
    avatars.drop_client("a")
    add(avatars, "al", BODY[:2], 0.01, "d")


def test_what_was_refused_or_failed_is_not_counted():
    avatars = Avatars(LIMITS)
    with pytest.raises(TooLargeError):
        add(avatars, "al", np.zeros((5000, 3)), 0.01, "a")
    with pytest.raises(BadRequestError):
        add(avatars, "al", np.zeros((5, 3)), None, "a")
    assert avatars.stats().avatars == avatars.stats().bytes == avatars.stats().clients == 0


def test_the_same_avatar_again_is_the_same_and_another_is_refused():
    avatars = Avatars(LIMITS)
    first = add(avatars, "al", BODY, None, "a")
    assert add(avatars, "al", BODY.copy(), None, "a") is first
    assert add(avatars, "al", BODY, first.radius, "a") is first
    second = add(avatars, "bo", BODY[:50], make_avatar(BODY[:50]).radius, "a")
    assert add(avatars, "bo", BODY[:50], None, "a") is second
    for points, radius in ((BODY + 1, None), (BODY, 0.5), (BODY[:9], None)):
        with pytest.raises(BadRequestError, match="other points or another radius"):
            add(avatars, "al", points, radius, "a")
    assert avatars.stats().avatars == 2


def test_of_two_that_are_built_at_a_time_one_is_stored_within_the_limits(monkeypatch):
    avatars, together = Avatars(LIMITS._replace(avatars_by_client=1)), threading.Barrier(3)

    def slowly(points, radius, inner_points=0):
        together.wait(20)
        return make_avatar(points, radius)

    monkeypatch.setattr(avatars_module, "make_avatar", slowly)
    made, refused = [], []

    def build(name):
        try:
            made.append(add(avatars, name, BODY, 0.01, "a"))
        except TooLargeError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=build, args=(name,)) for name in ("al", "al", "bo")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert len(made) + len(refused) == 3 and len({id(model) for model in made}) == 1
    assert avatars.stats().avatars == 1 and all("1 avatars of this client exist" in each for each in refused)


def test_unused_avatars_of_clients_without_a_token_are_dropped(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(avatars_module.time, "monotonic", lambda: now[0])
    avatars = Avatars(LIMITS)
    for client, name in (("gone", "al"), ("gone", "bo"), ("here", "al"), (EVERYBODY, "own"), ("", "ours")):
        add(avatars, name, BODY[:2], 0.01, client)
    now[0] += 59
    avatars.get("bo", "gone")
    now[0] += 2
    assert avatars.drop_unused({"here"}, 60.0) == 1
    with pytest.raises(UnknownAvatarError):
        avatars.get("al", "gone")
    for name, client in (("bo", "gone"), ("al", "here"), ("own", "gone")):
        avatars.get(name, client)
    now[0] += 61
    assert avatars.drop_unused((), 60.0) == 2
    assert avatars.stats().clients == 0
    avatars.get("own", "anybody")
    avatars.get("ours", "")

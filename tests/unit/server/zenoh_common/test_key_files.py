"""Key files: written for one user alone, found by the endpoint, taken away at the end."""

import os
import stat

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.cli.commands.serve_command import serve
from solidcloud.server.zenoh_common.key_files import find_key, key_paths, published_key, read_given_key

ENDPOINT = "tcp/127.0.0.1:7447"


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "run").mkdir()
    return tmp_path


def test_a_key_is_there_for_its_user_alone_and_only_while_it_is_served():
    with published_key(ENDPOINT, None) as key:
        path = key_paths(ENDPOINT)[0]
        assert len(key) == 32 and find_key("tcp/localhost:7447").key == key
        assert (
            stat.S_IMODE(path.stat().st_mode) == 0o600 and stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        )
        assert [each.name for each in path.parent.iterdir()] == [path.name], "nothing temporary"
        assert find_key("tcp/127.0.0.1:7448") is None
    assert find_key(ENDPOINT) is None and not path.exists()


def test_an_endpoint_that_is_no_utf8_has_no_key():
    """Issue 35: `top --connect` ended with a traceback, before the endpoint was checked."""
    assert find_key("tcp/\udcff:7447") is None


def test_each_server_has_a_key_of_its_own_and_the_newest_file_counts(folders, monkeypatch):
    with published_key(ENDPOINT, None) as old:
        known = find_key(ENDPOINT)
        assert known.key == old and find_key(ENDPOINT, known) is known
        # A server of the same user that sees no XDG_RUNTIME_DIR.
        with monkeypatch.context() as other:
            other.delenv("XDG_RUNTIME_DIR")
            server = published_key(ENDPOINT, None)
            new = server.__enter__()
        os.utime(key_paths(ENDPOINT)[0], (1, 1))
        assert new != old and find_key(ENDPOINT, known).key == new
        server.__exit__(None, None, None)


def test_a_folder_that_cannot_be_written_is_no_fault(folders, monkeypatch, caplog):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folders / "file"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(folders / "file"))
    (folders / "file").write_text("")
    with published_key(ENDPOINT, None) as key:
        assert len(key) == 32 and find_key(ENDPOINT) is None
    assert "no key file could be written" in caplog.text


@pytest.mark.parametrize("mode", [0o604, 0o640, 0o622, 0o644])
def test_a_found_file_that_others_have_access_to_is_not_used(mode, caplog):
    with published_key(ENDPOINT, None):
        key_paths(ENDPOINT)[0].chmod(mode)
        assert find_key(ENDPOINT) is None and "chmod 600" in caplog.text


def test_a_newest_file_that_is_not_usable_does_not_hide_an_older_one(monkeypatch, caplog):
    with published_key(ENDPOINT, None) as key:
        with monkeypatch.context() as other:
            other.delenv("XDG_RUNTIME_DIR")
            server = published_key(ENDPOINT, None)
            newer = server.__enter__()
        os.utime(key_paths(ENDPOINT)[0], (1, 1))
        path = key_paths(ENDPOINT)[1]
        path.chmod(0o644)
        unusable = set()
        known = find_key(ENDPOINT, None, unusable)
        assert known.key == key and find_key(ENDPOINT, known, unusable) is known
        assert caplog.text.count("is not used") == 1, "said once"
        path.chmod(0o600)
        assert find_key(ENDPOINT, known, unusable).key == newer
        server.__exit__(None, None, None)


def test_a_key_file_that_does_not_do_is_refused_before_the_archive_is_opened(folders):
    with pytest.raises(BadRequestError, match=r"key file .*No such file"):
        serve(folders / "no archive", key_file=folders / "none")


def test_a_found_link_is_not_used(folders):
    with published_key(ENDPOINT, None):
        path = key_paths(ENDPOINT)[0]
        path.rename(folders / "elsewhere")
        path.symlink_to(folders / "elsewhere")
        assert find_key(ENDPOINT) is None


def test_a_given_key_is_used_and_left_where_clients_find_it(folders):
    given = folders / "key"
    given.write_text("ab" * 32 + "\n")
    given.chmod(0o640)
    with published_key(ENDPOINT, given) as key:
        assert key == b"\xab" * 32 == read_given_key(given) == find_key(ENDPOINT).key
    assert given.exists()


@pytest.mark.parametrize(
    ("text", "mode", "says"),
    [
        ("ab" * 31, 0o600, "expected a key of 64 hex digits"),
        ("xy" * 32, 0o600, "expected a key of 64 hex digits"),
        ("", 0o600, "0 characters"),
        ("ab" * 32, 0o604, "chmod 600"),
        ("ab" * 32, 0o620, "chmod 600"),
        (None, 0, "No such file"),
    ],
)
def test_a_given_file_that_does_not_do_is_refused(folders, text, mode, says):
    given = folders / "key"
    if text is not None:
        given.write_text(text)
        given.chmod(mode)
    with pytest.raises(BadRequestError, match="key") as error:
        read_given_key(given)
    assert says in str(error.value)

"""Key files: written for one user alone, found by the endpoint, taken away at the end."""

import stat

import pytest
from solidcloud.server.zenoh_common.key_files import find_key, key_paths, published_key

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


@pytest.mark.parametrize("mode", [0o604, 0o640, 0o622, 0o644])
def test_a_found_file_that_others_have_access_to_is_not_used(mode, caplog):
    with published_key(ENDPOINT, None):
        key_paths(ENDPOINT)[0].chmod(mode)
        assert find_key(ENDPOINT) is None and "chmod 600" in caplog.text

"""The token of a daemon, the file in which it is kept, and the lock beside it."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from stiffopt.daemon import secret as secret_module
from stiffopt.daemon.secret import Secret
from stiffopt.errors import FileError
from stiffopt.rig.settings import ServiceSettings


@pytest.fixture(autouse=True)
def _without_token(monkeypatch: pytest.MonkeyPatch) -> None:
    """No token in the environment, so that one is drawn."""
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)


def secret_in(folder: Path) -> Secret:
    return Secret(ServiceSettings(), folder, "my-rig")


def test_a_drawn_token_is_for_this_user_alone(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    path = tmp_path / "runs" / "my-rig.token"
    path.write_text("old")
    path.chmod(0o666)
    secret = secret_in(tmp_path / "runs")
    secret.write()
    assert secret.path == path
    assert path.read_text().strip() == secret.token
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert sorted(os.listdir(path.parent)) == [".my-rig.token.lock", path.name]
    other = secret_in(tmp_path / "runs")
    assert other.token != secret.token
    other.remove()  # not its own
    assert path.exists()
    secret.remove()
    assert os.listdir(path.parent) == [".my-rig.token.lock"]


def test_a_second_daemon_leaves_the_token_of_the_first(tmp_path: Path) -> None:
    first, second = (secret_in(tmp_path) for _ in range(2))
    first.write()
    assert first.path is not None
    with pytest.raises(FileError, match=r"another daemon .* log\.folder or service\.token_file"):
        second.write()
    second.remove()
    assert first.path.read_text().strip() == first.token
    elsewhere = Secret(ServiceSettings(token_file=str(tmp_path / "b.token")), tmp_path, "my-rig")
    elsewhere.write()
    elsewhere.remove()
    first.remove()
    second.write()
    assert first.path.read_text().strip() == second.token
    second.remove()


def test_whoever_opened_the_lock_before_it_was_released_keeps_others_out(tmp_path: Path) -> None:
    first, third = (secret_in(tmp_path) for _ in range(2))
    first.write()
    with (tmp_path / ".my-rig.token.lock").open("r+") as second:  # as one does that starts just now
        first.remove()
        fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(FileError, match="another daemon"):
            third.write()
    third.write()
    third.remove()


def test_a_lock_of_another_user_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, opened = tmp_path / ".my-rig.token.lock", os.open

    def denied(path: Any, *rest: Any) -> int:  # as for another user: root may open everything
        if Path(path) == lock:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *rest)

    monkeypatch.setattr(os, "open", denied)
    secret = secret_in(tmp_path)
    with pytest.raises(FileError, match=r"token cannot be kept there: permission denied"):
        secret.write()  # a folder in which nothing can be written
    lock.write_text("")
    with pytest.raises(FileError, match=r"another user, .* remove this file, .*token_file") as told:
        secret.write()
    assert told.value.path == str(lock)


def test_the_token_of_a_killed_daemon_is_in_nobody_s_way(tmp_path: Path) -> None:
    code = (
        "import os, sys; from stiffopt.daemon.secret import Secret\n"
        "from stiffopt.rig.settings import ServiceSettings\n"
        "secret = Secret(ServiceSettings(), sys.argv[1], 'my-rig'); secret.write(); os._exit(9)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == 9
    assert (tmp_path / "my-rig.token").exists()
    secret = secret_in(tmp_path)
    secret.write()
    assert (tmp_path / "my-rig.token").read_text().strip() == secret.token
    secret.remove()


def test_where_nothing_can_be_locked_the_token_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", fail)
    secret = secret_in(tmp_path)
    secret.write()
    assert secret.path is not None
    assert secret.path.read_text().strip() == secret.token
    secret.remove()


def test_a_token_may_come_from_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MY_TOKEN", "abc")
    secret = Secret(ServiceSettings(token="MY_TOKEN"), tmp_path, "rig")
    secret.write()
    assert (secret.token, secret.path) == ("abc", None)
    assert not os.listdir(tmp_path)


def test_a_token_that_cannot_be_kept_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    settings = ServiceSettings(token="NOWHERE_SET", token_file=str(tmp_path / "file" / "token"))
    with pytest.raises(FileError, match=r"service\.token_file"):
        Secret(settings, tmp_path, "rig").write()


def test_a_lock_or_token_that_others_put_there_is_refused(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for name in (".my-rig.token.lock", "my-rig.token"):
        place = tmp_path / name
        place.symlink_to(victim)
        with pytest.raises(FileError, match="is a symbolic link") as told:
            _write(tmp_path)
        assert told.value.path == str(place)
        place.unlink()
        place.symlink_to(tmp_path / "new")
        with pytest.raises(FileError, match="is a symbolic link"):
            _write(tmp_path)
        place.unlink()
        os.mkfifo(place)
        with pytest.raises(FileError, match="is no regular file"):
            _write(tmp_path)
        place.unlink()
    assert victim.read_text() == "precious"
    assert not (tmp_path / "new").exists()
    _write(tmp_path)


def test_a_link_that_comes_while_the_lock_is_opened_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(secret_module, "_check_mine", lambda *_: None)
    (tmp_path / ".my-rig.token.lock").symlink_to(tmp_path / "new")
    with pytest.raises(FileError, match="symbolic links"):
        _write(tmp_path)
    assert not (tmp_path / "new").exists()


def test_files_of_other_users_are_refused_and_so_are_their_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(FileError, match="writable for all"):
        _write(folder)
    folder.chmod(0o1777)  # as /tmp: others cannot exchange what is mine
    _write(folder)
    (folder / "my-rig.token").write_text("")
    me = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: me + 1)
    with pytest.raises(FileError, match="belongs to another user") as told:
        _write(folder)
    assert told.value.path in (str(folder), str(folder / ".my-rig.token.lock"))


def test_folders_that_are_made_are_for_this_user_alone(tmp_path: Path) -> None:
    _write(tmp_path / "a" / "b")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a", "a/b")]
    assert modes == [0o700, 0o700]


def _write(folder: Path) -> None:
    secret = secret_in(folder)
    try:
        secret.write()
    finally:
        secret.remove()

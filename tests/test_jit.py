"""Where compiled kernels are kept."""

import runpy
import tempfile
from pathlib import Path

import numba
import pytest

from vioframe import jit


@pytest.fixture
def no_home(monkeypatch, tmp_path):
    """The user's cache folder cannot be written to; the temporary folder instead of it."""
    shared = tmp_path / "tmp"
    shared.mkdir()
    (tmp_path / "cache").write_text("a file where a folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(shared))
    jit._temporary_folder.cache_clear()
    yield shared
    jit._temporary_folder.cache_clear()


def test_without_a_home_the_cache_is_a_folder_of_the_users_own_that_stays(no_home):
    folder = jit._folder("")
    assert folder.parent == no_home
    assert folder.stat().st_mode & 0o077 == 0
    jit._temporary_folder.cache_clear()
    assert jit._folder("") == folder


@pytest.mark.parametrize("prepared", ["open to all", "a link"])
def test_a_cache_that_others_could_fill_is_not_used(no_home, tmp_path, prepared):
    """Whatever is found in a cache is run."""
    usual = jit._folder("")
    usual.rmdir()
    if prepared == "a link":
        (tmp_path / "theirs").mkdir()
        usual.symlink_to(tmp_path / "theirs")
    else:
        usual.mkdir()
        usual.chmod(0o777)
    jit._temporary_folder.cache_clear()
    folder = jit._folder("")
    assert folder != usual
    assert folder.stat().st_mode & 0o077 == 0
    assert jit._folder("") == folder
    assert Path(folder).is_dir()


FRESH = """
from vioframe.jit import kernel

@kernel
def doubled(x):
    return 2.0 * x
"""


def test_what_is_compiled_is_told_and_what_comes_from_the_cache_is_not(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kernels"))
    (tmp_path / "fresh.py").write_text(FRESH)
    told: list[str] = []
    for _ in range(2):
        module = runpy.run_path(str(tmp_path / "fresh.py"))
        with jit.heard(told.append):
            assert module["doubled"](2.0) == 4.0
    assert told == ["doubled"]

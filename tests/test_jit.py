"""Where compiled kernels are kept, and who compiles them."""

import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path
from time import sleep
from types import ModuleType
from unittest.mock import Mock

import numba
import pytest

from vioframe import jit
from vioframe.locks import locked


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


SLOWLY_COMPILED = """
import sys
from pathlib import Path
from time import sleep
from numba.core import event
from vioframe.jit import heard, kernel

@kernel
def doubled(x):
    return 2.0 * x

class Slow(event.Listener):
    def on_start(self, begun):
        Path(sys.argv[1]).touch()
        sleep(1.0)
    def on_end(self, begun):
        pass

event.register("numba:compile", Slow())
with heard(print):
    assert doubled(2.0) == 4.0
"""


def test_of_two_processes_that_need_a_kernel_one_compiles_it_and_the_other_waits(tmp_path):
    (tmp_path / "slow.py").write_text(SLOWLY_COMPILED)
    command = [sys.executable, str(tmp_path / "slow.py"), str(tmp_path / "begun")]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}

    def begin() -> subprocess.Popen[str]:
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)

    with begin() as first:
        while not (tmp_path / "begun").exists():
            assert first.poll() is None
            sleep(0.01)
        with begin() as second:
            assert [process.communicate()[0].split() for process in (first, second)] == [["doubled"], []]
    assert (first.returncode, second.returncode) == (0, 0)


FAILING = """
from vioframe.jit import kernel

@kernel
def failing(x):
    return x.nothing_of_this_name
"""


def test_what_cannot_be_compiled_keeps_nobody_waiting(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kernels"))
    (tmp_path / "failing.py").write_text(FAILING)
    failing = runpy.run_path(str(tmp_path / "failing.py"))["failing"]
    for _ in range(2):
        with pytest.raises(numba.TypingError):
            failing(2.0)
        for lock in (tmp_path / "kernels").rglob("*.lock"):
            locked(lock, wait=False).close()


def test_a_cache_that_cannot_be_written_to_is_done_without(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr("vioframe.jit.locked", Mock(side_effect=PermissionError))
    (tmp_path / "fresh.py").write_text(FRESH)
    assert runpy.run_path(str(tmp_path / "fresh.py"))["doubled"](2.0) == 4.0


TWO = """
from vioframe.jit import kernel

@kernel(inlined=True)
def half(x):
    return 0.5 * x

@kernel
def doubled(x):
    return 2.0 * x

@kernel
def as_it_was(x):
    return half(doubled(x))
"""


def test_a_module_has_been_compiled_once_all_of_its_kernels_have(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kernels"))
    (tmp_path / "two.py").write_text(TWO)
    module = ModuleType("two")
    vars(module).update(runpy.run_path(str(tmp_path / "two.py"), run_name="two"))
    assert not jit.have_been_compiled(module)
    assert module.doubled(2.0) == 4.0
    assert not jit.have_been_compiled(module)
    assert module.as_it_was(2.0) == 2.0
    assert jit.have_been_compiled(module)

"""A machine that has run out of something: one line says of what, and what was written until then stays whole."""

from __future__ import annotations

import os
import pwd
import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rendered_flight import DURATION_S

from faults.command_line import error_line, vioframe_, vioframe_process
from vioframe import jit
from vioframe.errors import RunError
from vioframe.parts import registry
from vioframe.parts.config import parse
from vioframe.pipeline import prepare, record
from vioframe.runs.folder import RunFolder

RUN = ("run", "good.bag", "--out", "out", "--quiet")


@contextmanager
def limited(kind: int, most: int) -> Iterator[None]:
    """This process may have no more of a resource than that."""
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)


def test_a_full_disk_is_one_line_and_keeps_what_was_written(here):
    with limited(resource.RLIMIT_FSIZE, 65536):
        line = error_line(*RUN, "--cores", 1)
    assert line == "vioframe: error: cannot write to out: File too large; is the disk full?\n"
    run = RunFolder.open("out")
    assert run.summary["finished"] is False
    assert 0 < len(run.trajectory()) < 10 * DURATION_S
    assert vioframe_("evaluate", "out", "--ground-truth", "truth.tum").exit_code == 0


def test_no_memory_for_images_is_one_line_with_a_remedy(here):
    with limited(resource.RLIMIT_FSIZE, 65536):
        line = error_line(*RUN, "--cores", 2)
    assert "no memory for the images that two processes share: File too large; --cores 1" in line
    assert not Path("out").exists()


@pytest.mark.parametrize("name", ["copy", "copy.bag", "copy.ros2", "copy.mcap"])
def test_a_full_disk_leaves_no_half_of_a_recording(here, name):
    before = sorted(os.listdir())
    # An image is smaller in an ASL folder, where it is packed.
    with limited(resource.RLIMIT_FSIZE, 65536 if "." in name else 8192):
        failed = vioframe_("convert", "good.bag", name)
    assert failed.exit_code == 2
    assert failed.stderr.splitlines()[-1].startswith(f"vioframe: error: cannot write {name}: ")
    assert failed.stderr.endswith("; check permissions and free space\n")
    assert sorted(os.listdir()) == before


def test_a_full_disk_leaves_the_evaluation_that_was_there(here):
    run = ("run", "good.bag", "--ground-truth", "truth.tum", "--duration", 3, "--out", "out", "--quiet")
    assert vioframe_(*run).exit_code == 0
    assert vioframe_("evaluate", "out").exit_code == 0
    before = Path("out/evaluation.json").read_bytes()
    with limited(resource.RLIMIT_FSIZE, 10):
        line = vioframe_("evaluate", "out").stderr
    assert "File too large" in line
    assert line.count("\n") == 1
    assert Path("out/evaluation.json").read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("command", [("plugins",), ("evaluate", "run", "--format", "csv")])
def test_output_that_cannot_be_written_is_one_line(here, command):
    with Path("/dev/full").open("w") as full:
        process = vioframe_process(*command, stdout=full, env={**os.environ, "COLUMNS": "100"})
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert stderr == (
        "vioframe: error: cannot read or write the output: No space left on device; check permissions and free space\n"
    )


def test_an_evaluation_that_cannot_be_kept_is_still_shown(here, monkeypatch):
    def refuse(path: Path, tree: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("vioframe.runs.recorder.write_json", refuse)
    result = vioframe_("evaluate", "run", "--format", "csv")
    assert result.exit_code == 2
    assert result.stdout.count("\n") >= 2
    assert "cannot read or write run/evaluation.json: Permission denied" in result.stderr


def test_a_reader_that_closes_the_pipe_early_is_no_error(here):
    process = vioframe_process("evaluate", "run", stdout=subprocess.PIPE)
    process.stdout.close()
    assert "Traceback" not in process.communicate(timeout=60)[1]


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (("run", "good.bag", "--duration", 0.2, "--out", "/proc/run"), "cannot create the run folder /proc/run"),
        (("convert", "good.bag", "/proc/copy"), "cannot write /proc/copy"),
        (("plot", "run", "--out", "/proc/plots"), "/proc/plots"),
    ],
)
def test_a_place_that_nobody_can_write_to_is_named(here, command, says):
    assert says in error_line(*command)


def test_too_few_file_descriptors_are_said(here):
    with limited(resource.RLIMIT_NOFILE, len(os.listdir("/proc/self/fd")) + 1):
        assert "Too many open files" in error_line(*RUN)
    assert vioframe_(*RUN, "--duration", 1, "--overwrite").exit_code == 0


def test_memory_that_runs_out_is_one_line(here, monkeypatch):
    def ask(*_: object, **__: object) -> None:
        bytearray(2**62)

    monkeypatch.setattr("vioframe.pipeline.prepare", ask)
    assert error_line(*RUN) == "vioframe: error: out of memory; give it less at a time, or a larger machine\n"


def test_without_home_name_or_cache_kernels_go_to_a_temporary_folder(tmp_path, monkeypatch):
    """As in a container that is run as a user it does not know."""

    def unknown(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    for name in ("HOME", "XDG_CACHE_HOME", "USER", "LOGNAME", "LNAME", "USERNAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.setattr(jit.tempfile, "gettempdir", lambda: str(tmp_path))
    jit._temporary_folder.cache_clear()
    folder = jit._folder("")
    jit._temporary_folder.cache_clear()
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o077 == 0


def test_of_two_runs_into_one_folder_the_second_is_refused_and_the_first_whole(here):
    config = parse({"dataset": {"path": "good.bag"}, "duration_s": 2.0})
    first, second = (prepare(config, registry.load()) for _ in range(2))
    refused = []

    def meanwhile(_: object) -> None:
        if not refused:
            with pytest.raises(RunError, match="out exists already") as caught:
                record(second, Path("out"))
            refused.append(caught)

    summary = record(first, Path("out"), on_step=meanwhile)
    assert refused
    assert summary["finished"] is True
    assert len(RunFolder.open("out").trajectory()) == 11

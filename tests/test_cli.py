"""The command line, end to end on a small made-up recording: what it writes, says and returns."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from plugin_helpers import install
from ruamel.yaml import YAML

import vioframe.cli
import vioframe.cli.run as cli_run
from vioframe import pipeline
from vioframe.cli import main
from vioframe.cores import ONE_BLAS_THREAD
from vioframe.frontend_process import FrontendProcess
from vioframe.parts import config
from vioframe.runs.folder import RunFolder

HEAVY = {"cv2", "torch", "open3d", "filterpy", "numba", "matplotlib", "scipy", "numpy", "pydantic", "rich"}

# A recording of 60 frames at rest, of which the first second goes by before the back-end begins, and parts that fail.
PARTS = """
import time
import numpy as np
from vioframe.io.calibration import packaged_calibration
from vioframe.errors import DatasetError
from vioframe.geometry.cameras import Camera
from vioframe.types import *

class Toy:
    "Sixty small frames of noise."
    name, frame_count, ground_truth = "toy", 60, None
    def __init__(self, path, *, broken_at: int = 99, pause_s: float = 0.0, calibration: list[str] | None = None):
        camera = Camera(100.0, 100.0, 64.0, 48.0, (0.0, 0.0, 0.0, 0.0), (128, 96))
        self.calibration = packaged_calibration("euroc", cameras=["cam0"]).with_camera(0, model=camera)
        self.broken_at, self.pause_s = broken_at, pause_s
    @staticmethod
    def accepts(path): return path.suffix == ".toy"
    def measurements(self):
        image = np.random.default_rng(0).integers(0, 255, (96, 128), dtype=np.uint8)
        for k in range(640):
            yield ImuSample(10**9 + k * 5_000_000, np.zeros(3), np.array([0.0, 0.0, 9.81]))
            if k % 10 == 0 and k < 600:
                if k == 10 * self.broken_at:
                    raise DatasetError("the recording ends in the middle of a message; record it again")
                time.sleep(self.pause_s)
                yield FrameSet(10**9 + k * 5_000_000, (image,))

class Still:
    "Says that the body rests."
    def __init__(self, *, raise_at: int = 99, speed: float = 0.0):
        self.raise_at, self.speed = raise_at, speed
    def begin(self, start):
        self.k = 0
    def process(self, imu, tracks, still):
        self.k += 1
        if self.k == self.raise_at: raise ZeroDivisionError("division\\nby zero")
        state = NavState(tracks.t_ns, np.eye(3), np.array([self.speed * self.k, 0, 0]), *np.zeros((3, 3)))
        return Estimate(Status.TRACKING, state, np.array([1]), np.ones((1, 3)))

@hookimpl
def vioframe_datasets(): return {"toy": Toy}
@hookimpl
def vioframe_backends(): return {"still": Still}
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """The recording, in a working folder of its own, with its parts installed."""
    install(tmp_path / "site", monkeypatch, distribution="toy-parts", module="toy_parts", code=PARTS)
    monkeypatch.chdir(tmp_path)
    Path("flight.toy").touch()
    return Path("flight.toy")


def vioframe_(*arguments: object, code: int = 0):
    result = CliRunner().invoke(main, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result


def error_line(*arguments: object) -> str:
    """What a command that fails says: one line, exit code 2."""
    result = vioframe_(*arguments, code=2)
    assert result.stderr.count("\n") == 1, result.stderr
    return result.stderr


def run_toy(toy, *arguments: object, **kwargs):
    return vioframe_("run", toy, "--backend", "still", *arguments, **kwargs)


LOOK_AT_HELP = "from vioframe.cli import main; main(['--help'], standalone_mode=False)"
BEGIN_THE_OTHER_PROCESS = "import vioframe.cli.run as r; r.FrontendProcess().close()"
WITHOUT_NUMPY = (LOOK_AT_HELP, BEGIN_THE_OTHER_PROCESS)


@pytest.mark.parametrize("statement", ["import vioframe", "import vioframe.types, vioframe.interfaces", *WITHOUT_NUMPY])
def test_nothing_heavy_is_loaded_before_it_is_needed(statement):
    code = f"import sys; {statement}; print(*sorted({{m.partition('.')[0] for m in sys.modules}}), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    loaded = set(done.stderr.split())
    assert not loaded & (HEAVY if statement in WITHOUT_NUMPY else HEAVY - {"numpy"})


BEGIN_A_RUN = """
import sys
from vioframe.cores import limited_threads
from vioframe.parts import registry
import vioframe.frontend_worker, vioframe.pipeline
installed = registry.load()
backends = [installed.create_backend(name) for name in ("msckf", "sliding_window")]
with limited_threads():
    loaded = "scipy.linalg" in sys.modules
    import scipy.linalg
    from threadpoolctl import threadpool_info
    print(loaded, {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"})
"""


@pytest.mark.parametrize(("said", "loaded"), [({}, True), (ONE_BLAS_THREAD, False)])
def test_scipy_comes_late_and_with_one_thread(said, loaded):
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")} | said
    begin = [sys.executable, "-c", BEGIN_A_RUN]
    done = subprocess.run(begin, check=True, capture_output=True, text=True, env=environment)
    assert done.stdout == f"{loaded} {{1}}\n"


def test_what_scipy_copies_of_numpy_is_loaded_when_somebody_looks_into_it():
    code = """
import sys, vioframe.pipeline, scipy.linalg
assert not {"numpy.f2py.f2py2e", "numpy.testing._private.utils", "unittest"} & set(sys.modules)
import numpy.f2py
from numpy.testing import assert_array_equal
assert_array_equal([1], [1])
assert callable(numpy.f2py.main)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_module_and_script_are_the_same():
    done = subprocess.run([sys.executable, "-m", "vioframe", "--version"], check=True, capture_output=True, text=True)
    assert done.stdout == f"vioframe, version {vioframe.__version__}\n"


def test_every_listed_command_exists_and_says_what_it_does():
    listing = vioframe_("--help").output
    for name, short in vioframe.cli._COMMANDS.items():
        assert f"{name} " in listing
        assert short in listing
        assert "Usage: " in vioframe_(name, "--help").output


def test_progress_and_summary_are_left_out_by_one_word():
    """By every command that shows progress, and no other; and no help text names what is not installed."""
    commands = [[name] for name in vioframe.cli._COMMANDS] + [["bench", "euroc"], ["bench", "detectors"]]
    texts = {" ".join(words): " ".join(vioframe_(*words, "--help").output.split()) for words in commands}
    quiet = {name for name, text in texts.items() if "--quiet No progress bar and no summary." in text}
    assert quiet == {"run", "simulate", "convert", "train", "montecarlo", "bench euroc", "bench detectors"}
    assert not [name for name, text in texts.items() if "docs/" in text]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("run --backend s", {"still", "sliding_window"}),
        ("plugins sti", {"still"}),
        ("simulate --flight fig", {"figure_eight"}),
    ],
)
def test_the_shell_completes_the_names_of_parts(toy, words, found):
    asked = {"COMP_WORDS": f"vioframe {words}", "COMP_CWORD": str(len(words.split()))}
    result = CliRunner().invoke(main, env={**asked, "_VIOFRAME_COMPLETE": "bash_complete"}, prog_name="vioframe")
    assert set(result.stdout.split()) == {f"plain,{name}" for name in found}


def test_an_unknown_command_is_refused():
    assert "No such command 'rnu' (did you mean 'run'?)" in vioframe_("rnu", code=2).output


def test_a_run_from_recording_to_folder(toy):
    result = run_toy(toy)
    folder = Path("runs/toy_shi_tomasi_still")
    assert {p.name for p in folder.iterdir()} == {
        *("trajectory.tum", "states.csv", "pose_cov.csv", "tracks.csv", "timings.csv", "map.ply"),
        *("config.yaml", "machine.json", "summary.json", "calibration", "calibration.csv", "calibration_learned"),
    }
    run = RunFolder.open(folder)
    assert run.summary["finished"] is True
    assert run.summary["frames"] == 60
    assert run.summary["initialised_after_s"] == pytest.approx(0.95)
    assert run.summary["plugins"]["backend"] == "toy-parts 1.0"
    assert len(run.trajectory()) == 41
    assert "60 frames, initialised after 0.95 s, then 100.0% tracked, 0 resets" in result.stdout
    assert f"vioframe evaluate {folder}" in result.stdout
    assert "frames/s" in result.stderr
    assert "x real time" in result.stderr


def test_a_run_on_two_cores_is_the_same_byte_for_byte(toy, monkeypatch):
    begun = []
    monkeypatch.setattr(cli_run, "FrontendProcess", lambda: begun.append(FrontendProcess()) or begun[-1])
    for cores in (1, 2):
        run_toy(toy, "--cores", cores, "--out", f"on{cores}")
        assert len(begun) == cores - 1
    for file in ("trajectory.tum", "states.csv", "tracks.csv"):
        first, second = (Path(f"on{cores}", file).read_bytes() for cores in (1, 2))
        assert len(first) > 1000
        assert first == second, file


def test_quiet_says_nothing(toy):
    assert run_toy(toy, "--quiet").output == ""


FRESH = """
from vioframe.jit import kernel
from vioframe.parts.hooks import hookimpl
from toy_parts import Still

@kernel
def doubled(x):
    return 2.0 * x

class Compiled(Still):
    def __init__(self): super().__init__(); doubled(1.0)

@hookimpl
def vioframe_backends(): return {"compiled": Compiled}
"""


def test_compiling_is_said_once_and_never_with_quiet(toy, tmp_path, monkeypatch):
    import numba

    install(tmp_path / "site2", monkeypatch, distribution="fresh", module="fresh_parts", code=FRESH)
    for cache, quiet, said in (("a", [], 1), ("a", [], 0), ("b", ["--quiet"], 0)):
        monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / cache))
        monkeypatch.delitem(sys.modules, "fresh_parts", raising=False)
        result = vioframe_("run", toy, "--backend", "compiled", "--out", "run", "--overwrite", *quiet)
        assert result.stderr.count("compiling kernels (once after installation)") == said, result.stderr


@pytest.mark.parametrize(
    ("played", "total"),
    [([], 60), (["--duration", "1"], 21), (["--start", "1"], 40), (["--start", "1", "--duration", "9"], 40)],
)
def test_the_bar_knows_how_many_frames_a_part_of_a_recording_has(toy, played, total, monkeypatch):
    totals = []

    def told(bar, *_, total=None, **__):
        totals.append(total)
        bar.progress.update(bar._id, advance=1)

    monkeypatch.setattr("vioframe.cli.common.Bar.__call__", told)
    run_toy(toy, *played)
    assert abs(totals[10] - total) <= 3
    assert abs(totals[-1] - total) <= 1


def test_a_run_is_repeated_from_its_own_configuration(toy):
    run_toy(toy, "-o", "speed=0.5", "-o", "max_points=37", "--start", 0.2, "--duration", 1.4, "--out", "a", "--quiet")
    vioframe_("run", "--config", "a/config.yaml", "--out", "b", "--quiet")
    assert json.loads(Path("b/summary.json").read_text())["frames"] == 29
    for name in ("trajectory.tum", "states.csv", "pose_cov.csv", "tracks.csv", "map.ply", "config.yaml"):
        assert len(Path("a", name).read_bytes()) > 100
        assert Path("a", name).read_bytes() == Path("b", name).read_bytes()


def test_the_command_line_overrides_the_file(toy):
    Path("c.yaml").write_text("backend: {name: still, options: {speed: 2}}\nfrontend: {max_points: 90}\nstart_s: 0.5\n")
    vioframe_("run", toy, "--config", "c.yaml", "-o", "speed=3", "--start", 0.1, "--out", "a", "--quiet")
    used = config.read("a/config.yaml")
    assert (used.backend.options["speed"], used.frontend["max_points"], used.start_s) == (3.0, 90, 0.1)


def test_another_part_does_not_inherit_the_options_of_the_one_in_the_file(toy):
    Path("c.yaml").write_text("detector: {name: shi_tomasi, options: {quality_level: 0.5}}\nbackend: {name: still}\n")
    # ORB finds nothing in images so small, so that the run never begins.
    vioframe_("run", toy, "--config", "c.yaml", "--detector", "orb", "--out", "a", "--quiet", code=1)
    assert config.read("a/config.yaml").detector.name == "orb"
    vioframe_("run", toy, "--config", "c.yaml", "--detector", "shi_tomasi", "--out", "b", "--quiet")
    assert config.read("b/config.yaml").detector.options["quality_level"] == 0.5


def test_ground_truth_is_kept_with_the_run_and_compared(toy):
    rows = "".join(f"{1 + 0.05 * k:.9f} {0.5 * (k + 1)} 0 0 0 0 0 1\n" for k in range(60))
    Path("truth.tum").write_text(rows)
    # The toy's back-end moves, its images do not.
    moving = "-o", "speed=0.5", "-o", "zero_velocity_update=false"
    result = run_toy(toy, *moving, "--ground-truth", "truth.tum", "--out", "a")
    assert "ATE 0.0 mm (position and yaw aligned) over 20.0 m" in result.stdout
    assert len(RunFolder.open("a").ground_truth()) == 60


def test_no_frame_waits_for_the_ground_truth(toy, monkeypatch):
    rows = []

    def read(experiment):
        rows.append(len(Path("a/timings.csv").read_text().splitlines()))
        raise vioframe.errors.DatasetError("this recording is damaged")

    monkeypatch.setattr(pipeline.Experiment, "ground_truth", property(read))
    assert "this recording is damaged" in error_line("run", toy, "--backend", "still", "--quiet", "--out", "a")
    assert rows == [61]
    # Where it ended before, that is what is told.
    broken = "-o", "broken_at=40"
    line = error_line("run", toy, "--backend", "still", *broken, "--quiet", "--out", "a", "--overwrite")
    assert "ends in the middle of a message" in line
    assert rows[1] < 61


def test_runs_never_overwrite_one_another_unless_asked(toy):
    run_toy(toy, "--quiet")
    run_toy(toy, "--quiet")
    assert Path("runs/toy_shi_tomasi_still_2").is_dir()
    out = "runs/toy_shi_tomasi_still"
    before = Path(out, "trajectory.tum").stat().st_mtime_ns
    assert "exists already" in error_line("run", toy, "--backend", "still", "--out", out)
    assert Path(out, "trajectory.tum").stat().st_mtime_ns == before
    run_toy(toy, "--out", out, "--overwrite", "--quiet")
    assert Path(out, "trajectory.tum").stat().st_mtime_ns > before


def test_a_recording_that_breaks_off_keeps_what_was_done(toy):
    line = error_line("run", toy, "--backend", "still", "-o", "broken_at=40", "--quiet", "--out", "a")
    assert "ends in the middle of a message; record it again; what was estimated until then is in a" in line
    assert len(RunFolder.open("a").trajectory()) >= 15


def test_an_error_before_the_first_frame_leaves_everything_as_it_was(toy):
    run_toy(toy, "--out", "a", "--quiet")
    before = Path("a/trajectory.tum").read_bytes()
    error_line("run", toy, "--backend", "still", "-o", "raise_at=1", "--quiet", "--out", "a", "--overwrite")
    assert Path("a/trajectory.tum").read_bytes() == before
    error_line("run", toy, "--backend", "still", "-o", "broken_at=0", "--quiet", "--out", "new")
    assert not Path("new").exists()


def test_debug_shows_the_traceback(toy):
    with pytest.raises(vioframe.errors.PluginError) as raised:
        vioframe_("--debug", "run", toy, "--backend", "still", "-o", "raise_at=35", "--quiet")
    assert isinstance(raised.value.__cause__, ZeroDivisionError)


def test_ctrl_c_completes_the_folder_and_exits_130(toy, tmp_path):
    command = [sys.executable, "-m", "vioframe", "run", toy, "--backend", "still", "-o", "pause_s=0.2", "--out", "a"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    while not (Path("a/timings.csv").is_file() and len(Path("a/timings.csv").read_text().splitlines()) > 4):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted; what was estimated until then is in a" in stderr
    assert "Traceback" not in stderr
    run = RunFolder.open("a")
    assert run.summary["finished"] is False
    assert 4 <= run.summary["frames"] < 60
    assert Path("a/map.ply").read_text().startswith("ply\n")


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["missing.bag"], "missing.bag does not exist"),
        ([], "no data given: `vioframe run DATA`"),
        (["flight.toy", "--detector", "obr"], "no detector is called 'obr' (did you mean 'orb'?)"),
        (["flight.toy", "--backend", "stil"], "no backend is called 'stil' (did you mean 'still'?)"),
        (["flight.toy", "--reader", "tyo"], "no reader is called 'tyo' (did you mean 'toy'?)"),
        (["flight.toy", "--backend", "still", "-o", "sped=1"], "no part has such an option (did you mean 'speed'?)"),
        (["flight.toy", "--backend", "still", "-o", "speed=fast"], "speed='fast': Input should be a valid number"),
        (["flight.toy", "--config", "none.yaml"], "cannot read the configuration none.yaml"),
        (["flight.toy", "--start", "-1"], "error: --start: Input should be greater than or equal to 0"),
        (["flight.toy", "--backend", "still", "--start", "50"], "its images span 3.0 s, of which --start and"),
        (["flight.toy", "--backend", "still", "--ground-truth", "none.tum"], "none.tum: no such trajectory file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(toy, arguments, why):
    assert why in error_line("run", *arguments)
    assert not Path("runs").exists()


def test_clocks_apart_are_said_with_both_spans(toy):
    late = PARTS.replace("yield FrameSet(10**9 +", "yield FrameSet(10**12 +")
    Path("site/toy_parts.py").write_text("from vioframe.parts.hooks import hookimpl\n" + late)
    line = error_line("run", toy, "--backend", "still")
    assert "overlap nowhere: the camera speaks from 1000.000 to 1002.950 s and the IMU from 1.000 to 4.195 s" in line


def test_cameras_left_aside_are_named(toy):
    pair = PARTS.replace("broken_at: int = 99,", "cameras: list[str] | None = None, broken_at: int = 99,").replace(
        "        self.broken_at,",
        "        if not cameras:\n"
        "            other = replace(self.calibration.cameras[0], name='cam1')\n"
        "            self.calibration = replace(self.calibration, cameras=(*self.calibration.cameras, other))\n"
        "        self.broken_at,",
    )
    Path("site/toy_parts.py").write_text("from vioframe.parts.hooks import hookimpl\n" + pair)
    shown = run_toy(toy).stdout
    assert "camera cam0 is used, cam1 left aside; --cameras cam1 takes another" in shown
    for key, value in (("--cameras", "cam0"), ("-o", "cameras=[cam0]")):
        assert "left aside" not in run_toy(toy, key, value, "--out", f"runs/{key}").stdout
        said = YAML(typ="safe").load(Path(f"runs/{key}/config.yaml"))
        assert said["dataset"]["options"]["cameras"] == ["cam0"]


def test_plugins_lists_what_is_there_and_what_failed(toy, tmp_path, monkeypatch):
    install(tmp_path / "bad", monkeypatch, distribution="bad-parts", module="bad_parts", code="import not_there_at_all")
    monkeypatch.setenv("COLUMNS", "200")
    result = vioframe_("plugins")
    lines = result.stdout.splitlines()
    assert any(line.split()[:4] == ["backend", "still", "toy-parts", "1.0"] for line in lines)
    assert any(line.split()[:3] == ["dataset", "euroc", "vioframe"] for line in lines)
    (failed,) = [line for line in lines if line.startswith("bad_parts")]
    assert failed.split()[1:3] == ["bad-parts", "1.0"]
    assert "ModuleNotFoundError: No module named 'not_there_at_all'" in failed
    assert "warning: plug-in bad_parts (bad-parts 1.0) is skipped" in result.stderr


def test_plugins_shows_both_of_a_name_and_says_so(toy, tmp_path, monkeypatch):
    code = "class Mine:\n  def detect(self, image, n): ...\n@hookimpl\ndef vioframe_detectors(): return {'orb': Mine}"
    install(tmp_path / "thief", monkeypatch, distribution="thief", module="thief_parts", code=code)
    monkeypatch.setenv("COLUMNS", "200")
    result = vioframe_("plugins")
    assert "detector     orb@thief" in result.stdout
    assert "detector     orb@vioframe" in result.stdout
    assert "note: several plug-ins provide a detector called 'orb'; say orb@vioframe or orb@thief" in result.stderr
    assert "(thief 1.0)" in vioframe_("plugins", "orb").stdout
    assert "say orb@vioframe or orb@thief" in error_line("run", toy, "--backend", "still", "--detector", "orb")


def test_plugins_shows_the_options_of_one(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    lines = vioframe_("plugins", "msckf").stdout.splitlines()
    (window,) = [line for line in lines if line.startswith("max_clones")]
    assert window.split()[1:3] == ["int", "11"]
    assert window.endswith("Past poses kept in the state.") or "kept in the state" in window
    assert "did you mean 'msckf'?" in error_line("plugins", "msckff")


def test_config_prints_a_complete_file_that_checks(tmp_path):
    text = vioframe_("config", "--detector", "orb").stdout
    file = tmp_path / "c.yaml"
    file.write_text(text)
    assert YAML(typ="safe").load(text)["detector"]["name"] == "orb"
    assert vioframe_("config", "--check", file).stdout == f"{file} is valid\n"
    file.write_text(text.replace("max_points:", "max_pionts:"))
    assert "did you mean 'max_points'?" in error_line("config", "--check", file)

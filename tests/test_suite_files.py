"""Suites as files, what a sequence is flown on, and the tasks that come of both."""

from pathlib import Path
from shutil import copytree, move, rmtree

import click
import numpy as np
import pytest
from click.testing import CliRunner
from suite_recordings import record_toy

from vioframe.bench.suites import sources
from vioframe.bench.suites import suite as suites
from vioframe.bench.suites.plan import plan
from vioframe.bench.suites.sources import EUROC
from vioframe.bench.suites.suite import Suite
from vioframe.cli import main
from vioframe.cli.bench import bench
from vioframe.errors import ConfigError, DatasetError, VioframeError
from vioframe.io.convert import convert
from vioframe.parts import registry
from vioframe.parts.config import to_yaml
from vioframe.runs.results import FINGERPRINT, Data
from vioframe.simulation.config import SimulationConfig, complete
from vioframe.simulation.record import record
from vioframe.simulation.recording import SimulatedRecording

INSTALLED = registry.load()
TOY = "detectors: [fast]\nbackends: [msckf]\nsequences: [TOY]\ntitle: toy\n"


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that TOY is in."""
    return record_toy(tmp_path_factory.mktemp("toy")).parent


def read(folder: Path, text: str) -> Suite:
    path = folder / "toy.yaml"
    path.write_text(text)
    return suites.read(path)


class TestFiles:
    def test_shipped_suites_are_whole(self):
        assert set(suites.shipped()) == {
            "consistency",
            "detector_fps",
            "euroc",
            "mh05_comparison",
            "speed",
            "stress",
            "tuning",
        }
        for name, path in suites.shipped().items():
            assert isinstance(bench.get_command(click.Context(bench), name), click.Command)
            suite = suites.read(path)
            assert suite.name == name
            assert suite.description

    def test_the_stress_suite_is_as_large_as_promised(self):
        stress = suites.read(suites.find("stress"))
        assert [len(levels) for levels in stress.conditions.values()] == [3, 3, 3, 3, 3]
        assert (len(stress.detectors), len(stress.backends), stress.seeds) == (4, 4, 10)

    def test_a_suite_survives_being_written(self, tmp_path):
        for path in suites.shipped().values():
            suite = suites.read(path)
            again = tmp_path / "again.yaml"
            again.write_text(to_yaml(suite))
            assert suites.read(again) == suite

    @pytest.mark.parametrize(
        ("text", "complaint"),
        [
            (TOY + "seed: 3\n", "unknown key 'seed' (did you mean 'seeds'?)"),
            (
                TOY.replace("sequences:", "sequences: [{name: a, flight: b}] #"),
                "unknown key 'sequences.0.flight'; keys here: name, start_s, duration_s",
            ),
            (TOY + "conditions: {fgo: [0.5]}\n", "did you mean 'fog'"),
            (TOY + "conditions: {fog: [0.0]}\n", "greater than 0"),
            (TOY + "clear: false\n", "nothing to fly"),
            (TOY.replace("[fast]", "[fast, fast]"), "'fast' is named twice"),
            (TOY + "conditions: {fog: [0.5, 0.5]}\n", "fog has a level twice"),
            (TOY + "frontend: {max_pointz: 9}\n", "did you mean 'max_points'"),
            (TOY.replace("[fast]", "[]"), "flights need detectors, backends and sequences"),
            (TOY + "reference: {band: {half_widthm: 0.2, axes: {}}}\n", "did you mean 'half_width_m'"),
            (TOY + "rounds: 3\n", "rounds does nothing in a suite of kind flights"),
            (
                "title: t\nkind: trials\nbackends: [msckf]\nsetup: {speed: 1}\n",
                "unknown key 'setup.speed'; keys here: flight",
            ),
            (
                "title: t\nkind: trials\nbackends: [msckf]\nsetup: {duration_s: 1}\n",
                "setup.duration_s: Input should be greater than or equal to 10",
            ),
        ],
    )
    def test_mistakes_are_said_in_a_line(self, tmp_path, text, complaint):
        with pytest.raises(ConfigError) as raised:
            read(tmp_path, text)
        assert complaint in str(raised.value)
        assert "\n" not in str(raised.value)

    def test_a_suite_may_name_a_file_of_claims(self, tmp_path):
        (tmp_path / "claims.yaml").write_text("called: somebody\nband: {half_width_m: 0.1, axes: {y: y}}\n")
        suite = read(tmp_path, TOY + "reference: claims.yaml\n")
        assert (suite.reference.called, suite.reference.band.half_width_m) == ("somebody", 0.1)
        assert read(tmp_path, TOY).reference.band is None

    def test_the_thesis_is_the_reference_of_two_suites_alone(self):
        named = {name for name, path in suites.shipped().items() if suites.read(path).reference.called}
        assert named == {"detector_fps", "mh05_comparison"}

    def test_an_unknown_name_is_met_with_the_nearest(self):
        with pytest.raises(ConfigError, match="did you mean 'stress'"):
            suites.find("stres")

    def test_a_suite_can_be_narrowed(self):
        whole = suites.read(suites.find("mh05_comparison"))
        part = suites.narrowed(whole, detectors=["keypointnet"], backends=["msckf"], seeds=1)
        assert [each.called for each in part.detectors] == ["keypointnet"]
        assert [each.called for each in part.backends] == ["msckf"]
        assert part.seeds == 1
        with pytest.raises(ConfigError, match="it has shi_tomasi, shi_tomasi:min_distance_px=4, keypointnet"):
            suites.narrowed(whole, detectors=["orb"])

    @pytest.mark.parametrize(
        ("name", "option"),
        [("detector_fps", "--seeds=2"), ("detector_fps", "--workers=1"), ("consistency", "--data=.")],
    )
    def test_an_option_that_would_do_nothing_is_an_error(self, tmp_path, name, option):
        result = CliRunner().invoke(main, ["bench", name, option, "--out", str(tmp_path / "out")])
        assert result.exit_code == 2
        assert f"{option.partition('=')[0]} does nothing in a suite of kind" in result.stderr
        assert not (tmp_path / "out").exists()


class TestSources:
    @pytest.fixture
    def motion(self, shared_data):
        return shared_data / "euroc_imu_gt"

    def flown(self, name, folders, conditions=None, **changes):
        source = sources.find_source(name, folders, INSTALLED)
        given = {
            "start_s": None,
            "duration_s": None,
            "conditions": conditions or {},
            "rig": "mono",
            "seed": 0,
        } | changes
        return sources.flown(source, installed=INSTALLED, **given)

    def test_a_recording_is_found_and_taken_as_it_is(self, toy, tmp_path):
        found = self.flown("TOY", [toy])
        assert (found.data, found.recording, found.simulated) == (Data.REAL, toy / "TOY", None)
        # As EuRoC's site has it: a folder a place, a folder a sequence.
        deep = tmp_path / "hall" / "TOY"
        copytree(toy, deep)
        assert self.flown("TOY", [tmp_path]).recording == deep / "TOY"

    def test_data_are_known_by_what_they_are_not_by_where(self, toy, tmp_path):
        copytree(toy, tmp_path / "copy")
        here, there = self.flown("TOY", [toy]), self.flown("TOY", [tmp_path / "copy"])
        assert here.digest == there.digest
        for changed in ("imu0/data.csv", "cam0/sensor.yaml"):
            before = self.flown("TOY", [tmp_path / "copy"]).digest
            file = tmp_path / "copy" / "TOY" / "mav0" / changed
            file.write_text(file.read_text() + "\n")
            assert self.flown("TOY", [tmp_path / "copy"]).digest != before

    def test_what_the_simulator_wrote_is_never_called_real(self, tmp_path):
        config = complete(SimulationConfig(duration_s=0.3), INSTALLED)
        record(SimulatedRecording(config, INSTALLED), [tmp_path / "MH_01_easy.bag"])
        found = self.flown("MH_01_easy", [tmp_path])
        assert found.data is Data.SIMULATED
        assert found.note.endswith(", in world 0, which is for training and not for reporting")
        with pytest.raises(ConfigError, match="simulation already"):
            self.flown("MH_01_easy", [tmp_path], {"fog": 0.5})
        rmtree(tmp_path / "MH_01_easy.bag.simulation")
        with pytest.raises(DatasetError, match=r"MH_01_easy.bag.simulation .* copy that too"):
            self.flown("MH_01_easy", [tmp_path])

    @pytest.mark.parametrize("name", EUROC)
    def test_every_sequence_has_a_stand_in_that_can_be_flown(self, name):
        found = self.flown(name, [])
        assert (found.data, found.start_s) == (Data.SIMULATED, 0.0)
        assert name in found.note
        options = found.simulated.flight.options
        INSTALLED.create_flight("tour", 5.0, np.eye(3), options)

    def test_without_images_they_are_rendered_along_the_motion(self, motion):
        found = self.flown("MH_05_difficult", [motion])
        assert (found.data, found.start_s) == (Data.RENDERED, 5.0)
        assert found.simulated.recorded == motion / "MH_05_difficult"

    def test_conditions_are_rendered_even_where_there_are_images(self, shared_data, tmp_path):
        clip = tmp_path / "MH_01_easy"
        copytree(shared_data / "euroc" / "MH_01_easy_15s", clip)
        assert self.flown("MH_01_easy", [tmp_path], start_s=0.0).data is Data.REAL
        foggy = self.flown("MH_01_easy", [tmp_path], {"fog": 0.5}, start_s=0.0)
        assert (foggy.data, foggy.simulated.conditions) == (Data.RENDERED, {"fog": 0.5})

    def test_a_bag_takes_its_truth_from_the_folder_beside_it(self, shared_data, toy, tmp_path):
        clip = shared_data / "euroc" / "MH_01_easy_15s"
        dataset = INSTALLED.open_dataset(clip)
        convert(dataset.measurements(), dataset.calibration, tmp_path / "MH_01_easy.bag")
        with pytest.raises(DatasetError, match="comes without ground truth"):
            self.flown("MH_01_easy", [tmp_path])
        folder = tmp_path / "MH_01_easy" / "mav0"
        copytree(clip / "mav0", folder)
        move(folder / "cam0" / "data", tmp_path / "images")
        found = self.flown("MH_01_easy", [tmp_path])
        assert found.recording == tmp_path / "MH_01_easy.bag"
        assert found.ground_truth == folder / "state_groundtruth_estimate0" / "data.csv"

    def test_what_nothing_is_known_of_is_an_error(self, tmp_path):
        with pytest.raises(DatasetError, match="did you mean 'MH_01_easy'"):
            self.flown("MH_01_eazy", [tmp_path])
        with pytest.raises(DatasetError, match="is no folder"):
            self.flown("MH_01_easy", [tmp_path / "nowhere"])


class TestPlan:
    def test_a_back_end_flies_with_the_rig_it_is_given(self, tmp_path):
        """Both on the same recording, one of them by its left camera alone."""
        both = "[msckf, {name: msckf, label: by two, rig: stereo}]"
        one, two = plan(read(tmp_path, TOY.replace("[msckf]", both).replace("TOY", "hover")), (), INSTALLED)
        assert one.recording == two.recording
        assert one.recording.config.rig == ("stereo",)
        assert [task.config.dataset.options["cameras"] for task in (one, two)] == [["cam0"], ["cam0", "cam1"]]
        assert one.about["config"] != two.about["config"]
        (alone,) = plan(read(tmp_path, TOY.replace("TOY", "hover")), (), INSTALLED)
        assert alone.recording.config.rig == ("mono",)
        with pytest.raises(ConfigError, match="trials all fly the rig of their setup"):
            read(tmp_path, "kind: trials\ntitle: toy\nbackends: [{name: msckf, rig: stereo}]\n")

    def test_a_task_for_each_place_in_the_grid(self, tmp_path):
        text = TOY.replace("[TOY]", "[hover]").replace("[fast]", "[fast, orb]")
        suite = read(tmp_path, text + "conditions: {fog: [0.5, 1.0]}\nseeds: 2\nseeds_vary: recording\n")
        tasks = plan(suite, (), INSTALLED)
        assert len({task.name for task in tasks}) == len(tasks) == 2 * 3 * 2
        recordings = {task.recording.name for task in tasks}
        assert len(recordings) == 3 * 2
        assert {task.config.start_s for task in tasks} == {0.0}

    def test_seeds_that_vary_the_start_share_a_recording(self, tmp_path):
        tasks = plan(read(tmp_path, TOY.replace("TOY", "hover") + "seeds: 3\n"), (), INSTALLED)
        assert len({task.recording.name for task in tasks}) == 1
        assert [task.config.start_s for task in tasks] == [0.0, 0.5, 1.0]

    def test_recordings_stay_the_same_where_more_are_flown(self, tmp_path):
        def recordings(seeds):
            text = TOY.replace("[TOY]", "[{name: hover, duration_s: 5.0}]")
            suite = read(tmp_path, f"{text}seeds: {seeds}\nseeds_vary: recording\n")
            return [task.recording for task in plan(suite, (), INSTALLED)]

        assert recordings(3)[:1] == recordings(1)

    def test_what_a_result_depends_on_is_in_its_fingerprint(self, tmp_path):
        def fingerprint(text):
            return plan(read(tmp_path, text.replace("TOY", "hover")), (), INSTALLED)[0].about

        first = fingerprint(TOY)
        assert [fingerprint(TOY)[key] for key in FINGERPRINT] == [first[key] for key in FINGERPRINT]
        for text, what in (
            (TOY + "frontend: {max_points: 99}\n", "config"),
            (TOY.replace("[fast]", "[{name: fast, options: {threshold: 9}}]"), "config"),
            (TOY + "metrics: [ate]\n", "config"),
            (TOY.replace("[TOY]", "[{name: hover, duration_s: 9}]"), "inputs"),
        ):
            changed = fingerprint(text)
            assert changed[what] != first[what]
            assert changed["code"] == first["code"]

    def test_two_tasks_of_one_name_are_an_error(self, tmp_path):
        twins = "[{name: fast, label: a b}, {name: orb, label: a_b}]"
        with pytest.raises(ConfigError, match="give their parts other labels"):
            plan(read(tmp_path, TOY.replace("[fast]", twins).replace("TOY", "hover")), (), INSTALLED)

    def test_a_flight_may_start_later_and_a_stand_in_does_not(self, tmp_path):
        later = TOY.replace("[TOY]", "[{name: hover, start_s: 5, duration_s: 3}, {name: V1_02_medium, start_s: 5}]")
        hover, stand_in = plan(read(tmp_path, later), (), INSTALLED)
        assert (hover.config.start_s, hover.recording.config.duration_s) == (5.0, 8.0)
        assert stand_in.config.start_s == 0.0

    def test_detectors_can_be_timed_on_recorded_frames(self, tmp_path, toy):
        text = "title: t\nkind: detector_speed\nsequences: [TOY]\n"
        (task,) = plan(read(tmp_path, text), [toy], INSTALLED)
        assert (task.about["data"], task.frames_of) == (Data.REAL, toy / "TOY")
        (drawn,) = plan(read(tmp_path, text), (), INSTALLED)
        assert (drawn.about["data"], drawn.frames_of) == (None, None)
        assert drawn.about["inputs"] != task.about["inputs"]

    def test_what_is_missing_is_said_before_anything_is_flown(self, tmp_path):
        for text in (
            TOY.replace("fast", "nothing"),
            TOY.replace("msckf", "nothing"),
            TOY + "metrics: [nothing]\n",
            "title: t\nkind: trials\nbackends: [msckf]\nsetup: {flight: nothing}\n",
            TOY.replace("[fast]", "[superpoint]"),
        ):
            with pytest.raises(VioframeError):
                plan(read(tmp_path, text.replace("TOY", "hover")), (), INSTALLED)

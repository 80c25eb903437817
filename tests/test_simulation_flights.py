"""Flights are what their names say, and exact readings of an IMU lead back to them."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from plugin_helpers import install
from simulated_imu import dead_reckoning_error_m

from vioframe.bench import run_backend
from vioframe.cli import main
from vioframe.errors import ConfigError, PluginError
from vioframe.geometry import so3
from vioframe.io.calibration import packaged_calibration
from vioframe.parts import registry
from vioframe.simulation import simulated_sequence
from vioframe.simulation.flights import ShapedFlight, flight, levelled
from vioframe.testing import check_flight
from vioframe.types import g_W

ROOT = Path(__file__).resolve().parents[1]
INSTALLED = registry.load()
FLIGHTS = INSTALLED.names(registry.FLIGHT)
R_BC = packaged_calibration("euroc", cameras=["cam0"]).cameras[0].R_BC


def still(t_s):
    return np.zeros((len(t_s), 3))


@pytest.mark.parametrize("name", FLIGHTS)
def test_every_flight_conforms(name):
    part = INSTALLED.find(registry.FLIGHT, name)
    check_flight(part.factory)
    if "speed" in {option.name for option in part.options}:
        check_flight(part.factory, speed=0.5)


@pytest.mark.parametrize("name", FLIGHTS)
def test_exact_readings_integrate_back_to_the_flight(name):
    assert dead_reckoning_error_m(flight(name, 10.0, R_BC)) < 1e-3


@pytest.mark.parametrize("name", FLIGHTS)
def test_flights_are_what_a_vehicle_can_do(name):
    motion = flight(name, 30.0, R_BC).at(np.linspace(0.0, 30.0, 3000))
    assert np.linalg.norm(motion.v_WB, axis=1).max() < 8.0
    assert np.linalg.norm(motion.a_WB - g_W, axis=1).max() < 2.5 * 9.81
    assert np.linalg.norm(motion.omega_B, axis=1).max() < 5.0


def test_rest_is_exact_and_between_two_rests_there_is_motion():
    path = flight("stop_and_go", 24.0, R_BC)
    # The spline of degree five reaches three control points of 0.25 s ahead.
    rest = path.at(np.linspace(0.0, 3.2, 50))
    assert np.array_equal(rest.a_WB, np.zeros((50, 3)))
    assert np.array_equal(rest.omega_B, np.zeros((50, 3)))
    np.testing.assert_allclose(path.at(np.linspace(13.0, 15.0, 9)).v_WB, 0.0, atol=1e-12)
    assert np.linalg.norm(path.at(np.linspace(5.0, 11.0, 50)).v_WB, axis=1).max() > 1.0


def test_flights_are_what_their_names_say():
    t_s = np.linspace(0.0, 20.0, 400)
    turning = flight("pure_rotation", 20.0, R_BC).at(t_s)
    assert not turning.v_WB.any()
    assert np.linalg.norm(turning.omega_B, axis=1).max() > 0.5
    straight = flight("constant_velocity", 20.0, R_BC).at(t_s)
    np.testing.assert_allclose(straight.v_WB, np.tile([1.0, 0.0, 0.0], (400, 1)), atol=1e-12)
    np.testing.assert_allclose(straight.a_WB, 0.0, atol=1e-9)
    assert np.linalg.norm(flight("aggressive", 20.0, R_BC).at(t_s).a_WB, axis=1).max() > 9.81
    # The camera looks ahead and is level: its z axis is W's x, its y axis points down.
    R_WC = straight.R_WB[0] @ R_BC
    np.testing.assert_allclose(R_WC, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)


class TestInspection:
    T_S = np.linspace(0.0, 30.0, 3001)
    MOTION = flight("inspection", 30.0, R_BC).at(T_S)

    def test_rests_then_takes_off(self):
        resting = self.T_S <= 1.25
        assert not self.MOTION.v_WB[resting].any()
        assert not self.MOTION.omega_B[resting].any()
        assert np.linalg.norm(self.MOTION.v_WB[self.T_S > 2.5], axis=1).min() > 0.0
        assert self.MOTION.p_WB[self.T_S < 6.0, 2].max() > 1.1

    def test_stops_and_looks(self):
        speed = np.linalg.norm(self.MOTION.v_WB, axis=1)
        flying = self.T_S > 5.0
        assert 0.2 < (speed[flying] < 0.15).mean() < 0.6
        assert speed.max() > 1.5

    def test_the_camera_faces_the_tank(self):
        to_axis = np.array([4.0, 0.0]) - self.MOTION.p_WB[:, :2]
        distance = np.linalg.norm(to_axis, axis=1)
        assert 3.8 < distance.min() < distance.max() < 4.2
        looks = (self.MOTION.R_WB @ R_BC)[:, :2, 2]
        ahead = (looks * to_axis).sum(axis=1) / (np.linalg.norm(looks, axis=1) * distance)
        assert np.rad2deg(np.arccos(ahead.min())) < 3.0

    def test_leans_as_a_multirotor_does(self):
        """Thrust is along the body's own vertical, so the specific force is, in the levelled frame."""
        force_B = np.einsum("nji,nj->ni", self.MOTION.R_WB, self.MOTION.a_WB - g_W)
        force_L = force_B @ levelled(R_BC).T
        leaning = np.rad2deg(np.arccos(force_L[:, 2] / np.linalg.norm(force_L, axis=1)))
        upright = np.rad2deg(np.arccos(self.MOTION.R_WB @ levelled(R_BC).T @ [0, 0, 1.0])[:, 2])
        assert leaning.max() < 3.0
        assert upright.max() > 8.0

    @pytest.mark.parametrize(("first_frame", "how"), [(0, "static"), (60, "dynamic")])
    def test_a_filter_starts_at_rest_and_in_motion(self, first_frame, how):
        sequence = simulated_sequence("inspection", duration_s=8.0, seed=1)
        backend = INSTALLED.create_backend("msckf")
        run = run_backend(replace(sequence, packets=sequence.packets[first_frame:]), backend)
        assert f"initialised ({how})" in [event for estimate in run.estimates for event in estimate.events]
        truth = dict(zip(sequence.ground_truth.t_ns.tolist(), sequence.ground_truth.p_WB, strict=True))
        moved = run.states[-1].p_WB - run.states[0].p_WB
        truly = truth[run.states[-1].t_ns] - truth[run.states[0].t_ns]
        # The estimate's own yaw is free: heights and horizontal distances compare, to the scale that a start must know.
        assert abs(moved[2] - truly[2]) < 0.05
        assert abs(np.hypot(*moved[:2]) - np.hypot(*truly[:2])) < 0.06 * np.hypot(*truly[:2])


def test_size_and_speed_scale_a_flight():
    """Twice the size at three times the speed is the same path, doubled and sooner, for every derivative."""
    t_s = np.linspace(0.2, 9.8, 100)
    R_LB = levelled(R_BC)
    for name in ("figure_eight", "stop_and_go", "hover"):
        plain = INSTALLED.create_flight(name, 30.0, R_LB).at(3.0 * t_s)
        scaled = INSTALLED.create_flight(name, 10.0, R_LB, {"size": 2.0, "speed": 3.0}).at(t_s)
        for power, field in enumerate(("p_WB", "v_WB", "a_WB")):
            expected = 2.0 * 3.0**power * getattr(plain, field)
            np.testing.assert_allclose(getattr(scaled, field), expected, atol=1e-9)
        np.testing.assert_allclose(scaled.omega_B, 3.0 * plain.omega_B, atol=1e-12)


@pytest.mark.parametrize("duration_s", [0.0, -1.0, np.nan, np.inf])
def test_a_flight_without_duration_is_refused(duration_s):
    with pytest.raises(ConfigError, match="must last longer than 0 s"):
        ShapedFlight(duration_s, still, still, np.eye(3))


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"size": -1.0}, {"speed": np.nan}, {"speed": 1e9}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="Input should be"):
        INSTALLED.create_flight("hover", 10.0, np.eye(3), options)


def test_an_unknown_flight_lists_those_there_are():
    with pytest.raises(PluginError, match="figure_eight"):
        simulated_sequence("loop_the_loop")


def test_ones_own_flight_is_flown_to_its_end():
    own = ShapedFlight(2.0, lambda t_s: np.outer(t_s, [0.0, 0.5, 0.0]), still, levelled(R_BC))
    sequence = simulated_sequence(own, None, duration_s=30.0)
    assert sequence.name == "ShapedFlight"
    assert sequence.ground_truth.duration_s == pytest.approx(2.0)
    np.testing.assert_allclose(sequence.true_states[-1].p_WB, [0.0, 1.0, 0.0], atol=1e-9)


def test_flights_and_worlds_of_third_parties_come_in_by_name(tmp_path, monkeypatch):
    code = """
    from dataclasses import dataclass
    import numpy as np
    from vioframe.simulation.flights import ShapedFlight
    def climb(duration_s, R_LB, *, rate: float = 0.5):
        still = lambda t_s: np.zeros((len(t_s), 3))
        return ShapedFlight(duration_s, lambda t_s: np.outer(t_s, [0, 0, rate]), still, R_LB)
    @dataclass
    class Void:
        mesh: object
        textures: tuple
    @hookimpl
    def vioframe_flights(): return {"climb": climb, "nothing": lambda duration_s, R_LB: {}}
    @hookimpl
    def vioframe_worlds(): return {"void": lambda p_WB, rng, depth=3: Void(None, (len(p_WB), rng.integers(9), depth))}
    """
    install(tmp_path, monkeypatch, distribution="climbers", module="climbers", code=code)
    loaded = registry.load()
    assert not loaded.failures
    climbing = loaded.create_flight("climb", 4.0, np.eye(3), {"rate": "2"})
    np.testing.assert_allclose(climbing.at(np.array([3.0])).p_WB, [[0.0, 0.0, 6.0]], atol=1e-9)
    check_flight(loaded.find(registry.FLIGHT, "climb").factory)
    world = loaded.create_world("void", np.zeros((5, 3)), np.random.default_rng(0), {"depth": 8})
    assert world.textures[::2] == (5, 8)
    with pytest.raises(PluginError, match=r"'nothing' \(climbers 1.0\) made a dict, which has no duration_s, at"):
        loaded.create_flight("nothing", 4.0, np.eye(3))


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda m: {"v_WB": 1.001 * m.v_WB}, "v_WB is off"),
        (lambda m: {"a_WB": -m.a_WB}, "a_WB is off"),
        (lambda m: {"omega_B": m.omega_B[:, ::-1]}, "omega_B is off"),
        (lambda m: {"R_WB": 1.01 * m.R_WB}, "R_WB is not a rotation"),
        (lambda m: {"p_WB": m.p_WB[:, :2]}, "p_WB has the shape"),
        (lambda m: {"p_WB": np.nan * m.p_WB}, "p_WB is not finite"),
    ],
)
def test_a_flight_that_is_not_one_motion_fails_the_kit(spoil, why):
    class Spoilt(ShapedFlight):
        def at(self, t_s):
            motion = super().at(t_s)
            return replace(motion, **spoil(motion))

    def factory(duration_s, R_LB):
        return Spoilt(duration_s, waves, waves, R_LB)

    with pytest.raises(AssertionError, match=why):
        check_flight(factory)


def waves(t_s):
    return np.sin(np.outer(t_s, [1.0, 1.3, 0.7]))


def test_the_kit_wants_the_mounting_kept():
    with pytest.raises(AssertionError, match="however the body is mounted"):
        check_flight(lambda duration_s, R_LB: ShapedFlight(duration_s, waves, waves, so3.exp(np.zeros(3))))


def test_the_flight_of_the_documentation_works():
    text = (ROOT / "docs" / "flights.md").read_text()
    (code,) = re.findall(r"^```python\n(# my_flights\.py.*?)^```$", text, re.MULTILINE | re.DOTALL)
    names = {}
    exec(code, names)
    check_flight(names["vioframe_flights"]()["lawnmower"])


def test_flights_are_listed_with_their_options():
    shown = CliRunner().invoke(main, ["plugins"]).output
    rows = {tuple(line.split()[:2]) for line in shown.splitlines()}
    assert {("flight", name) for name in FLIGHTS} <= rows
    options = CliRunner().invoke(main, ["plugins", "hover"]).output
    assert "how many times as large" in " ".join(options.split())

"""Every runtime computes what the trained network does, within what its precision allows."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from keypointnet_helpers import ARCHITECTURES, COMPACT, FAR, NARROW, network, texture, weights  # noqa: E402

from vioframe.errors import ConfigError, PluginError  # noqa: E402
from vioframe_keypointnet import runtimes  # noqa: E402
from vioframe_keypointnet.graph import model  # noqa: E402
from vioframe_keypointnet.network import describe as describe_in_torch  # noqa: E402
from vioframe_keypointnet.options import KeypointNetOptions  # noqa: E402
from vioframe_keypointnet.quantisation import measure_ranges  # noqa: E402
from vioframe_keypointnet.selection import by_pixel, candidate_places, describe, response_at  # noqa: E402

ON_CPU = ("openvino", "torch")
each_architecture = pytest.mark.parametrize("architecture", ARCHITECTURES.values(), ids=ARCHITECTURES)


def as_trained(net, image):
    """What the runtimes should give, and what the network itself gives."""
    caught = {}
    place = "R" if net.architecture.peaks else "Pb"
    hooks = [
        net.get_submodule(f"conv{name}").register_forward_hook(lambda _, __, y, name=name: caught.update({name: y[0]}))
        for name in ("Db", place)
    ]
    with torch.inference_mode():
        found = net(torch.from_numpy(image).float()[None, None] / 255.0)
    for hook in hooks:
        hook.remove()
    heads = caught["R"].permute(1, 2, 0) if net.architecture.peaks else torch.cat([caught["Db"], caught["Pb"]])
    return [output.numpy() for output in (heads, found.descriptors[0])], found


def run_by(runtime, precision, made, image):
    """The same by a runtime."""
    return runtimes.start(runtime, precision, made, KeypointNetOptions(descriptors=True, threads=1))(image)


def relative_error(found, expected):
    """Root mean square of the difference, as a share of the expected values' standard deviation."""
    return np.sqrt(np.mean((found - expected) ** 2)) / expected.std()


def test_openvino_tells_nobody_that_it_is_used():
    """By itself it forks to send its maker a word of each import; in a run that can leave a process behind."""
    pytest.importorskip("openvino_telemetry")
    code = (
        "import sys; from vioframe_keypointnet.graph import import_openvino as load; load().Core(); print(*sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "openvino" in found.stdout.split()
    assert not any(name.startswith("openvino_telemetry") for name in found.stdout.split())


@each_architecture
@pytest.mark.parametrize("runtime", ON_CPU)
def test_folding_and_runtime_change_nothing(architecture, runtime):
    """At the border too, where what is padded with matters."""
    pytest.importorskip(runtime)
    net, image = network(architecture), texture()
    outputs, (expected, _) = run_by(runtime, "float32", weights(net), image), as_trained(net, image)
    assert [output.shape for output in outputs] == [output.shape for output in expected]
    assert max(np.abs(o - e).max() for o, e in zip(outputs, expected, strict=True)) < 1e-4


@pytest.mark.parametrize("runtime", ON_CPU)
def test_one_runtime_takes_images_of_several_sizes(runtime):
    pytest.importorskip(runtime)
    net = network(ARCHITECTURES["tiny"])
    run = runtimes.start(runtime, "float32", weights(net), KeypointNetOptions(threads=1))
    for shape in ((48, 64), (64, 48), (8, 8), (48, 64)):
        image = texture(shape, seed=5)
        (heads,) = run(image)
        assert np.abs(heads - as_trained(net, image)[0][0]).max() < 1e-4


@pytest.mark.parametrize("architecture", [COMPACT, FAR, NARROW], ids=lambda a: a.name)
def test_int8_is_near(architecture):
    pytest.importorskip("openvino")
    net = network(architecture)
    made = weights(net)
    made = replace(made, activation_ranges=measure_ranges(made, [texture(seed=number) for number in range(4)]))
    image = texture(seed=9)
    outputs, (expected, _) = run_by("openvino", "int8", made, image), as_trained(net, image)
    errors = [relative_error(o, e) for o, e in zip(outputs, expected, strict=True)]
    assert errors[0] > 1e-3
    assert max(errors) < INT8_ERROR[architecture.name]


INT8_ERROR = {"compact": 0.13, "far": 0.13, "full-x0.125": 0.22}
"""The narrow network has twice as many layers that each add to the error, and half as many channels to average it."""


def test_ranges_leave_out_what_is_rare_and_far():
    """Of a layer's outputs nearly all lie below its range, but not much below."""
    net = network(COMPACT)
    ranges = measure_ranges(weights(net), [texture(seed=number) for number in range(4)])
    outputs = []
    hook = net.conv2b.register_forward_hook(lambda _, __, output: outputs.append(output.numpy().copy()))
    as_trained(net, texture(seed=0))
    hook.remove()
    positive = outputs[0][outputs[0] > 0.0]
    assert np.quantile(positive, 0.99) < ranges["2b"] <= 1.5 * positive.max()
    with pytest.raises(ConfigError, match="there are none"):
        measure_ranges(weights(net), [])


def test_places_are_those_of_the_trained_network():
    (heads, _), found = as_trained(network(NARROW), texture())
    assert np.abs(np.stack(candidate_places(heads)) - found.xy[0].numpy()).max() < 1e-3


@pytest.mark.parametrize("architecture", [COMPACT, FAR], ids=lambda a: a.name)
def test_the_response_of_each_pixel_is_that_of_the_trained_network(architecture):
    (response, _), found = as_trained(network(architecture), texture())
    rows, columns = np.indices(texture().shape)
    at = np.vectorize(lambda row, column: response_at(by_pixel(response), row, column))
    expected = torch.nn.functional.pixel_shuffle(found.response, 8)[0, 0].numpy()
    assert np.array_equal(at(rows, columns), expected)


@pytest.mark.parametrize("descriptors", [False, True])
def test_only_what_is_needed_is_in_the_graph(descriptors):
    pytest.importorskip("openvino")
    graph = model(weights(network(COMPACT)), (48, 64), descriptors=descriptors)
    convolutions = [node for node in graph.get_ops() if node.get_type_name() == "Convolution"]
    assert len(convolutions) == (2 + 1 + 1 + 4 + 1 if descriptors else 2 + 1)
    assert len(graph.outputs) == (2 if descriptors else 1)


def test_descriptors_are_sampled_as_in_training():
    rng = np.random.default_rng(0)
    shape, maps = (96, 64), rng.normal(size=(8, 24, 16)).astype(np.float32)
    xy = (rng.uniform(size=(50, 2)) * [shape[1] - 1, shape[0] - 1]).astype(np.float32)
    xy[:2] = [[0, 0], [shape[1] - 1, shape[0] - 1]]
    expected = describe_in_torch(torch.from_numpy(maps)[None], torch.from_numpy(xy)[None])[0].numpy()
    found = describe(maps, xy)
    assert found.dtype == np.float32
    assert np.abs(found - expected).max() < 1e-5
    assert describe(maps, xy[:0]).shape == (0, 8)


@pytest.fixture
def here(monkeypatch):
    """The runtimes that are installed."""
    names = {"openvino", "torch"}
    monkeypatch.setattr(runtimes, "_is_here", lambda name: name in names)
    return names


def test_auto_takes_the_fastest_that_is_installed(here):
    assert runtimes.choose("auto", "auto", True) == ("openvino", "int8")
    assert runtimes.choose("auto", "auto", False) == ("openvino", "float32")
    assert runtimes.choose("torch", "auto", True) == ("torch", "float32")
    here.remove("openvino")
    assert runtimes.choose("auto", "auto", True) == ("torch", "float32")
    here.clear()
    assert runtimes.choose("auto", "auto", True)[0] == "openvino"  # whose error says what to install


def test_auto_takes_cuda_unless_the_rest_says_otherwise(here):
    here.add("cuda")
    assert runtimes.choose("auto", "auto", True) == ("cuda", "float16")
    assert runtimes.choose("auto", "float32", True) == ("cuda", "float32")
    assert runtimes.choose("auto", "int8", True) == ("openvino", "int8")
    assert runtimes.choose("openvino", "auto", True) == ("openvino", "int8")


@pytest.mark.parametrize(
    ("wanted", "complaint"),
    [
        (("cuda", "int8"), "the runtime cuda has the precision float16 or float32, not int8"),
        (("torch", "int8"), "the runtime torch has the precision float32, not int8"),
        (("openvino", "float16"), "the runtime openvino has the precision int8 or float32, not float16"),
    ],
)
def test_what_does_not_go_together_is_said(wanted, complaint):
    with pytest.raises(ConfigError, match=complaint):
        runtimes.choose(*wanted, True)


def test_int8_needs_ranges():
    with pytest.raises(ConfigError, match="--calibrate"):
        runtimes.choose("auto", "int8", False)


@pytest.mark.parametrize("runtime", ON_CPU)
def test_a_library_that_is_absent_is_named_with_its_extra(runtime, monkeypatch):
    made = weights(network(COMPACT))
    monkeypatch.setitem(sys.modules, runtime, None)
    extra = "keypointnet" if runtime == "torch" else runtime
    with pytest.raises(PluginError, match=rf"{runtime}.*pip install 'vioframe\[{extra}\]'"):
        runtimes.start(runtime, "float32", made, KeypointNetOptions(threads=1))

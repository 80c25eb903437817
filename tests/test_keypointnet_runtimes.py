"""Every runtime computes what the trained network does, within what its precision allows."""

import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from keypointnet_helpers import ARCHITECTURES, COMPACT, NARROW, QUICK, network, texture, weights  # noqa: E402

from vioframe.errors import ConfigError  # noqa: E402
from vioframe_keypointnet import runtimes  # noqa: E402
from vioframe_keypointnet.description import describe  # noqa: E402
from vioframe_keypointnet.folding import fold  # noqa: E402
from vioframe_keypointnet.network import describe as describe_in_torch  # noqa: E402
from vioframe_keypointnet.quantisation import measure_ranges  # noqa: E402
from vioframe_keypointnet.selection import candidate_places  # noqa: E402

NOT_TORCH = [runtime for runtime in runtimes.ON_CPU if runtime != "torch"]
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
        images = torch.from_numpy(image).float()[None, None] / 255.0
        found = net(images.expand(-1, net.architecture.image_channels, -1, -1))
    for hook in hooks:
        hook.remove()
    heads = caught["R"].permute(1, 2, 0) if net.architecture.peaks else torch.cat([caught["Db"], caught["Pb"]])
    return [output.numpy() for output in (heads, found.descriptors[0])], found


def run_by(runtime, precision, net, image, ranges=None):
    """The same by a runtime."""
    return runtimes.on_cpu(runtime, precision, fold(weights(net), descriptors=True), ranges, 1)(image)


def relative_error(found, expected):
    """Root mean square of the difference, as a share of the expected values' standard deviation."""
    return np.sqrt(np.mean((found - expected) ** 2)) / expected.std()


@each_architecture
@pytest.mark.parametrize("runtime", runtimes.ON_CPU)
def test_folding_and_runtime_change_nothing(architecture, runtime):
    """At the border too, where what is padded with matters."""
    pytest.importorskip(runtime)
    net, image = network(architecture), texture()
    outputs, (expected, _) = run_by(runtime, "float32", net, image), as_trained(net, image)
    assert [output.shape for output in outputs] == [output.shape for output in expected]
    assert max(np.abs(o - e).max() for o, e in zip(outputs, expected, strict=True)) < 1e-4


@pytest.mark.parametrize("runtime", runtimes.ON_CPU)
def test_one_runtime_takes_images_of_several_sizes(runtime):
    pytest.importorskip(runtime)
    net = network(ARCHITECTURES["tiny"])
    run = runtimes.on_cpu(runtime, "float32", fold(weights(net)), None, 1)
    for shape in ((48, 64), (64, 48), (8, 8), (48, 64)):
        image = texture(shape, seed=5)
        (heads,) = run(image)
        assert np.abs(heads - as_trained(net, image)[0][0]).max() < 1e-4


@pytest.mark.parametrize("architecture", [COMPACT, QUICK, NARROW], ids=lambda a: a.name)
@pytest.mark.parametrize("runtime", NOT_TORCH)
def test_int8_is_near(architecture, runtime):
    pytest.importorskip(runtime)
    net = network(architecture)
    ranges = measure_ranges(weights(net), [texture(seed=number) for number in range(4)])
    image = texture(seed=9)
    outputs, (expected, _) = run_by(runtime, "int8", net, image, ranges), as_trained(net, image)
    errors = [relative_error(o, e) for o, e in zip(outputs, expected, strict=True)]
    assert errors[0] > 1e-3
    assert max(errors) < INT8_ERROR[architecture.name]


INT8_ERROR = {"compact": 0.13, "quick": 0.13, "full-x0.125": 0.2}
"""The narrow network has twice as many layers that each add to the error, and half as many channels to average it."""


def test_bfloat16_is_near():
    pytest.importorskip("openvino")
    net, image = network(COMPACT), texture(seed=9)
    outputs, (expected, _) = run_by("openvino", "bfloat16", net, image), as_trained(net, image)
    assert max(relative_error(o, e) for o, e in zip(outputs, expected, strict=True)) < 0.06


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


@pytest.mark.parametrize("architecture", [COMPACT, QUICK], ids=lambda a: a.name)
def test_the_response_of_each_pixel_is_that_of_the_trained_network(architecture):
    (response, _), found = as_trained(network(architecture), texture())
    rows, columns, f = *response.shape[:2], architecture.fold
    by_pixels = response.reshape(rows, columns, f, f).swapaxes(1, 2).reshape(f * rows, f * columns)
    assert np.array_equal(by_pixels, torch.nn.functional.pixel_shuffle(found.response, 8)[0, 0].numpy())


@pytest.mark.parametrize("descriptors", [False, True])
def test_only_what_is_needed_is_run(descriptors):
    made = weights(network(COMPACT))
    names = [layer.name for layer in fold(made, descriptors).encoder]
    assert names == (["2a", "2b", "2c", "3a", "4a"] if descriptors else ["2a", "2b", "2c"])


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


def test_auto_takes_the_fastest_that_is_installed(monkeypatch):
    monkeypatch.setattr(runtimes, "_has_cuda", lambda: False)
    installed = {"openvino", "onnxruntime", "onnx", "torch"}
    monkeypatch.setattr(runtimes, "find_spec", lambda name: name if name in installed else None)
    assert runtimes.choose("auto", "auto", "auto", True) == ("openvino", "int8", "cpu")
    assert runtimes.choose("auto", "auto", "auto", False) == ("openvino", "float32", "cpu")
    installed.remove("openvino")
    assert runtimes.choose("auto", "auto", "auto", False)[0] == "onnxruntime"
    installed.remove("onnx")
    assert runtimes.choose("auto", "auto", "cpu", True) == ("torch", "float32", "cpu")
    installed.clear()
    assert runtimes.choose("auto", "auto", "cpu", True)[0] == "openvino"  # whose error says what to install


def test_auto_takes_cuda_unless_the_rest_says_otherwise(monkeypatch):
    monkeypatch.setattr(runtimes, "_has_cuda", lambda: True)
    assert runtimes.choose("auto", "auto", "auto", True) == ("torch", "float16", "cuda")
    assert runtimes.choose("torch", "float32", "auto", True) == ("torch", "float32", "cuda")
    assert runtimes.choose("auto", "int8", "auto", True) == ("openvino", "int8", "cpu")
    assert runtimes.choose("onnxruntime", "auto", "auto", True)[::2] == ("onnxruntime", "cpu")
    assert runtimes.choose("auto", "auto", "cpu", True)[2] == "cpu"


@pytest.mark.parametrize(
    ("wanted", "complaint"),
    [
        (("openvino", "auto", "cuda"), "on CUDA the runtime is torch, not openvino"),
        (("auto", "int8", "cuda"), "on CUDA the precision is float16 or float32, not int8"),
        (("torch", "int8", "cpu"), "on a CPU torch has the precision float32, not int8"),
        (("onnxruntime", "bfloat16", "auto"), "onnxruntime has the precision float32 or int8, not bfloat16"),
        (("auto", "float16", "cpu"), "no runtime has the precision float16"),
    ],
)
def test_what_does_not_go_together_is_said(wanted, complaint):
    with pytest.raises(ConfigError, match=complaint):
        runtimes.choose(*wanted, True)


def test_int8_needs_ranges():
    with pytest.raises(ConfigError, match="--calibrate"):
        runtimes.choose("auto", "int8", "cpu", False)


@pytest.mark.parametrize("runtime", runtimes.ON_CPU)
def test_a_library_that_is_absent_is_named_with_its_extra(runtime, monkeypatch):
    folded = fold(weights(network(COMPACT)))
    monkeypatch.setitem(sys.modules, runtime, None)
    monkeypatch.delitem(sys.modules, "vioframe_keypointnet.runtimes.torch", raising=False)
    extra = "keypointnet" if runtime == "torch" else runtime
    with pytest.raises(ConfigError, match=rf"{runtime}.*pip install 'vioframe\[{extra}\]'"):
        runtimes.on_cpu(runtime, "float32", folded, None, 1)(texture())

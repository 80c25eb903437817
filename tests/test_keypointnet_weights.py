"""Weights files: what is written is read; what is missing, damaged, foreign or malicious is refused in one line."""

import json
import logging
import os
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from click.testing import CliRunner

torch = pytest.importorskip("torch")
safetensors = pytest.importorskip("safetensors.numpy")

import cv2  # noqa: E402
from keypointnet_helpers import ARCHITECTURES, TINY, network, texture, weights  # noqa: E402

from vioframe.errors import ConfigError  # noqa: E402
from vioframe_keypointnet import weights as weights_file  # noqa: E402
from vioframe_keypointnet.__main__ import convert  # noqa: E402
from vioframe_keypointnet.architecture import COMPACT, FULL  # noqa: E402
from vioframe_keypointnet.network import KeypointNet  # noqa: E402
from vioframe_keypointnet.weights import Weights  # noqa: E402

REMEDY = "vioframe train keypointnet --images DIR"


@pytest.fixture
def saved(tmp_path):
    """(file, weights) of a tiny network."""
    made = weights(network(TINY))
    path = tmp_path / "tiny.safetensors"
    weights_file.save(path, replace(made, card={"epochs": 3}, activation_ranges={"2a": 1.5}))
    return path, made


@pytest.fixture
def official(tmp_path, monkeypatch):
    """Writes a checkpoint as the authors do, where yacs is installed, and takes yacs away again."""

    def write(state, *, legacy=False):
        # As yacs keeps its nodes: a dictionary with attributes of its own.
        node = type("CfgNode", (dict,), {"__module__": "yacs.config"})
        config = node(model=node(params=node(lr=1e-3)), arch=[1, "a"])
        config.__immutable__ = False
        module = ModuleType("yacs.config")
        module.CfgNode = node
        path = tmp_path / "v4.ckpt"
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, "yacs", ModuleType("yacs"))
            patch.setitem(sys.modules, "yacs.config", module)
            torch.save({"state_dict": state, "config": config}, path, _use_new_zipfile_serialization=not legacy)
        return path

    return write


def test_in_eight_bits_convolutions_are_off_by_half_a_step_at_most(saved):
    path, made = saved
    rounded = path.with_name("rounded.safetensors")
    result = CliRunner().invoke(convert, [str(path), str(rounded), "--eight-bits"])
    assert result.exit_code == 0, result.output
    found = weights_file.load(rounded)
    assert found.card == {"epochs": 3}
    for name, values in made.tensors.items():
        step = np.abs(values).max(axis=(1, 2, 3), keepdims=True) / 127.0 if values.ndim == 4 else 0.0
        assert (np.abs(found.tensors[name] - values) <= 0.501 * step).all()
    kernels = sum(values.size for values in made.tensors.values() if values.ndim == 4)
    assert path.stat().st_size - rounded.stat().st_size > 2.5 * kernels


def test_steps_of_a_tensor_that_is_not_there_are_refused(saved):
    path, _ = saved
    safetensors.save_file({"conv2a.0.weight.steps": np.ones(4, np.float32)}, path)
    with pytest.raises(ConfigError, match="damaged"):
        weights_file.load(path)


@pytest.mark.parametrize("architecture", [*ARCHITECTURES.values(), FULL], ids=lambda a: a.name)
def test_the_table_of_shapes_is_that_of_the_network(architecture):
    state = KeypointNet(architecture).state_dict()
    expected = {name: tuple(t.shape) for name, t in state.items() if not name.endswith("num_batches_tracked")}
    assert architecture.shapes == expected


def test_what_is_saved_is_loaded(saved):
    path, made = saved
    found = weights_file.load(path)
    assert (found.architecture, found.card, found.activation_ranges) == (TINY, {"epochs": 3}, {"2a": 1.5})
    assert found.tensors.keys() == made.tensors.keys()
    assert all(np.array_equal(found.tensors[name], made.tensors[name]) for name in made.tensors)


def test_half_precision_and_counters_of_batches_are_no_obstacle(tmp_path):
    state = {name: t.half() if t.dtype.is_floating_point else t for name, t in network(TINY).state_dict().items()}
    weights_file.save(tmp_path / "half.safetensors", Weights(TINY, {n: t.numpy() for n, t in state.items()}))
    found = weights_file.load(tmp_path / "half.safetensors")
    assert {t.dtype for t in found.tensors.values()} == {np.dtype(np.float32)}
    assert found.activation_ranges is None


@pytest.mark.parametrize("name", ["absent.safetensors", "compcat"])
def test_a_missing_file_or_name_tells_how_to_get_weights(name):
    with pytest.raises(ConfigError, match=f"no KeypointNet weights '{name}'.*{REMEDY}"):
        weights_file.load(name)


@pytest.mark.parametrize("kept", [0, 5, 100, 2000])
def test_a_truncated_file_is_refused(saved, kept):
    path, _ = saved
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ConfigError, match=f"damaged.*{REMEDY}"):
        weights_file.load(path)


def test_a_file_without_a_word_on_its_network_is_refused(saved):
    path, made = saved
    for metadata in (None, {"architecture": "{}"}, {"architecture": "[1"}, {"architecture": json.dumps({"name": 3})}):
        safetensors.save_file(dict(made.tensors), path, metadata)
        with pytest.raises(ConfigError, match="does not say which KeypointNet"):
            weights_file.load(path)


def test_tensors_of_another_network_are_refused(saved):
    path, made = saved
    metadata = {"architecture": COMPACT.to_json()}
    safetensors.save_file(dict(made.tensors), path, metadata)
    with pytest.raises(ConfigError, match=r"not the weights of a compact KeypointNet: .* more such"):
        weights_file.load(path)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda t: t.pop("convDb.bias"), r"convDb.bias has the shape nothing and not \(1,\)"),
        (lambda t: t.update(extra=np.zeros(3, np.float32)), r"extra has the shape \(3,\) and not nothing"),
        (
            lambda t: t.update({"convDb.bias": np.zeros(2, np.float32)}),
            r"convDb.bias has the shape \(2,\) and not \(1,\)",
        ),
        (lambda t: t.update({"convDb.bias": np.full(1, np.nan, np.float32)}), "convDb.bias holds numbers that are not"),
    ],
    ids=["missing", "foreign", "shape", "nan"],
)
def test_tensors_that_do_not_fit_are_neither_saved_nor_loaded(saved, change, complaint):
    path, made = saved
    tensors = dict(made.tensors)
    change(tensors)
    with pytest.raises(ConfigError, match=complaint):
        weights_file.save(path, Weights(TINY, tensors))
    safetensors.save_file(tensors, path, {"architecture": TINY.to_json()})
    with pytest.raises(ConfigError, match=complaint):
        weights_file.load(path)


def test_random_weights_come_by_explicit_wish_only_and_with_a_warning(caplog):
    with caplog.at_level(logging.WARNING):
        first, second = (weights_file.load("untrained:compact") for _ in range(2))
    assert "random weights" in caplog.text
    assert all(np.array_equal(first.tensors[name], second.tensors[name]) for name in COMPACT.shapes)
    assert set(first.activation_ranges) == set(COMPACT.ranged)
    with pytest.raises(ConfigError, match=r"no network 'big'.*compact, far, full"):
        weights_file.load("untrained:big")


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
def test_an_official_checkpoint_loads_without_yacs(official, legacy):
    state = KeypointNet(FULL).state_dict()
    assert len(state) == 84  # as many as published
    found = weights_file.load(official(state, legacy=legacy))
    assert found.architecture == FULL
    assert all(np.array_equal(found.tensors[name], state[name].numpy()) for name in FULL.shapes)


def test_a_checkpoint_of_another_network_is_refused(official):
    with pytest.raises(ConfigError, match="not the weights of a full KeypointNet"):
        weights_file.load(official(network(TINY).state_dict()))


class Malice:
    """Would leave a file behind when unpickled."""

    def __init__(self, path):
        self._command = f"touch {path}"

    def __reduce__(self):
        return os.system, (self._command,)


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
def test_a_malicious_checkpoint_is_named_and_not_run(tmp_path, legacy):
    path, trace = tmp_path / "evil.ckpt", tmp_path / "trace"
    torch.save({"state_dict": Malice(trace)}, path, _use_new_zipfile_serialization=not legacy)
    with pytest.raises(ConfigError, match=r"wants (posix|nt)\.system loaded"):
        weights_file.load(path)
    assert not trace.exists()


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04 and no more", b"\x80\x02}q\x00."], ids=repr)
def test_a_damaged_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "broken.ckpt"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"broken\.ckpt is (damaged or )?no checkpoint"):
        weights_file.load(path)


def test_a_checkpoint_without_a_network_is_refused(tmp_path):
    torch.save({"state_dict": [1, 2]}, tmp_path / "list.ckpt")
    with pytest.raises(ConfigError, match="no tensors under 'state_dict'"):
        weights_file.load(tmp_path / "list.ckpt")


def test_the_converter_measures_ranges_where_images_are_given(saved, tmp_path):
    path, made = saved
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), texture(seed=number))
    done = CliRunner().invoke(convert, [str(path), str(tmp_path / "o.safetensors"), "--calibrate", str(tmp_path)])
    assert done.exit_code == 0, done.output
    found = weights_file.load(tmp_path / "o.safetensors")
    assert found.card == {"epochs": 3}
    assert set(found.activation_ranges) == set(TINY.ranged)
    assert all(np.array_equal(found.tensors[name], made.tensors[name]) for name in made.tensors)


def test_the_converter_complains_in_one_line(tmp_path):
    (tmp_path / "a.ckpt").write_bytes(b"garbage")
    done = CliRunner().invoke(convert, [str(tmp_path / "a.ckpt"), str(tmp_path / "o.safetensors")])
    assert done.exit_code == 1
    assert done.output.startswith("Error: ")
    assert done.output.count("\n") == 1

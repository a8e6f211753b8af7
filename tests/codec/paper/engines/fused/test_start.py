"""The fused engine where there is CUDA, and slab where it cannot be had, with one warning."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused import driver
from fhash_codec.paper.engines.fused.engine import FusedEngine
from fhash_codec.paper.engines.fused.points import FusedPoints
from fhash_codec.paper.engines.fused.source import Unavailable
from fhash_codec.paper.engines.fused.start import start_fused, start_points
from fhash_formats.errors import FhashWarning, InputError


class Cuda:
    """A device that claims to be CUDA; tensors are made on the CPU."""

    type = "cuda"


@pytest.fixture
def start(noise_coreset, monkeypatch):
    """A function of a device and of whether the engine is required: what was started."""
    coreset = noise_coreset((2, 5, 9, 13))
    architecture = Architecture.for_box(coreset.box.shape, 2, width=8)

    def make(device, required=False):
        return start_fused(
            architecture, coreset, np.full(9, 0.01), seed=0, device=device, required=required
        )

    return make


def test_a_processor_has_no_fused_engine(start) -> None:
    assert start(torch.device("cpu")) is None
    with pytest.raises(InputError, match="needs a CUDA device, but the device is 'cpu'"):
        start(torch.device("cpu"), required=True)


def test_a_torch_without_cuda_goes_on_without_a_warning(start, monkeypatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    assert start(Cuda()) is None


def test_a_failure_is_one_warning_or_an_error_if_the_engine_is_required(start, monkeypatch) -> None:
    def fail(device):
        raise Unavailable("a reason of this test")

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(driver, "CudaDevice", fail)
    with pytest.warns(FhashWarning, match="slab, since .* had: a reason of this test"):
        assert start(Cuda()) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert start(Cuda()) is None
    with pytest.raises(InputError, match="'fused' cannot be had: a reason of this test"):
        start(Cuda(), required=True)


def test_the_engine_is_started_on_the_device(start, monkeypatch, emulated) -> None:
    """An emulated device stands in for CUDA, and torch's device is the CPU all the same."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(driver, "CudaDevice", lambda device: emulated())

    original = FusedEngine.__init__

    def on_cpu(self, *arguments, device, **settings):
        original(self, *arguments, device=torch.device("cpu"), **settings)

    monkeypatch.setattr(FusedEngine, "__init__", on_cpu)
    engine = start(Cuda(), required=True)
    assert isinstance(engine, FusedEngine)
    assert float(engine.train(np.array([0]))) > 0


def test_points_are_left_to_torch_without_cuda(networks, monkeypatch) -> None:
    network = networks.random((5, 6, 7), 2, 2, 2, 1)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert start_points(network, 0.5, torch.device("cpu")) is None
    monkeypatch.setattr(torch.version, "cuda", None)
    assert start_points(network, 0.5, Cuda()) is None


def test_points_that_the_kernels_cannot_do_are_left_to_torch_with_one_warning(
    networks, monkeypatch, emulated
) -> None:
    network, device = networks.random((5, 6, 7), 2, 2, 2, 3), Cuda()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(driver, "CudaDevice", lambda device: emulated())
    with pytest.warns(
        FhashWarning, match="evaluated on the CPU, since .*: the network has 3 hidden"
    ):
        assert start_points(network, 0.5, device) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert start_points(network, 0.5, device) is None


def test_points_are_started_on_a_device_that_is_looked_at_once(
    networks, monkeypatch, emulated
) -> None:
    looked, device = [], Cuda()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(driver, "CudaDevice", lambda device: looked.append(device) or emulated())
    original = FusedPoints.__init__

    def on_cpu(self, *arguments, device, **settings):
        original(self, *arguments, device=torch.device("cpu"), **settings)

    monkeypatch.setattr(FusedPoints, "__init__", on_cpu)
    for key in (0.0, 0.5):
        points = start_points(networks.random((5, 6, 7), 2, 2, 2, 1), key, device)
        assert isinstance(points, FusedPoints)
        assert points.values(torch.ones(3, 3, dtype=torch.float64)).isfinite().all()
    assert looked == [device]

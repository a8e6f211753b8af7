"""Devices: numpy on the processor, and torch only where CUDA's driver is."""

from __future__ import annotations

import pytest

from fhash_codec.rendering.task import devices
from fhash_codec.rendering.task.arrays import NUMPY
from fhash_formats.errors import InputError


def test_the_processor_marches_with_numpy() -> None:
    assert devices.arrays_on("cpu") is NUMPY


def test_auto_without_a_driver_is_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "DRIVER", "no-such-library")
    assert devices.arrays_on("auto") is NUMPY


def test_unknown_devices_are_refused_with_those_that_are_known() -> None:
    with pytest.raises(InputError, match="device is 'gpu'; allowed: auto, cpu, cuda"):
        devices.arrays_on("gpu")

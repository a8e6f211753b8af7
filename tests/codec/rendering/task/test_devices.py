"""The arrays of a device."""

from __future__ import annotations

import subprocess
import sys

import pytest

from fhash_codec.rendering.task.arrays import NUMPY
from fhash_codec.rendering.task.devices import arrays_on
from fhash_formats.errors import InputError


def test_a_device_is_named_and_never_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert arrays_on("cpu") is arrays_on("auto") is NUMPY
    with pytest.raises(InputError, match="no CUDA device"):
        arrays_on("cuda")
    with pytest.raises(InputError, match="'gpu'; allowed: auto, cpu, cuda"):
        arrays_on("gpu")


def test_marching_on_the_processor_loads_no_torch() -> None:
    code = (
        "import sys; from fhash_codec.rendering.task import devices; "
        "import fhash_codec.rendering.stream.stream; devices._driver_exists = lambda: False; "
        "devices.arrays_on('auto'); devices.arrays_on('cpu'); print('torch' in sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )

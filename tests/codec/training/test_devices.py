"""torch, which may be missing, and the choice of a device."""

from __future__ import annotations

import sys

import pytest
import torch

from fhash_codec.training.devices import choose_device, has_torch, need_torch
from fhash_formats.errors import InputError, MissingDependencyError


def test_a_device_that_is_not_there_is_refused(monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no CUDA device"):
        choose_device("cuda")
    assert choose_device("cpu") == choose_device("auto") == torch.device("cpu")


def test_auto_is_a_cuda_device_where_there_is_one(monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert choose_device("auto") == choose_device("cuda") == torch.device("cuda")
    assert choose_device("cpu") == torch.device("cpu")


def test_torch_is_found_where_it_is_installed() -> None:
    assert has_torch()
    need_torch("a test")


def test_without_torch_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    assert not has_torch()
    with pytest.raises(MissingDependencyError, match=r"a test needs torch: .*fhash\[train"):
        need_torch("a test")
    for name in ("auto", "cpu", "cuda"):
        with pytest.raises(MissingDependencyError, match=f"device '{name}' needs torch"):
            choose_device(name)

"""torch, which may be missing, and the choice of a device."""

from __future__ import annotations

import sys
from contextlib import suppress

import pytest
import torch
from forked import ended_well, forked, needs_fork
from pretended_cuda import pretended_cuda

from fhash_codec.devices import (
    CUDA_PAYS,
    VERTICES_A_THREAD,
    choose_device,
    enough_memory,
    has_torch,
    leave_threads_of_parent,
    need_torch,
    same_bits,
    threads_for,
    training_device,
)
from fhash_formats.errors import FhashWarning, InputError, MissingDependencyError


def test_a_device_that_is_not_there_is_refused(monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no CUDA device"):
        choose_device("cuda")
    assert choose_device("cpu") == choose_device("auto") == torch.device("cpu")


def test_without_torch_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    assert not has_torch()
    with pytest.raises(MissingDependencyError, match=r"a test needs torch: .*fhash\[train"):
        need_torch("a test")
    for name in ("auto", "cpu", "cuda"):
        with pytest.raises(MissingDependencyError, match=f"device '{name}' needs torch"):
            choose_device(name)


def test_a_training_takes_the_device_where_that_pays_and_fits() -> None:
    with pretended_cuda() as pretended:
        pretended.free = 2**30
        assert training_device("cpu", CUDA_PAYS, 0).type == "cpu"
        assert training_device("auto", CUDA_PAYS - 1, 0).type == "cpu"
        assert training_device("auto", CUDA_PAYS, 2**30).type == "cuda"
        assert training_device("cuda", 1, 2**30).type == "cuda"
        with pytest.raises(InputError, match=r"3\.0 GiB .* 1\.0 GiB are free; use --device cpu"):
            training_device("cuda", 1, 3 * 2**30)
        with pytest.warns(FhashWarning, match="takes the CPU"):
            assert training_device("auto", CUDA_PAYS, 3 * 2**30).type == "cpu"


def test_memory_that_runs_out_is_one_line_with_advice() -> None:
    with (
        pytest.raises(InputError, match=r"ran out .*\(out\); use --device cpu") as told,
        enough_memory(torch.device("cuda")),
    ):
        raise torch.OutOfMemoryError("out\nof 5 GiB ...")
    assert "\n" not in str(told.value)
    with pytest.raises(RuntimeError, match="CUDA error"), enough_memory(torch.device("cuda")):
        raise RuntimeError("CUDA error: an illegal memory access was encountered")


@pytest.mark.parametrize("before", [False, True])
def test_the_same_bits_are_asked_of_torch_on_a_device_alone(before: bool) -> None:
    usual = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(before)
    try:
        for device, wanted, asked in (
            ("cuda", True, True),
            ("cuda", False, before),
            ("cpu", True, before),
        ):
            with same_bits(torch.device(device), wanted):
                assert torch.are_deterministic_algorithms_enabled() is asked
            assert torch.are_deterministic_algorithms_enabled() is before
    finally:
        torch.use_deterministic_algorithms(usual)


@pytest.mark.parametrize(("vertices", "threads"), [(0, 1), (VERTICES_A_THREAD * 2, 2), (10**9, 3)])
def test_threads_are_those_that_pay_and_come_back_after_an_error(vertices, threads) -> None:
    usual = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with suppress(ZeroDivisionError), threads_for(vertices) as used:
            assert used == torch.get_num_threads() == threads
            raise ZeroDivisionError
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(usual)


@needs_fork
def test_a_forked_process_does_not_wait_for_the_threads_of_its_parent() -> None:
    def computes() -> bool:
        leave_threads_of_parent()
        return bool((torch.arange(3_000_000.0) % 7).max() == 6)

    usual = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        leave_threads_of_parent()
        assert torch.get_num_threads() == 3
        (torch.arange(3_000_000.0) % 7).sum()  # begins the threads
        assert ended_well(forked(computes))
    finally:
        torch.set_num_threads(usual)

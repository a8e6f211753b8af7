"""Training of a head by CUDA's kernels, emulated on the processor: the bits of the native code."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from emulated_cuda import EmulatedDevice, EmulatedKernels, EmulatedMemory
from rarely import rarely

from fhash_codec.compact import head_device
from fhash_codec.compact.head_device import EACH_ROUNDED, KERNELS, device_learner, learner_on
from fhash_codec.compact.head_training import (
    BLOCK_VOXELS,
    ERROR_UNIT,
    MAX_TARGET,
    Batches,
    Budget,
    Network,
    Pair,
    adam_factors,
    train_head,
)
from fhash_codec.cuda.nvrtc import Unavailable, find_nvrtc
from fhash_formats.errors import InputError
from fhash_formats.transform.head import INPUTS


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the compiled kernels."""
    return tmp_path_factory.mktemp("kernels")


def voxels(batches: int = 2, blocks: int = 3, *, largest: bool = False) -> Batches:
    """Batches of random voxels, some outputs beyond the clip range.

    largest: every number at its limit, so that sums and the gradient are largest.
    """
    random = np.random.default_rng(0)
    inputs = (batches, blocks, INPUTS, BLOCK_VOXELS)
    size = (batches, blocks * BLOCK_VOXELS)
    sign = np.where(random.random(size) < 0.9, 1, -1)
    targets = sign * MAX_TARGET if largest else np.rint(random.normal(size=size) * ERROR_UNIT)
    ends = MAX_TARGET if largest else np.rint(random.random(size) * 0.2 * ERROR_UNIT)
    numbers = np.full(inputs, 32767) if largest else random.integers(-1500, 1501, inputs)
    return Batches(
        inputs=numbers.astype(np.int16),
        targets=targets.astype(np.int32),
        lowest=np.full(size, -ends, np.int32),
        highest=np.full(size, ends, np.int32),
        weights=np.ones(size, np.float32) if largest else random.random(size, np.float32),
    )


def learned(
    device: EmulatedDevice | None, data: Batches, widths: tuple[int, int], *, rounded: bool
) -> list[bytes]:
    """The state of a network after some updates; those of the native code without a device."""
    network = Network(widths, np.random.default_rng(1))
    for first in (1, 4):
        factors = (each[first - 1 :] for each in adam_factors(np.full(first + 2, 0.02)))
        if device is None:
            network.learn(data, first, *factors, rounded=rounded)
        else:
            device_learner(device, data)(network, first, *factors, rounded)
    return [each.tobytes() for each in (network.parameters, network.means, network.squares)]


@pytest.mark.parametrize("order", [0, *rarely(1, 2)])
@pytest.mark.parametrize("rounded", [False, True])
@pytest.mark.parametrize("largest", [False, True])
@pytest.mark.parametrize("widths", [(5, 3), (1, 1), (24, 16), (13, 33), (64, 64)])
def test_a_device_trains_the_same_bits(
    folder: Path, widths: tuple[int, int], largest: bool, rounded: bool, order: int
) -> None:
    data = voxels(largest=largest)
    device = EmulatedDevice(folder, order)
    expected = learned(None, data, widths, rounded=rounded)
    assert learned(device, data, widths, rounded=rounded) == expected


def test_a_head_that_is_trained_on_a_device_is_that_of_the_cpu(folder: Path) -> None:
    random = np.random.default_rng(0)
    original = np.where(random.random((2, 8, 10, 30)) < 0.5, 1, 0).astype(np.float32)
    decoded = original + random.normal(scale=0.3, size=original.shape).astype(np.float32)
    budget = Budget(updates=5, samples=4096)
    on_device = replace(
        budget, learner=lambda batches: device_learner(EmulatedDevice(folder), batches)
    )
    heads = [
        train_head([Pair(decoded, original, None)], -0.5, 1.5, (12, 8), each).head.to_bytes()
        for each in (budget, on_device)
    ]
    assert heads[0] == heads[1]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("squared_norm > SURELY_SHORT", "false"),
        ("clipped == out", "true"),
        ("exponent - 11", "exponent - 12"),
        ("        next[i] = 0;", ""),
    ],
)
def test_another_arithmetic_gives_other_bits(folder: Path, old: str, new: str) -> None:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    device = EmulatedDevice(folder, change=change)
    same = [
        learned(device, voxels(largest=largest), (24, 16), rounded=True)
        == learned(None, voxels(largest=largest), (24, 16), rounded=True)
        for largest in (False, True)
    ]
    assert not all(same)


def test_updates_are_two_launches_each_and_one_wait(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    device = EmulatedDevice(folder)
    kernels = device.load(KERNELS.read_text(), options=EACH_ROUNDED)
    monkeypatch.setattr(device, "load", lambda *_, **__: kernels)
    receive = EmulatedMemory.receive
    monkeypatch.setattr(
        EmulatedMemory, "receive", lambda *given: calls.append(1) or receive(*given)
    )
    learn = device_learner(device, voxels())
    learn(Network((5, 3), np.random.default_rng(0)), 1, *adam_factors(np.full(7, 0.01)), False)
    assert kernels.launched == ["head_slopes", "head_step"] * 7
    assert len(calls) == 1


def failing(reason: str) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise Unavailable(reason)

    return fail


def test_without_a_device_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(head_device, "first_device", failing("it has none"))
    with pytest.raises(InputError) as raised:
        learner_on("cuda")
    assert str(raised.value) == "device is 'cuda', but it has none; use --device cpu"


@pytest.mark.parametrize("part", ["load", "launch"])
def test_kernels_that_cannot_run_are_refused_in_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    device = EmulatedDevice(folder)
    owner = {"load": EmulatedDevice, "launch": EmulatedKernels}[part]
    monkeypatch.setattr(owner, part, failing("no reason\nfor programmers"))
    with pytest.raises(InputError, match=r"^device is 'cuda', but no reason; use --device cpu$"):
        learned(device, voxels(), (5, 3), rounded=False)


MAX_REGISTERS = 64
"""Registers of a thread with which a multiprocessor holds four blocks of 256 threads."""


@pytest.mark.parametrize("architecture", [90, *rarely(80, 100)])
def test_kernels_need_few_registers_and_no_local_memory(architecture: int) -> None:
    try:
        nvrtc = find_nvrtc()
    except Unavailable as error:
        pytest.skip(str(error))
    text = KERNELS.read_text(encoding="utf-8")
    cubin, log = nvrtc.compile(text, architecture, options=EACH_ROUNDED)
    assert cubin.startswith(b"\x7fELF")
    assert set(re.findall(r"Compiling entry function '(\w+)'", log)) == {"head_slopes", "head_step"}
    assert max(map(int, re.findall(r"Used (\d+) registers", log))) <= MAX_REGISTERS
    used = re.findall(r"(\d+) bytes (stack frame|spill \w+|lmem|cumulative stack)", log)
    assert not [number for number, _ in used if int(number)], log

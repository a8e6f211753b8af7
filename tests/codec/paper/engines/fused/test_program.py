"""The tables of the kernels say what the matrices and Adam's catching up say."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from fhash_codec.cuda.nvrtc import Nvrtc, Unavailable, find_nvrtc
from fhash_codec.paper.engines.fused import engine as points
from fhash_codec.paper.engines.fused.engine import point_sizes
from fhash_codec.paper.engines.fused.program import (
    FILES,
    KERNELS,
    DeviceLimits,
    axis_tables,
    kernel_sizes,
    missed_step_tables,
)
from fhash_codec.paper.engines.parameters import (
    EPSILON,
    WINDOW,
    axis_matrices,
    catch_up,
    weights_at,
)
from fhash_codec.paper.network import Architecture


@pytest.mark.parametrize(
    ("shape", "keys"),
    [
        ((3, 9, 20, 35), ()),
        ((1, 1, 33, 2), ()),
        ((2, 5, 1, 1), ()),
        ((5, 16, 8, 64), ()),
        ((7, 9, 20, 35), (0, 1, 4, 6)),
    ],
)
def test_corners_and_weights_are_those_of_the_matrices(noise_coreset, shape, keys) -> None:
    coreset = noise_coreset(shape, keys=keys, fringe=bool(keys))
    architecture = Architecture.for_box(coreset.box.shape, len(coreset.key_frames))
    lengths, counts = (1, *coreset.brick_shape), (shape[0], *coreset.brick_grid)
    axes = axis_tables(architecture, coreset)
    for number, (axis, length, count) in enumerate(zip(axes, lengths, counts, strict=True)):
        for level, resolution in enumerate(architecture.levels[not keys :]):
            size, corners = architecture.sizes[number], resolution[number]
            start, expected = axis_matrices(size, corners, length, count)
            if number == 0:
                places = coreset.key_places[:, None] * (corners - 1) / max(size - 1, 1)
                start, expected = weights_at(places, corners)
            before, after = axis.before[:, level], axis.after[:, level]
            assert axis.corners[level] == expected.shape[2]
            np.testing.assert_array_equal(axis.start[:, level], start)
            weights = np.zeros((count, length, expected.shape[2] + 1))
            rows, columns = np.ogrid[:count, :length]
            weights[rows, columns, before] = 1 - after
            weights[rows, columns, before + 1] += after
            # No weight lies beyond the last corner.
            assert not weights[..., -1].any()
            np.testing.assert_allclose(weights[..., :-1], expected, atol=1e-7)


@pytest.mark.parametrize("gap", [1, 7, WINDOW, WINDOW + 60])
def test_missed_steps_sum_up_to_what_adam_catches_up_by(gap) -> None:
    rates = np.linspace(0.01, 0.0, 500)
    powers, weights = missed_step_tables(rates)
    visited = np.array([1, 5, 120])
    for number, first in enumerate(visited):
        expected = catch_up(visited[number : number + 1], first + gap, rates)
        i = np.arange(1, min(gap, WINDOW) + 1)
        factor = (powers[i, 0] * weights[first + i, 0]).sum()
        inverse = (powers[i, 1] * weights[first + i, 1]).sum()
        assert factor == pytest.approx(expected.factor[0], rel=1e-5)
        assert EPSILON * factor / inverse == pytest.approx(expected.epsilon[0], rel=1e-5)


MAX_REGISTERS = 128
"""Registers of a thread with which a multiprocessor holds two blocks of 256 threads."""
DEVICES = {
    80: DeviceLimits(
        multiprocessors=108, shared_per_block=163 << 10, shared_per_multiprocessor=164 << 10
    ),
    90: DeviceLimits(
        multiprocessors=132, shared_per_block=227 << 10, shared_per_multiprocessor=228 << 10
    ),
    100: DeviceLimits(
        multiprocessors=148, shared_per_block=227 << 10, shared_per_multiprocessor=228 << 10
    ),
}
"""Limits of an A100, an H100 and a B200, by architecture."""
KERNEL = re.compile(
    r"Compiling entry function '(?P<name>\w+)'.*?(?P<properties>Function properties.*?)"
    r"Used (?P<registers>\d+) registers(?P<rest>[^\n]*)",
    re.DOTALL,
)
"""Part of the compiler's messages on one kernel."""


@pytest.fixture(scope="module")
def nvrtc_nvrtc() -> Nvrtc:
    try:
        return find_nvrtc()
    except Unavailable as error:
        pytest.skip(str(error))


@pytest.fixture
def sizes_of(noise_coreset):
    """A function of an architecture, key frames and settings of the model: the sizes."""

    def make(architecture, keys, **settings):
        coreset = noise_coreset((4, 21, 48, 60), keys=keys, fringe=bool(keys))
        keys = len(coreset.key_frames)
        model = Architecture.for_box(coreset.box.shape, keys, **settings)
        return kernel_sizes(model, coreset, DEVICES[architecture])[0]

    return make


@pytest.mark.parametrize("architecture", DEVICES)
@pytest.mark.parametrize(
    ("width", "layers", "size", "keys"),
    [
        (64, 1, 2, ()),
        (64, 2, 2, ()),
        (128, 2, 2, ()),
        (64, 2, 2, (0, 3)),
        (128, 2, 2, (0, 3)),
        (16, 2, 1, (0, 3)),
    ],
)
def test_kernels_need_few_registers_and_no_local_memory(
    nvrtc_nvrtc, sizes_of, architecture, width, layers, size, keys
) -> None:
    """The finest level is interpolated, too, between key frames."""
    sizes = sizes_of(architecture, keys, width=width, hidden_layers=layers, embedding_size=size)
    assert assert_few_resources(nvrtc_nvrtc, sizes, architecture) == {
        "train_bricks",
        "infer_bricks",
        "move_flat",
        "sum_entries",
        "settle_bricks",
    }


@pytest.mark.parametrize("architecture", DEVICES)
@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize(
    ("width", "layers", "size"),
    [(64, 0, 2), (16, 1, 1), (64, 1, 2), (64, 2, 2), (64, 2, 8), (128, 2, 4)],
)
def test_kernels_of_points_need_few_registers_and_no_local_memory(
    nvrtc_nvrtc, architecture, sparse, width, layers, size
) -> None:
    model = Architecture.for_box(
        (21, 48, 60), 4, width=width, hidden_layers=layers, embedding_size=size
    )
    sizes = point_sizes(model, sparse, DEVICES[architecture])
    assert assert_few_resources(nvrtc_nvrtc, sizes, architecture) == {"values_at", "slopes_at"}


def assert_few_resources(nvrtc_nvrtc, sizes, architecture) -> set[str]:
    """Compile the kernels for some sizes; return their names."""
    cubin, log = nvrtc_nvrtc.compile(sizes.text(), architecture)
    assert cubin.startswith(b"\x7fELF")
    kernels = {match["name"]: match for match in KERNEL.finditer(log)}
    for match in kernels.values():
        assert int(match["registers"]) <= MAX_REGISTERS
        # A frame on the stack, spilled registers or local memory would be named where not 0.
        used = re.findall(r"(\d+) bytes (stack frame|spill \w+|lmem|cumulative stack)", match[0])
        assert not [number for number, _ in used if int(number)], match[0]
    return set(kernels)


def test_a_kernel_with_local_memory_is_seen(nvrtc_nvrtc) -> None:
    """The compiler's messages name what the test above looks for."""
    text = """extern "C" __global__ void local(float* a, int n) {
        float b[512]; for (int i = 0; i < 512; i++) b[i * n & 511] = a[i];
        a[0] = b[n & 511]; }"""
    _, log = nvrtc_nvrtc.compile(text, 90)
    assert re.search(r"[1-9]\d* bytes (stack frame|lmem|cumulative stack)", log), log


H100 = DeviceLimits(
    multiprocessors=132, shared_per_block=227 << 10, shared_per_multiprocessor=228 << 10
)


L40 = DeviceLimits(
    multiprocessors=142, shared_per_block=99 << 10, shared_per_multiprocessor=100 << 10
)
BETWEEN = {"shape": (3, 16, 16, 32), "keys": (0, 2)}
"""Samples between key frames: the finest level is interpolated, too."""


@pytest.fixture
def sizes_of_source(noise_coreset):
    """A function of limits and of settings of the model: the sizes."""

    def make(limits=H100, shape=(2, 16, 16, 32), keys=(), **settings):
        coreset = noise_coreset(shape, keys=keys, fringe=bool(keys))
        keys = len(coreset.key_frames)
        architecture = Architecture.for_box(coreset.box.shape, keys, **settings)
        return kernel_sizes(architecture, coreset, limits)[0]

    return make


@pytest.mark.parametrize("changes", [{}, BETWEEN], ids=["stored", "interpolated"])
def test_tiles_are_as_large_as_two_blocks_of_a_multiprocessor_allow(
    sizes_of_source, changes
) -> None:
    sizes = [sizes_of_source(hidden_layers=layers, **changes) for layers in (0, 1, 2)]
    assert [size.columns for size in sizes] == [128, 128, 64]
    for size in sizes:
        assert 2 * size.shared_bytes <= H100.shared_per_multiprocessor
        assert size.sums_in_shared


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hidden_layers": 3}, "3 hidden layers of 64"),
        ({"width": 129}, "2 hidden layers of 129"),
        ({"embedding_size": 16}, "inputs"),
        ({"limits": replace(H100, shared_per_block=1 << 12)}, "more shared memory"),
        ({"shape": (1, 1, 1, 1000)}, "more shared memory"),
        ({"limits": L40, "embedding_size": 4, **BETWEEN}, "more shared memory"),
    ],
)
def test_what_the_kernels_cannot_do_is_said(sizes_of_source, settings, message) -> None:
    with pytest.raises(Unavailable, match=message):
        sizes_of_source(**settings)


def test_the_text_defines_each_size_once_and_names_no_other_file(sizes_of_source) -> None:
    text = sizes_of_source().text()
    names = re.findall(r"^(?:constexpr|__constant__) (?:\w+ )+(\w+)", text, flags=re.MULTILINE)
    assert len(names) == len(set(names))
    assert {"LEVELS", "PITCH", "AT_END", "LATTICE_SHAPE"} <= set(names)
    assert "#include" not in text
    assert all((KERNELS / name).exists() for name in FILES)
    assert {path.name for path in KERNELS.iterdir()} == {*FILES, *points.FILES}

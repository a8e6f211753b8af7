"""The tables of the kernels say what the matrices and Adam's catching up say."""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from fhash_codec.paper.engines.fused import engine as points
from fhash_codec.paper.engines.fused import program as driver_module
from fhash_codec.paper.engines.fused.declarations import ffi
from fhash_codec.paper.engines.fused.engine import point_sizes
from fhash_codec.paper.engines.fused.program import (
    FILES,
    KERNELS,
    CudaDevice,
    CudaProgram,
    DeviceLimits,
    Driver,
    Nvrtc,
    Unavailable,
    axis_tables,
    compiled,
    find_nvrtc,
    kernel_sizes,
    missed_step_tables,
)
from fhash_codec.paper.engines.parameters import EPSILON, WINDOW, axis_matrices, catch_up
from fhash_codec.paper.network import Architecture


@pytest.mark.parametrize("shape", [(3, 9, 20, 35), (1, 1, 33, 2), (2, 5, 1, 1), (5, 16, 8, 64)])
def test_corners_and_weights_are_those_of_the_matrices(noise_coreset, shape) -> None:
    coreset = noise_coreset(shape)
    architecture = Architecture.for_box(coreset.box.shape, shape[0])
    lengths, counts = (1, *coreset.brick_shape), (shape[0], *coreset.brick_grid)
    axes = axis_tables(architecture, coreset)
    for number, (axis, length, count) in enumerate(zip(axes, lengths, counts, strict=True)):
        for level, resolution in enumerate(architecture.levels[1:]):
            start, expected = axis_matrices(
                architecture.sizes[number], resolution[number], length, count
            )
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


class FakeNvrtc:
    """An NVRTC that counts its compilations."""

    path = Path("libnvrtc.so.13")
    version = (13, 0)
    architectures = (80, 86, 90)

    def __init__(self) -> None:
        self.compiled: list[int] = []

    def compile(self, text, architecture):
        self.compiled.append(architecture)
        return b"code of " + text.encode(), ""


REASON = ffi.new("char[]", b"a reason")


class FakeLibrary:
    """A driver's library that notes its calls, and fails where `failing` says so."""

    def __init__(self, failing: str = "") -> None:
        self.calls: list[tuple] = []
        self.failing = failing

    def __getattr__(self, name):
        def call(*arguments):
            self.calls.append((name, *arguments))
            if name == "cuGetErrorString":
                arguments[1][0] = REASON
            if name == "cuDeviceGetAttribute":
                arguments[0][0] = arguments[1]
            return int(name == self.failing)

        return call


@pytest.fixture
def nvrtc(monkeypatch) -> FakeNvrtc:
    found = FakeNvrtc()
    monkeypatch.setattr(driver_module, "find_nvrtc", lambda: found)
    return found


@pytest.fixture
def library_of(monkeypatch):
    """A function that puts a FakeLibrary in the driver's place, with torch on its device."""

    @contextmanager
    def selected(device):
        yield

    def make(failing: str = "") -> FakeLibrary:
        library = FakeLibrary(failing)
        monkeypatch.setattr(driver_module, "_loaded", lambda names: library)
        return library

    monkeypatch.setattr(torch.cuda, "device", selected)
    stream = SimpleNamespace(cuda_stream=77)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    return make


def test_a_text_is_compiled_once_for_each_architecture_and_version(nvrtc, tmp_path) -> None:
    code, file = compiled("a", 90, tmp_path / "cache")
    assert code == b"code of a"
    assert file is not None
    assert file.read_bytes() == code
    assert compiled("a", 90, tmp_path / "cache") == (code, None)
    assert nvrtc.compiled == [90]
    compiled("b", 90, tmp_path / "cache")
    compiled("a", 80, tmp_path / "cache")
    nvrtc.version = (13, 1)
    compiled("a", 90, tmp_path / "cache")
    assert nvrtc.compiled == [90, 90, 80, 90]
    assert len(list((tmp_path / "cache").iterdir())) == 4


@pytest.mark.parametrize(("architecture", "target"), [(89, 86), (90, 90), (100, 0), (61, 0)])
def test_code_is_for_the_device_or_an_earlier_one_of_its_generation(
    nvrtc, tmp_path, architecture, target
) -> None:
    if target:
        compiled("a", architecture, tmp_path)
        assert nvrtc.compiled == [target]
    else:
        with pytest.raises(Unavailable, match=f"cannot compile for sm_{architecture}"):
            compiled("a", architecture, tmp_path)


def test_a_damaged_file_of_the_cache_is_compiled_anew(
    nvrtc, library_of, monkeypatch, tmp_path
) -> None:
    library = library_of()
    monkeypatch.setattr(driver_module, "cache_folder", lambda: tmp_path)
    compiled("a", 90, tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(b"damaged")
    device = CudaDevice.__new__(CudaDevice)
    device._driver, device._device, device._architecture = Driver(), torch.device("cuda", 0), 90
    usual = library.__class__.__getattr__

    def refuse_damaged(self, name):
        def load(module, code):
            return int(code == b"damaged")

        return load if name == "cuModuleLoadData" else usual(self, name)

    monkeypatch.setattr(FakeLibrary, "__getattr__", refuse_damaged)
    program = device.load(SimpleNamespace(text=lambda: "a", threads=256))
    assert program.new
    assert nvrtc.compiled == [90, 90]
    assert file.read_bytes() == b"code of a"


def test_a_launch_passes_addresses_of_arguments_and_torchs_stream(library_of, tmp_path) -> None:
    library, file = library_of(), tmp_path / "code"
    file.write_bytes(b"code")
    program = CudaProgram(Driver(), b"code", torch.device("cuda", 0), 256, file)
    assert program.new
    arguments = [ffi.new("int *", 5), ffi.new("float *", 2.5)]
    program.launch("train_bricks", 12, 70_000, arguments)
    program.launch("train_bricks", 12, 70_000, arguments)
    names = [name for name, *_ in library.calls]
    assert names == [
        "cuInit",
        "cuModuleLoadData",
        "cuModuleGetFunction",
        "cuFuncSetAttribute",
        "cuLaunchKernel",
        "cuLaunchKernel",
    ]
    assert library.calls[3][2] == 8
    assert library.calls[3][3] == 70_000
    _, _, *numbers, stream, addresses, extra = library.calls[-1]
    assert list(numbers) == [12, 1, 1, 256, 1, 1, 70_000]
    assert int(ffi.cast("intptr_t", stream)) == 77
    assert not extra
    assert addresses[0][0] == 5
    assert addresses[1][0] == 2.5
    program.forget()
    assert not file.exists()


@pytest.mark.parametrize("failing", ["cuInit", "cuModuleLoadData", "cuLaunchKernel"])
def test_failures_of_the_driver_name_the_call_and_its_reason(library_of, failing) -> None:
    library_of(failing)
    with pytest.raises(Unavailable, match=f"{failing} of the CUDA driver failed: a reason"):
        CudaProgram(Driver(), b"code", torch.device("cuda", 0), 256, None).launch("a", 1, 0, [])


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
    """A function of an architecture and of settings of the model: the sizes."""
    coreset = noise_coreset((4, 21, 48, 60))

    def make(architecture, **settings):
        model = Architecture.for_box(coreset.box.shape, 4, **settings)
        return kernel_sizes(model, coreset, DEVICES[architecture])[0]

    return make


@pytest.mark.parametrize("architecture", DEVICES)
@pytest.mark.parametrize(("width", "layers", "size"), [(64, 1, 2), (64, 2, 2), (128, 2, 2)])
def test_kernels_need_few_registers_and_no_local_memory(
    nvrtc_nvrtc, sizes_of, architecture, width, layers, size
) -> None:
    sizes = sizes_of(architecture, width=width, hidden_layers=layers, embedding_size=size)
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


def test_a_library_is_looked_for_in_nvidias_packages_first(monkeypatch, tmp_path) -> None:
    """A file that is no library is passed over and named, with the reason."""
    folder = tmp_path / "nvidia" / "cu13" / "lib"
    folder.mkdir(parents=True)
    (folder / "libnvrtc.so.13").write_text("not a library")
    (folder / "libnvrtc-builtins.so.13.0").write_text("not a library")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    monkeypatch.setattr(
        "fhash_codec.paper.engines.fused.program._folders", lambda: [folder, tmp_path / "none"]
    )
    with pytest.raises(Unavailable, match=re.escape(str(folder / "libnvrtc"))):
        find_nvrtc()


H100 = DeviceLimits(
    multiprocessors=132, shared_per_block=227 << 10, shared_per_multiprocessor=228 << 10
)


@pytest.fixture
def sizes_of_source(noise_coreset):
    """A function of limits and of settings of the model: the sizes."""

    def make(limits=H100, shape=(2, 16, 16, 32), **settings):
        coreset = noise_coreset(shape)
        architecture = Architecture.for_box(coreset.box.shape, shape[0], **settings)
        return kernel_sizes(architecture, coreset, limits)[0]

    return make


def test_tiles_are_as_large_as_two_blocks_of_a_multiprocessor_allow(sizes_of_source) -> None:
    sizes = [sizes_of_source(width=64, hidden_layers=layers) for layers in (0, 1, 2)]
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

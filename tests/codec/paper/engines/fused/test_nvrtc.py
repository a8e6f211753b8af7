"""NVRTC turns the kernels into machine code, within limits; skipped where there is none."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused.nvrtc import Nvrtc, find_nvrtc
from fhash_codec.paper.engines.fused.points import point_sizes
from fhash_codec.paper.engines.fused.source import DeviceLimits, Unavailable, kernel_sizes

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
def nvrtc() -> Nvrtc:
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
    nvrtc, sizes_of, architecture, width, layers, size
) -> None:
    sizes = sizes_of(architecture, width=width, hidden_layers=layers, embedding_size=size)
    assert assert_few_resources(nvrtc, sizes, architecture) == {
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
    nvrtc, architecture, sparse, width, layers, size
) -> None:
    model = Architecture.for_box(
        (21, 48, 60), 4, width=width, hidden_layers=layers, embedding_size=size
    )
    sizes = point_sizes(model, sparse, DEVICES[architecture])
    assert assert_few_resources(nvrtc, sizes, architecture) == {"values_at", "slopes_at"}


def assert_few_resources(nvrtc, sizes, architecture) -> set[str]:
    """Compile the kernels for some sizes; return their names."""
    cubin, log = nvrtc.compile(sizes.text(), architecture)
    assert cubin.startswith(b"\x7fELF")
    kernels = {match["name"]: match for match in KERNEL.finditer(log)}
    for match in kernels.values():
        assert int(match["registers"]) <= MAX_REGISTERS
        # A frame on the stack, spilled registers or local memory would be named where not 0.
        used = re.findall(r"(\d+) bytes (stack frame|spill \w+|lmem|cumulative stack)", match[0])
        assert not [number for number, _ in used if int(number)], match[0]
    return set(kernels)


def test_a_kernel_with_local_memory_is_seen(nvrtc) -> None:
    """The compiler's messages name what the test above looks for."""
    text = """extern "C" __global__ void local(float* a, int n) {
        float b[512]; for (int i = 0; i < 512; i++) b[i * n & 511] = a[i];
        a[0] = b[n & 511]; }"""
    _, log = nvrtc.compile(text, 90)
    assert re.search(r"[1-9]\d* bytes (stack frame|lmem|cumulative stack)", log), log


def test_wrong_text_is_refused_with_the_compilers_words(nvrtc) -> None:
    with pytest.raises(Unavailable, match=r"NVRTC_ERROR_COMPILATION(.|\n)*nonsense"):
        nvrtc.compile("nonsense", 90)


def test_a_library_is_looked_for_in_nvidias_packages_first(monkeypatch, tmp_path) -> None:
    """A file that is no library is passed over and named, with the reason."""
    folder = tmp_path / "nvidia" / "cu13" / "lib"
    folder.mkdir(parents=True)
    (folder / "libnvrtc.so.13").write_text("not a library")
    (folder / "libnvrtc-builtins.so.13.0").write_text("not a library")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    monkeypatch.setattr(
        "fhash_codec.paper.engines.fused.nvrtc._folders", lambda: [folder, tmp_path / "none"]
    )
    with pytest.raises(Unavailable, match=re.escape(str(folder / "libnvrtc"))):
        find_nvrtc()


def test_folders_of_toolkits_and_the_loader_are_tried(monkeypatch, tmp_path) -> None:
    from fhash_codec.paper.engines.fused.nvrtc import _folders

    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "toolkit"))
    monkeypatch.setenv("LD_LIBRARY_PATH", f"{tmp_path / 'loader'}:")
    folders = _folders()
    assert tmp_path / "toolkit" / "lib64" in folders
    assert tmp_path / "loader" in folders
    assert Path() not in folders


def test_without_a_library_that_is_said(monkeypatch) -> None:
    monkeypatch.setattr("fhash_codec.paper.engines.fused.nvrtc._folders", lambda: [])
    with pytest.raises(Unavailable, match="no NVRTC was found"):
        find_nvrtc()

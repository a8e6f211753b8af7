"""Devices and the compiler of their kernels, with a driver and an NVRTC that note their calls."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.cuda import device as devices
from fhash_codec.cuda import nvrtc as compilers
from fhash_codec.cuda.declarations import ffi
from fhash_codec.cuda.device import CudaDevice, CudaKernels, has_device, sent
from fhash_codec.cuda.nvrtc import Unavailable, compiled, find_nvrtc, kept


class FakeNvrtc:
    """An NVRTC that counts its compilations."""

    path = Path("libnvrtc.so.13")
    architectures = (80, 86, 90)

    def __init__(self) -> None:
        self.compiled: list[int] = []

    def compile(self, text, architecture, headers=None, options=()):
        self.compiled.append(architecture)
        return b"code of " + text.encode(), ""


REASON = ffi.new("char[]", b"a reason")


class FakeLibrary:
    """A driver's library that notes its calls, and fails where `failing` says so."""

    def __init__(self, failing: str = "", answer: int = 1) -> None:
        self.calls: list[tuple] = []
        self.failing, self.answer = failing, answer
        self.held: dict[int, bytearray] = {}

    def __getattr__(self, name):
        def call(*arguments):
            self.calls.append((name, *arguments))
            if name == "cuGetErrorString":
                arguments[1][0] = REASON
            if name == "cuDeviceGetAttribute":
                arguments[0][0] = arguments[1]
            if name == "cuDeviceGetCount":
                arguments[0][0] = 1
            if name == "cuDriverGetVersion":
                arguments[0][0] = 13_000
            if name == "cuMemAlloc_v2":
                arguments[0][0] = 4096 * (len(self.held) + 1)
                self.held[arguments[0][0]] = bytearray(arguments[1])
            if name == "cuMemcpyHtoD_v2":
                at, source, size = arguments
                base = max(first for first in self.held if first <= at)
                self.held[base][at - base : at - base + size] = ffi.buffer(source, size)
            if name == "cuMemcpyDtoH_v2":
                to, at, size = arguments
                ffi.buffer(to, size)[:] = self.held[at][:size]
            return self.answer if name == self.failing else 0

        return call


@pytest.fixture
def nvrtc(monkeypatch) -> FakeNvrtc:
    found = FakeNvrtc()
    monkeypatch.setattr(compilers, "find_nvrtc", lambda newest: found)
    return found


@pytest.fixture
def library_of(monkeypatch):
    """A function that puts a FakeLibrary in the driver's place."""

    def make(failing: str = "", answer: int = 1) -> FakeLibrary:
        library = FakeLibrary(failing, answer)
        monkeypatch.setattr(devices, "loaded", lambda names: library)
        devices.driver.cache_clear()
        return library

    yield make
    devices.driver.cache_clear()


def test_a_text_is_compiled_once_for_each_architecture(nvrtc, tmp_path) -> None:
    """Code that was not kept after a trial is compiled again."""
    folder = tmp_path / "cache"
    code, file, new = compiled("a", 90, folder)
    assert (code, new) == (b"code of a", True)
    assert compiled("a", 90, folder) == (code, file, True)
    kept(code, file)
    assert compiled("a", 90, folder) == (code, file, False)
    assert nvrtc.compiled == [90, 90]
    others = [
        compiled("b", 90, folder),
        compiled("a", 80, folder),
        compiled("a", 90, folder, headers={"h": "of another text"}),
        compiled("a", 90, folder, options=["--fmad=false"]),
    ]
    assert nvrtc.compiled == [90, 90, 90, 80, 90, 90]
    assert len({file, *(other[1] for other in others)}) == 5


def test_what_the_cache_has_needs_no_compiler(nvrtc, tmp_path, monkeypatch) -> None:
    code, file, _ = compiled("a", 90, tmp_path)
    kept(code, file)
    monkeypatch.setattr(compilers, "find_nvrtc", lambda newest: 1 / 0)
    assert compiled("a", 90, tmp_path) == (code, file, False)


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
    library_of()
    monkeypatch.setattr(devices, "cache_folder", lambda: tmp_path)
    # The library's answers are the numbers that it is asked for: the architecture is 75 and 76.
    monkeypatch.setattr(FakeNvrtc, "architectures", (10 * 75 + 76,))
    _, file, _ = compiled("a", 10 * 75 + 76, tmp_path)
    file.write_bytes(b"damaged")
    usual = FakeLibrary.__getattr__

    def refuse_damaged(self, name):
        def load(module, code):
            return int(code == b"damaged")

        return load if name == "cuModuleLoadData" else usual(self, name)

    monkeypatch.setattr(FakeLibrary, "__getattr__", refuse_damaged)
    device = CudaDevice()
    kernels = device.load("a")
    assert kernels.new
    assert device.load("a") is kernels
    kernels.keep()
    assert file.read_bytes() == b"code of a"


def test_code_that_the_driver_refuses_is_compiled_once(
    nvrtc, library_of, monkeypatch, tmp_path
) -> None:
    library_of("cuModuleLoadData")
    monkeypatch.setattr(devices, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(FakeNvrtc, "architectures", (10 * 75 + 76,))
    with pytest.raises(Unavailable, match="cuModuleLoadData of the CUDA driver failed"):
        CudaDevice().load("a")
    assert len(nvrtc.compiled) == 1
    assert not list(tmp_path.iterdir())


def test_a_launch_sends_sizes_stream_and_arguments(library_of, tmp_path) -> None:
    library, file = library_of(), tmp_path / "kernels"
    kernels = CudaKernels(CudaDevice(), b"code", file, new=True)
    arguments = [ffi.new("int *", 5), ffi.new("float *", 2.5)]
    kernels.launch("train_bricks", 12, 256, 70_000, arguments, 77)
    kernels.launch("train_bricks", 12, 256, 70_000, arguments, 77)
    names = [name for name, *_ in library.calls if name.startswith(("cuM", "cuF", "cuL"))]
    assert names == [
        "cuModuleLoadData",
        "cuModuleGetFunction",
        "cuFuncSetAttribute",
        "cuLaunchKernel",
        "cuLaunchKernel",
    ]
    (launched, *_) = [call for call in library.calls if call[0] == "cuLaunchKernel"]
    _, _, *numbers, stream, addresses, extra = launched
    assert list(numbers) == [12, 1, 1, 256, 1, 1, 70_000]
    assert int(ffi.cast("intptr_t", stream)) == 77
    assert not extra
    assert addresses[0][0] == 5
    assert addresses[1][0] == 2.5
    # Each call is made in the device's context.
    depth = 0
    for name, *_ in library.calls:
        depth += {"cuCtxPushCurrent_v2": 1, "cuCtxPopCurrent_v2": -1}.get(name, 0)
        assert depth == int(name.startswith(("cuMod", "cuFunc", "cuLaunch"))) or "Ctx" in name
    assert not file.exists()
    kernels.keep()
    assert not kernels.new
    assert file.read_bytes() == b"code"


def test_shared_memory_of_a_kernel_only_grows(library_of, tmp_path) -> None:
    library = library_of()
    kernels = CudaKernels(CudaDevice(), b"code", tmp_path / "kernels", new=False)
    for shared_bytes in (80_000, 30_000, 80_000, 90_000):
        kernels.launch("a", 1, 32, shared_bytes, [])
    asked = [call[3] for call in library.calls if call[0] == "cuFuncSetAttribute"]
    assert asked == [80_000, 90_000]


def test_memory_holds_what_is_sent_and_is_freed(library_of) -> None:
    library = library_of()
    device, array = CudaDevice(), np.arange(10.0)[::2]
    memory = sent(device, array)
    memory.send(np.array([7.0]), offset=8)
    back = np.empty(5)
    memory.receive(back)
    np.testing.assert_array_equal(back, [0, 7, 4, 6, 8])
    address = memory.address
    del memory
    assert ("cuMemFree_v2", address) in library.calls


def test_memory_is_left_in_silence_behind_a_kernel_that_failed(library_of, recwarn) -> None:
    library = library_of()
    memory = CudaDevice().memory(8)
    library.failing = "cuMemFree_v2"
    del memory  # pytest turns an exception that nobody can catch into a warning
    assert not recwarn.list


@pytest.mark.parametrize("failing", ["cuInit", "cuModuleLoadData", "cuLaunchKernel"])
def test_failures_of_the_driver_name_the_call_and_its_reason(library_of, failing) -> None:
    library_of(failing)
    with pytest.raises(Unavailable, match=f"{failing} of the CUDA driver failed: a reason"):
        CudaKernels(CudaDevice(), b"code", Path(), new=True).launch("a", 1, 32, 0, [])


def test_too_little_memory_is_a_memory_error(library_of) -> None:
    library_of("cuMemAlloc_v2", 2)
    with pytest.raises(MemoryError, match="a reason"):
        CudaDevice().memory(1 << 20)


def test_a_machine_without_a_driver_has_no_device(monkeypatch) -> None:
    monkeypatch.setattr(devices, "LIBRARIES", ("no_such_library.so",))
    devices.driver.cache_clear()
    assert not has_device()


def test_a_library_is_looked_for_in_nvidias_packages_first(monkeypatch, tmp_path) -> None:
    """A file that is no library is passed over and named, with the reason."""
    folder = tmp_path / "nvidia" / "cu13" / "lib"
    folder.mkdir(parents=True)
    (folder / "libnvrtc.so.13").write_text("not a library")
    (folder / "libnvrtc-builtins.so.13.0").write_text("not a library")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    monkeypatch.setattr(compilers, "_folders", lambda: [folder, tmp_path / "none"])
    with pytest.raises(Unavailable, match=re.escape(str(folder / "libnvrtc"))):
        find_nvrtc()


def test_a_library_newer_than_the_driver_is_passed_over(monkeypatch, tmp_path) -> None:
    for number in (12, 13):
        (tmp_path / f"libnvrtc.so.{number}").write_text("")

    class Loaded:
        def __init__(self, path) -> None:
            self.path, self.version = path, (int(path.suffix[1:]), 0)

    monkeypatch.setattr(compilers, "Nvrtc", Loaded)
    monkeypatch.setattr(compilers, "_folders", lambda: [tmp_path])
    assert find_nvrtc().version == find_nvrtc(13).version == (13, 0)
    assert find_nvrtc(12).version == (12, 0)
    with pytest.raises(Unavailable, match=r"is of CUDA 12, and the driver of CUDA 11"):
        find_nvrtc(11)

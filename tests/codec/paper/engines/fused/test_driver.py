"""Compiled kernels are kept on disk, and launched as the driver wants it; no GPU is needed."""

from __future__ import annotations

import ctypes
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from fhash_codec.paper.engines.fused import driver as driver_module
from fhash_codec.paper.engines.fused.driver import (
    CudaDevice,
    CudaProgram,
    Driver,
    cache_folder,
    compiled,
)
from fhash_codec.paper.engines.fused.source import Unavailable


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


class FakeLibrary:
    """A driver's library that notes its calls, and fails where `failing` says so."""

    def __init__(self, failing: str = "") -> None:
        self.calls: list[tuple] = []
        self.failing = failing

    def __getattr__(self, name):
        def call(*arguments):
            self.calls.append((name, *arguments))
            if name == "cuGetErrorString":
                arguments[1]._obj.value = b"a reason"
            if name == "cuDeviceGetAttribute":
                arguments[0]._obj.value = arguments[1]
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


def test_a_cache_that_cannot_be_written_is_no_failure(nvrtc, tmp_path) -> None:
    (tmp_path / "cache").write_text("a file in its place")
    code, file = compiled("a", 90, tmp_path / "cache")
    assert code == b"code of a"
    assert file is not None


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


def test_a_library_without_a_function_is_too_old(monkeypatch) -> None:
    monkeypatch.setattr(driver_module, "_loaded", lambda names: SimpleNamespace())
    with pytest.raises(Unavailable, match="too old: it has no cuInit"):
        Driver()


def test_the_cache_is_in_the_users_folder(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "fhash" / "kernels"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "fhash" / "kernels"


def test_a_launch_passes_addresses_of_arguments_and_torchs_stream(library_of, tmp_path) -> None:
    library, file = library_of(), tmp_path / "code"
    file.write_bytes(b"code")
    program = CudaProgram(Driver(), b"code", torch.device("cuda", 0), 256, file)
    assert program.new
    arguments = [ctypes.c_int(5), ctypes.c_float(2.5)]
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
    assert library.calls[3][3].value == 70_000
    _, _, *numbers, stream, addresses, extra = library.calls[-1]
    assert [number.value for number in numbers] == [12, 1, 1, 256, 1, 1, 70_000]
    assert stream.value == 77
    assert extra is None
    assert ctypes.cast(addresses[0], ctypes.POINTER(ctypes.c_int))[0] == 5
    assert ctypes.cast(addresses[1], ctypes.POINTER(ctypes.c_float))[0] == 2.5
    program.forget()
    assert not file.exists()


@pytest.mark.parametrize("failing", ["cuInit", "cuModuleLoadData", "cuLaunchKernel"])
def test_failures_of_the_driver_name_the_call_and_its_reason(library_of, failing) -> None:
    library_of(failing)
    with pytest.raises(Unavailable, match=f"{failing} of the CUDA driver failed: a reason"):
        CudaProgram(Driver(), b"code", torch.device("cuda", 0), 256, None).launch("a", 1, 0, [])


def test_limits_are_those_that_the_driver_names(library_of, monkeypatch) -> None:
    library_of()
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 3)
    monkeypatch.setattr(torch, "empty", lambda *sizes, **settings: None)
    device = CudaDevice(torch.device("cuda"))
    # The fake attribute is its own number.
    assert device.limits.multiprocessors == 16
    assert device.limits.shared_per_multiprocessor == 81
    assert device.limits.shared_per_block == 97
    assert device._architecture == 10 * 75 + 76


def test_without_a_driver_that_is_said(monkeypatch) -> None:
    monkeypatch.setattr(driver_module, "LIBRARIES", ("libfhash_no_such_library.so",))
    with pytest.raises(Unavailable, match="libfhash_no_such_library"):
        Driver()

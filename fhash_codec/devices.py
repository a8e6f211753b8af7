"""Devices, and threads of a training. Import this module before torch, which few things need."""

from __future__ import annotations

import datetime
import os
import platform
import re
import shlex
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fhash_codec.cuda import device as cuda
from fhash_codec.cuda.device import has_device
from fhash_codec.cuda.nvrtc import Unavailable, loaded
from fhash_codec.native.network import machine_paths
from fhash_formats.errors import FhashWarning, InputError, MissingDependencyError
from fhash_formats.support.threads import at_most, usable_threads

if TYPE_CHECKING:
    import torch

# Between two small operations OpenMP threads spin, by default for milliseconds. On a machine in
# shared use the spinning threads keep off the core the very threads they wait for: training runs 8
# times slower beside a second training. 10,000 rounds take some tens of microseconds, more than the
# pause between operations, so an idle machine stays as fast.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

VERTICES_A_THREAD = 12_000
"""Vertices of a training step per thread; with fewer, a further thread costs more than it saves."""
_PROCESS = os.getpid()
"""The process that imported this module."""
LIBRARIES = ("numpy", "torch", "h5py", "zarr", "hdf5plugin")
"""Libraries whose versions `machine` tells where they are loaded; SZ3, SPERR and ZFP are of
hdf5plugin."""


def leave_threads_of_parent() -> None:
    """Let torch, where it is loaded, compute in one thread in a process forked since this import.

    OpenMP believes there that it still has the threads of the parent, and waits for them for ever.
    """
    torch = sys.modules.get("torch")
    if os.getpid() != _PROCESS and torch is not None:
        torch.set_num_threads(1)


@contextmanager
def computing_threads(threads: int) -> Iterator[None]:
    """Compute in at most a number of threads while the context lasts.

    torch does, too, where it is loaded.
    """
    torch = sys.modules.get("torch")
    with at_most(threads):
        if torch is None:
            yield
            return
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            yield
        finally:
            torch.set_num_threads(before)


@contextmanager
def threads_for(vertices: int) -> Iterator[int]:
    """Limit the threads, while the context lasts, to those that pay for a training.

    They are at most those that may be used. The context yields their number.

    Args:
        vertices: vertices of a training step.
    """
    threads = max(1, min(usable_threads(), vertices // VERTICES_A_THREAD))
    with computing_threads(threads):
        yield threads


# The matrix products of CUDA give the same bits in every run only with workspaces of one kind.
# torch looks at this variable once, at the first product of the process.
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")

CUDA_PAYS = 4.0
"""Seconds of training on the CPU from which on `auto` trains on CUDA, which takes some to start.

`make device`: the start takes 2.2 to 3.6 s, and `fused` is 10 to 18 times as fast as 16 cores.
Both take the same time at 2.4 to 4.0 s.
"""


def may_have_cuda() -> bool:
    """Return whether there are torch and CUDA's driver, without importing torch, which is slow."""
    if not has_torch():
        return False
    try:
        loaded(cuda.LIBRARIES)
    except Unavailable:
        return False
    return True


def has_torch() -> bool:
    """Return whether torch is installed, without importing it."""
    return find_spec("torch") is not None


def need_torch(what: str) -> None:
    """Import torch, or raise MissingDependencyError that names what needs it and the extra."""
    try:
        import torch  # noqa: F401
    except ImportError as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name == "torch"
        reason = "" if absent else f" (the torch that is installed fails: {error})"
        raise MissingDependencyError(
            f"{what} needs torch: pip install 'fhash[torch]'{reason}"
        ) from error


def choose_device(name: str) -> torch.device:
    """Return the torch device named cpu, cuda or auto; auto is CUDA where there is a device.

    Raises InputError for cuda where torch finds no CUDA device, MissingDependencyError without
    torch.
    """
    need_torch(f"device '{name}'")
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device is 'cuda', but torch finds no CUDA device here; use --device cpu")
    return torch.device(name)


def check_cuda(name: str, *, torch: bool) -> None:
    """Raise InputError where a device is cuda and there is none.

    torch: whether torch is needed there; MissingDependencyError where it is missing.
    """
    if name != "cuda":
        return
    if torch:
        need_torch("device 'cuda'")
    if not has_device():
        raise InputError("device is 'cuda', but there is no CUDA device here; use --device cpu")


def first_line(error: Exception) -> str:
    """Return the first line of an error's text: CUDA adds advice for programmers to it."""
    return str(error).strip().split("\n")[0]


def training_device(
    name: str, cpu_seconds: float, needed_bytes: int, refusal: str | None = None
) -> tuple[str, str]:
    """Return the device for a training, 'cpu' or 'cuda', and why.

    auto is CUDA where that pays and fits. torch is imported only where CUDA may be the answer.

    Args:
        name: cpu, cuda or auto.
        cpu_seconds: seconds that the training takes on the CPU.
        needed_bytes: memory that it needs on a device of its own.
        refusal: why kernels for CUDA cannot do the model; None if they can.

    Raises:
        InputError: cuda cannot do the model, or has no device or one with too little free memory.
        MissingDependencyError: cuda is asked for, and torch is not installed.
    """
    pays = f"the CPU takes about {cpu_seconds:.1f} s, and CUDA pays from {CUDA_PAYS:g} s on"
    if name == "cpu":
        return "cpu", "on the CPU, as --device says"
    if name == "auto":
        if not may_have_cuda():
            return "cpu", "on the CPU, as there is no CUDA device, or no torch"
        if cpu_seconds < CUDA_PAYS:
            return "cpu", f"on the CPU, as {pays}"
        if refusal is not None:
            return "cpu", f"on the CPU, as {refusal}"
        if choose_device(name).type == "cpu":
            return "cpu", "on the CPU, as torch finds no CUDA device"
    if refusal is not None:
        raise InputError(f"device is 'cuda', but {refusal}; use --device cpu")
    device = choose_device(name)
    import torch

    free, _ = torch.cuda.mem_get_info(device)
    if needed_bytes <= free:
        return "cuda", f"on CUDA, as {pays if name == 'auto' else '--device says'}"
    lack = (
        f"training needs about {needed_bytes / 2**30:.1f} GiB on the CUDA device,"
        f" of which {free / 2**30:.1f} GiB are free"
    )
    if name == "auto":
        warnings.warn(f"{lack}; it takes the CPU", FhashWarning, stacklevel=2)
        return "cpu", f"on the CPU, as {lack}"
    raise InputError(f"{lack}; use --device cpu, or a feature or key frames that select less")


@contextmanager
def enough_memory(device: str) -> Iterator[None]:
    """Raise InputError where the memory of a CUDA device runs out while the context lasts."""
    if device == "cpu":
        yield
        return
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        raise InputError(
            f"the memory of the device {device} ran out in training ({first_line(error)});"
            " use --device cpu, which goes on from a checkpoint, too"
        ) from error


@contextmanager
def same_bits(device: str, wanted: bool) -> Iterator[None]:
    """Let torch compute the same bits in every run on a CUDA device while the context lasts.

    Sums are then sorted instead of added by atomic operations in any order. An operation that has
    no such way is a RuntimeError. On a CPU nothing changes.
    """
    if device == "cpu" or not wanted:
        yield
        return
    import torch

    before = torch.are_deterministic_algorithms_enabled()
    only_warns = torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before, warn_only=only_warns)


def machine(device: torch.device | None = None) -> dict[str, Any]:
    """Record of where and when figures are taken, as JSON values: date, command line, versions of
    the libraries that are loaded, and the machine with its load over the last minute.

    device: the one that torch computes on; None for the CPU.
    """
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search("model name.*: (.*)", cpuinfo.read_text()) if cpuinfo.exists() else None
    name = "cpu" if device is None else device.type
    if name == "cuda":
        import torch

        name = torch.cuda.get_device_name(device)
    facts = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "device": name,
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "vectors": (machine_paths() or ["baseline"])[0],
        "cores": os.cpu_count(),
        "threads": usable_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "fhash": version("fhash"),
        "python": platform.python_version(),
        **{library: version(library) for library in LIBRARIES if sys.modules.get(library)},
    }
    if sys.platform != "win32":
        gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        facts |= {"memory": f"{gib:.0f} GiB", "load": round(os.getloadavg()[0], 2)}
    return facts

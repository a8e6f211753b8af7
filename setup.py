"""The native libraries: C++ of `fhash_formats.native`, `fhash_codec.native`, its `network`.

They are plain shared libraries for ctypes, without Python's headers: one wheel serves every Python.
The rest of the build is described in pyproject.toml. Where the machine has no C++ compiler, that of
the package ziglang is used (build_backend.py); it also compiles for other machines, where
FHASH_TARGET names one by zig's words, such as aarch64-linux-musl (`make wheels`).
"""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError, CompileError

from build_backend import has_compiler

FORMATS = Path("formats/fhash_formats/native")
"""Sources of the file format's library; the codec's library includes core.hpp and guard.hpp."""
CODEC = Path("fhash_codec/native")
"""Sources of the codec's library."""
NETWORK = CODEC / "network"
"""Sources of the library that trains and evaluates the paper's network."""
TARGET = os.environ.get("FHASH_TARGET", "")
"""Machine to compile for, in zig's words; empty for this one."""

# No contraction into fused multiply-adds and no fast-math: a stream must decode to the same bits on
# every machine. That nothing traps, and loops marked as independent, change no bit; without them
# the compiler does not vectorise the marcher.
GNU_FLAGS = [
    "-O3",
    "-std=c++17",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp-simd",
    "-fvisibility=hidden",
    "-Wno-psabi",  # functions that take vectors are inlined: no call depends on how one passes them
    "-g0",
]
GNU_LINK_FLAGS = ["-Wl,-s", "-pthread"] if TARGET or sys.platform == "linux" else []
"""Debug records and symbol tables would make the libraries five times as large; on Windows they
would lie beside them."""
LIBFHASH_FLAGS = (
    (f"-Wl,--version-script={FORMATS / 'exports.map'}", "-Wl,-soname,libfhash.so")
    if "linux" in (TARGET or sys.platform)
    else ()
)
"""The interface alone is exported, and nothing of the standard library; programs find the library
by its name in the package. CMakeLists.txt builds it for a system, as libfhash.so.1."""
NETWORK_FLAGS = ("-ffp-contract=fast", "-pthread")
"""Fused multiply-adds, and threads, for the network alone: no stream depends on its bits."""
THIRD_PARTY: list[tuple[str, str | None]] = [
    ("yyjson_api", ""),
    ("ZSTDLIB_VISIBLE", ""),
    ("ZSTDERRORLIB_VISIBLE", ""),
    ("ZSTD_DISABLE_ASM", "1"),
    ("ZSTD_TRACE", "0"),
    ("FHASH_BUILDING", "1"),
]
"""Definitions by which a library exports nothing of third_party, but its own public functions."""
MSVC_FLAGS = ["/O2", "/std:c++17", "/fp:precise", "/EHsc"]


def use_zig() -> None:
    """Set the variables by which setuptools finds the compiler to that of ziglang."""
    if find_spec("ziglang") is None:
        sys.exit("fhash needs a C++17 compiler: install g++ or clang++, or `pip install ziglang`")
    # Unless it is told otherwise, zig adds checks that trap, and compiles for this very processor.
    flags = "-fno-sanitize=all -s"
    flags += f" -target {TARGET}" if TARGET else " -mcpu=baseline"
    c, cxx = (f"{sys.executable} -m ziglang {name} {flags}" for name in ("cc", "c++"))
    shared = f"{cxx} -shared"
    os.environ |= {"CC": c, "CXX": cxx, "LDSHARED": shared, "LDCXXSHARED": shared}


class BuildNative(build_ext):
    """`build_ext` of plain libraries, with the compiler that is there, all files side by side."""

    def get_ext_filename(self, fullname: str) -> str:
        return os.path.join(*fullname.split(".")) + ".so"

    def get_export_symbols(self, ext: Extension) -> list[str]:
        return []  # not that of a Python module

    def run(self) -> None:
        if TARGET or not has_compiler():
            use_zig()
        super().run()

    def build_extensions(self) -> None:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            if self.compiler.compiler_type != "msvc":  # that one initialises itself on the way
                self._compile_in(pool)
            self._build_extensions()

    def _compile_in(self, pool: ThreadPoolExecutor) -> None:
        compile_some = self.compiler.compile

        def compile_one(source: str, extra_postargs: list[str], **options: Any) -> list[str]:
            if source.endswith(".c"):  # of others: C, and its warnings are theirs
                own = [flag for flag in extra_postargs if not flag.startswith("-std=")]
                extra_postargs = [*own, "-w"]
            return list(compile_some([source], extra_postargs=extra_postargs, **options))

        def compile_each(sources: list[str], **options: Any) -> list[str]:
            jobs = [pool.submit(compile_one, source, **options) for source in sources]
            return [path for job in jobs for path in job.result()]

        self.compiler.compile = compile_each

    def _build_extensions(self) -> None:
        named = getattr(self.compiler, "compiler_cxx", None) or ["cl.exe"]
        try:
            self._build_with_flags()
        except (CCompilerError, BaseError) as error:
            raise CompileError(
                f"fhash needs a C++17 compiler, and '{named[0]}' did not build it: {error}"
            ) from error

    def _build_with_flags(self) -> None:
        for extension in self.extensions:
            msvc = self.compiler.compiler_type == "msvc"
            own, links = extension.extra_compile_args, extension.extra_link_args
            extension.extra_compile_args = MSVC_FLAGS if msvc else [*GNU_FLAGS, *own]
            extension.extra_link_args = [] if msvc else [*GNU_LINK_FLAGS, *links]
        super().build_extensions()


class PlainWheel(bdist_wheel):
    """A wheel for every Python 3 of a platform."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


def native(
    name: str, folder: Path, *, flags: tuple[str, ...] = (), link_flags: tuple[str, ...] = ()
) -> Extension:
    """The library of all C++ sources in a folder, and of the C sources in its `third_party`.

    `flags` and `link_flags` are added to those of every library, where the compiler is GCC or
    Clang.
    """
    headers = {*folder.glob("*.hpp"), *FORMATS.glob("*.hpp"), *FORMATS.glob("*.h")}
    others = sorted((folder / "third_party").glob("**/*.c"))
    return Extension(
        name,
        sources=[path.as_posix() for path in (*sorted(folder.glob("*.cpp")), *others)],
        depends=sorted(path.as_posix() for path in headers),
        include_dirs=[FORMATS.as_posix()],
        define_macros=THIRD_PARTY if others else [],
        extra_compile_args=list(flags),
        extra_link_args=list(link_flags),
        language="c++",
    )


setup(
    ext_modules=[
        native("fhash_formats.native.libfhash", FORMATS, link_flags=LIBFHASH_FLAGS),
        native("fhash_codec.native._codec", CODEC, flags=("-pthread",)),
        native("fhash_codec.native.network._network", NETWORK, flags=NETWORK_FLAGS),
    ],
    cmdclass={"build_ext": BuildNative, "bdist_wheel": PlainWheel},
    options={"build_ext": {"parallel": 3}},
)

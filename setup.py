"""The native extensions: C++ of `fhash_formats.native`, `fhash_codec.native`, its `network`.

The rest of the build is described in pyproject.toml. Without a C++17 compiler the installation
fails in one line.
"""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError, CompileError

FORMATS = Path("formats/fhash_formats/native")
"""Sources of the file format's library; the codec's library includes core.hpp and guard.hpp."""
CODEC = Path("fhash_codec/native")
"""Sources of the codec's library."""
NETWORK = CODEC / "network"
"""Sources of the library that trains and evaluates the paper's network."""

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
    "-g0",
]
GNU_LINK_FLAGS = ["-Wl,-s", "-pthread"] if sys.platform == "linux" else []
"""Debug records and symbol tables would make the libraries five times as large."""
NETWORK_FLAGS = ("-ffp-contract=fast", "-pthread")
"""Fused multiply-adds, and threads, for the network alone: no stream depends on its bits."""
MSVC_FLAGS = ["/O2", "/std:c++17", "/fp:precise", "/EHsc"]


class BuildNative(build_ext):
    """`build_ext` with the flags of the compiler that is there, for all files side by side."""

    def build_extensions(self) -> None:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            if self.compiler.compiler_type != "msvc":  # that one initialises itself on the way
                self._compile_in(pool)
            self._build_extensions()

    def _compile_in(self, pool: ThreadPoolExecutor) -> None:
        compile_some = self.compiler.compile

        def compile_each(sources: list[str], **options: Any) -> list[str]:
            jobs = [pool.submit(compile_some, [source], **options) for source in sources]
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
            own = extension.extra_compile_args
            extension.extra_compile_args = MSVC_FLAGS if msvc else [*GNU_FLAGS, *own]
            extension.extra_link_args = [] if msvc else GNU_LINK_FLAGS
        super().build_extensions()


def native(name: str, folder: Path, *, flags: tuple[str, ...] = ()) -> Extension:
    """The extension of all C++ sources in a folder, for the limited API of Python 3.11.

    `flags` are added to those of every extension, where the compiler is GCC or Clang.
    """
    headers = {*folder.glob("*.hpp"), *FORMATS.glob("*.hpp")}
    return Extension(
        name,
        sources=sorted(path.as_posix() for path in folder.glob("*.cpp")),
        depends=sorted(path.as_posix() for path in headers),
        include_dirs=[FORMATS.as_posix()],
        extra_compile_args=list(flags),
        define_macros=[("Py_LIMITED_API", "0x030B0000")],
        py_limited_api=True,
        language="c++",
    )


setup(
    ext_modules=[
        native("fhash_formats.native._core", FORMATS),
        native("fhash_codec.native._codec", CODEC),
        native("fhash_codec.native.network._network", NETWORK, flags=NETWORK_FLAGS),
    ],
    cmdclass={"build_ext": BuildNative},
    options={"bdist_wheel": {"py_limited_api": "cp311"}, "build_ext": {"parallel": 3}},
)

"""The native kernels: every C++ source of `fhash_formats.native` in one extension. All else is in pyproject.toml.

The extension is optional. Without a C++17 compiler the build says so and goes on: the package then computes the same bits in numpy, more
slowly.
"""

from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

NATIVE = Path("formats/fhash_formats/native")

# No contraction into fused multiply-adds and no fast-math: a stream must decode to the same bits on every machine. That nothing traps, and
# loops marked as independent, change no bit; without them the compiler does not vectorise the marcher.
GNU_FLAGS = [
    "-O3",
    "-std=c++17",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp-simd",
    "-fvisibility=hidden",
]
MSVC_FLAGS = ["/O2", "/std:c++17", "/fp:precise", "/EHsc"]


class BuildNative(build_ext):
    """`build_ext` with the flags of the compiler that is there."""

    def build_extensions(self) -> None:
        for extension in self.extensions:
            extension.extra_compile_args = (
                MSVC_FLAGS if self.compiler.compiler_type == "msvc" else GNU_FLAGS
            )
        super().build_extensions()


setup(
    ext_modules=[
        Extension(
            "fhash_formats.native._core",
            sources=sorted(path.as_posix() for path in NATIVE.glob("*.cpp")),
            depends=sorted(path.as_posix() for path in NATIVE.glob("*.hpp")),
            define_macros=[("Py_LIMITED_API", "0x030B0000")],
            py_limited_api=True,
            language="c++",
            optional=True,
        )
    ],
    cmdclass={"build_ext": BuildNative},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)

"""The native libraries: C++ of `fhash_formats.native`, `fhash_codec.native`, its `network`.

They are plain shared libraries, without Python's headers: one wheel serves every Python. What cffi
must know of them is taken from their headers, as a module of Python beside each (`DECLARED`). The
rest of the build is described in pyproject.toml. Where the machine has no C++ compiler, that of
the package ziglang is used (build_backend.py); it also compiles for other machines, where
FHASH_TARGET names one by zig's words, such as aarch64-linux-musl (`make wheels`).
"""

import hashlib
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from cffi import FFI
from setuptools import Command, Extension, setup
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
FUSED = Path("fhash_codec/paper/engines/fused")
"""Kernels of CUDA, which are compiled where they run."""
DECLARED = {
    "fhash_formats.native": (FORMATS / "fhash.h", FORMATS / "functions.h"),
    "fhash_codec.native": (CODEC / "codec.h",),
    "fhash_codec.native.network": (NETWORK / "network.h",),
    "fhash_codec.cuda": (Path("fhash_codec/cuda/driver.h"),),
    "fhash_codec.paper.engines.fused": (FUSED / "kernels/records.h",),
}
"""Packages that call C, and the headers from which their module `declarations` is made."""
TARGET = os.environ.get("FHASH_TARGET", "")
"""Machine to compile for, in zig's words; empty for this one."""

# No contraction into fused multiply-adds and no fast-math: a stream must decode to the same bits on
# every machine. That nothing traps, and loops marked as independent, change no bit; without them
# the compiler does not vectorise the marcher. Sources of loops ask for more than -O2 (loops.hpp,
# target.hpp).
GNU_FLAGS = [
    "-O2",
    "-std=c++17",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp-simd",
    "-fvisibility=hidden",
    "-ffunction-sections",
    "-Wno-psabi",  # functions that take vectors are inlined: no call depends on how one passes them
    "-g0",
]
GNU_LINK_FLAGS = ["-Wl,-s", "-pthread"] if TARGET or sys.platform == "linux" else []
"""Debug records and symbol tables would make the libraries five times as large; on Windows they
would lie beside them."""
if "linux" in (TARGET or sys.platform):
    GNU_LINK_FLAGS.append("-Wl,--gc-sections")  # what third_party has and nobody calls
LIBFHASH_FLAGS = (
    (f"-Wl,--version-script={FORMATS / 'exports.map'}", "-Wl,-soname,libfhash.so")
    if "linux" in (TARGET or sys.platform)
    else ("-Wl,-install_name,@rpath/libfhash.so",)
    if "macos" in TARGET or (sys.platform == "darwin" and not TARGET)
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
    ("YYJSON_DISABLE_NON_STANDARD", "1"),
    ("YYJSON_DISABLE_UTILS", "1"),
    ("FHASH_BUILDING", "1"),
]
"""Definitions by which a library exports nothing of third_party, but its own public functions, and
has little of third_party that nobody calls."""
MSVC_FLAGS = ["/O2", "/std:c++17", "/fp:precise", "/EHsc"]


WASM = Path("fhash_codec/views/page/fhash.wasm")
"""The decoder of `fhash view`, and beside it in .json what it was made from (`make wasm`)."""
WASM_FLAGS = [
    "--target=wasm32-wasi",
    "-msimd128",
    "-DFHASH_SMALL",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
    "-Wno-macro-redefined",
    "-flto",
    "-g0",
]
WASM_SMALL = [
    ("HUF_FORCE_DECOMPRESS_X1", "1"),
    ("ZSTD_FORCE_DECOMPRESS_SEQUENCES_SHORT", "1"),
    ("YYJSON_DISABLE_FAST_FP_CONV", "1"),
    ("yyjson_inline", "inline"),
]
"""Definitions by which third_party has one way of each thing instead of several."""
WASM_CPP_FLAGS = ["-fno-threadsafe-statics", "-std=c++17", "-fno-exceptions", "-fno-rtti"]
WASM_LINK_FLAGS = [
    "-mexec-model=reactor",
    "-Wl,-s,--gc-sections,--stack-first,--lto-O2,-z,stack-size=1048576",
]
WASM_LEFT_OUT = {
    *("fhash_open_path", "fhash_tile_encode", "fhash_tile_bound"),
    *("fhash_tile_code", "fhash_tile_free"),
}
"""Functions that a page has no use for: there are no paths, and nothing is encoded."""


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


def declarations(headers: tuple[Path, ...]) -> str:
    """What cffi reads of headers: C without a preprocessor, but for numbers.

    A function that is not exported becomes a type of its name: `fhash_function` has its address.
    """
    text = "".join(header.read_text("utf-8") for header in headers)
    text = re.sub(r"#ifdef __cplusplus\n.*?#endif\n", "", text, flags=re.DOTALL)
    text = re.sub(r"^#(?!define \w+ +\d).*\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(?=\w+ fhash_\w+\()", "typedef ", text, flags=re.MULTILINE)
    return re.sub(r"^FHASH_(API|EXPORT) ", "", text, flags=re.MULTILINE)


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
        for package, headers in DECLARED.items():
            path = Path(self.get_ext_fullpath(f"{package}.declarations")).with_suffix(".py")
            ffi = FFI()
            ffi.set_source(f"{package}.declarations", None)
            ffi.cdef(declarations(headers))
            path.parent.mkdir(parents=True, exist_ok=True)
            ffi.emit_python_code(str(path))

    def build_extensions(self) -> None:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            if self.compiler.compiler_type != "msvc":  # that one initialises itself on the way
                self._compile_in(pool)
            self._build_extensions()
        if self.compiler.compiler_type != "msvc" and "CXX" not in os.environ:
            self._keep_sizes()  # of the usual compiler

    def _compile_in(self, pool: ThreadPoolExecutor) -> None:
        compile_some = self.compiler.compile
        self.objects = []

        def compile_one(source: str, extra_postargs: list[str], **options: Any) -> list[str]:
            if source.endswith(".c"):  # of others: C, and its warnings are theirs
                own = [flag for flag in extra_postargs if not flag.startswith("-std=")]
                # Documents are small: -O1 is compiled in half of the time.
                extra_postargs = [*own, "-w", *(["-O1"] if "yyjson" in source else [])]
            return list(compile_some([source], extra_postargs=extra_postargs, **options))

        def compile_each(sources: list[str], **options: Any) -> list[str]:
            jobs = [pool.submit(compile_one, source, **options) for source in sources]
            made = [path for job in jobs for path in job.result()]
            self.objects += made
            return made

        self.compiler.compile = compile_each

    def _build_extensions(self) -> None:
        named = getattr(self.compiler, "compiler_cxx", None) or ["cl.exe"]
        try:
            self._build_with_flags()
        except (CCompilerError, BaseError) as error:
            raise CompileError(
                f"fhash needs a C++17 compiler, and '{named[0]}' did not build it: {error}"
            ) from error

    def _keep_sizes(self) -> None:
        """Write the bytes of each object to build/objects.json: a test holds them to a limit, since
        the time of a compiler is that of the code that it makes."""
        kept = Path("build/objects.json")
        kept.parent.mkdir(exist_ok=True)
        sizes = json.loads(kept.read_text("utf-8")) if kept.exists() else {}
        # An extension whose sources are unchanged was not compiled, and has its sizes from before.
        sizes |= {Path(path).name: os.path.getsize(path) for path in self.objects}
        kept.write_text(json.dumps(sizes, indent=1), "utf-8")

    def _build_with_flags(self) -> None:
        for extension in self.extensions:
            msvc = self.compiler.compiler_type == "msvc"
            own, links = extension.extra_compile_args, extension.extra_link_args
            extension.extra_compile_args = MSVC_FLAGS if msvc else [*GNU_FLAGS, *own]
            extension.extra_link_args = [] if msvc else [*GNU_LINK_FLAGS, *links]
        super().build_extensions()


class CompileTimes(BuildNative):
    """`compile_times`: the CPU seconds of each unit, one after the other."""

    description = "print the CPU seconds of each source"

    def finalize_options(self) -> None:
        self.build_lib, self.build_temp = "build/times/lib", "build/times/temp"
        self.force, self.parallel = True, None
        super().finalize_options()

    def build_extensions(self) -> None:
        seconds: dict[str, float] = {}
        with ThreadPoolExecutor(1) as pool:
            self._compile_in(pool)
            compile_each = self.compiler.compile

            def timed(sources: list[str], **options: Any) -> list[str]:
                made = []
                for source in sources:
                    before = sum(os.times()[2:4])
                    made += compile_each([source], **options)
                    seconds[source] = sum(os.times()[2:4]) - before
                return made

            self.compiler.compile = timed
            self._build_extensions()
        for source, taken in sorted(seconds.items(), key=lambda row: row[1], reverse=True):
            print(f"{taken:7.2f}  {source}")
        print(f"{sum(seconds.values()):7.2f}  CPU s in all")


class PlainWheel(bdist_wheel):
    """A wheel for every Python 3 of a platform."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


class BuildWasm(Command):
    """`wasm`: the functions of fhash.h for browsers, by Clang 14 and the libraries of wasi."""

    description = "compile the decoder of the page of `fhash view`"
    user_options: ClassVar[list[tuple[str, str | None, str]]] = []

    def initialize_options(self) -> None:
        """Nothing can be chosen."""

    def finalize_options(self) -> None:
        """Nothing can be chosen."""

    def run(self) -> None:
        build = Path("build/wasm")
        build.mkdir(parents=True, exist_ok=True)
        every = sorted([*FORMATS.rglob("*.cpp"), *FORMATS.rglob("*.c")])
        others = (
            "hdf5_filter.cpp",
            "functions.cpp",
            *(path.name for path in FORMATS.glob("files/*.cpp")),
        )
        sources = [source for source in every if source.name not in others]
        # files.cpp includes those of files.
        included = [*FORMATS.rglob("*.h*"), *FORMATS.glob("files/*.cpp"), Path(__file__)]
        headers = max(path.stat().st_mtime for path in included)

        def compiled(source: Path) -> Path:
            result = build / f"{source.name}.o"
            if result.exists() and result.stat().st_mtime > max(source.stat().st_mtime, headers):
                return result
            # Most of the time of a first picture goes into compiling: -Os and -O2 were slower.
            kind = ["-Oz"]
            kind += [f"-D{name}={value}" for name, value in [*THIRD_PARTY, *WASM_SMALL]]
            kind += [] if source.suffix == ".c" else WASM_CPP_FLAGS
            clang = "clang-14" if source.suffix == ".c" else "clang++-14"
            self._run(clang, *WASM_FLAGS, *kind, f"-I{FORMATS}", "-c", source, "-o", result)
            return result

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            objects = list(pool.map(compiled, sources))
        declared = re.findall(
            r"FHASH_API [^;(]*?(fhash_\w+)\(", (FORMATS / "fhash.h").read_text("utf-8")
        )
        names = [*sorted({*declared, "fhash_open_page"} - WASM_LEFT_OUT), "malloc", "free"]
        exports = [f"-Wl,--export={name}" for name in names]
        self._run("clang++-14", *WASM_FLAGS, *WASM_LINK_FLAGS, *exports, *objects, "-o", WASM)
        self._run("wasm-opt", "-Oz", "--enable-simd", "--strip-producers", WASM, "-o", WASM)
        arrays = (FORMATS / "prior_bytes.inc").read_text("utf-8")
        priors = []
        for name, numbers in re.findall(r"(\w+)\[\w*\] = \{([^}]*)\}", arrays):
            priors.append(WASM.with_name(f"{name.lower()}.bin"))
            priors[-1].write_bytes(bytes(int(number, 0) for number in re.findall(r"\w+", numbers)))
        read = sorted(
            {*every, *FORMATS.rglob("*.hpp"), *FORMATS.rglob("*.h"), *FORMATS.rglob("*.inc")}
        )
        digests = {
            path.as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in [*read, *priors, WASM]
        }
        WASM.with_suffix(".wasm.json").write_text(json.dumps(digests, indent=1) + "\n", "utf-8")

    def _run(self, *words: str | Path) -> None:
        subprocess.run([str(word) for word in words], check=True)


def native(
    name: str, folder: Path, *, flags: tuple[str, ...] = (), link_flags: tuple[str, ...] = ()
) -> Extension:
    """The library of all C++ sources in a folder, and of the C sources in its `third_party`.

    `flags` and `link_flags` are added to those of every library, where the compiler is GCC or
    Clang.
    """
    headers = {*folder.glob("*.hpp"), *folder.glob("files/*.cpp"), *FORMATS.glob("*.hpp")}
    headers |= {*FORMATS.glob("*.h")}
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
    cmdclass={
        "build_ext": BuildNative,
        "bdist_wheel": PlainWheel,
        "wasm": BuildWasm,
        "compile_times": CompileTimes,
    },
    options={"build_ext": {"parallel": 3}},
)

"""setuptools as the build backend; it asks for `ziglang` where there is no C++ compiler.

pip installs what the hooks name into the environment of the build; setup.py then finds it there.
"""

import os
import shutil

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403  # the hooks that stay as they are


def has_compiler() -> bool:
    """Whether the machine has a C++ compiler; on Windows setuptools finds its own."""
    return bool(os.name == "nt" or os.environ.get("CXX") or any(map(shutil.which, ("c++", "g++"))))


def _compiler() -> list[str]:
    """The requirement of a compiler, unless there is one."""
    return [] if has_compiler() else ["ziglang>=0.15"]


def get_requires_for_build_wheel(config_settings: object = None) -> list[str]:
    """Names the requirements of building a wheel."""
    return build_meta.get_requires_for_build_wheel(config_settings) + _compiler()


def get_requires_for_build_editable(config_settings: object = None) -> list[str]:
    """Names the requirements of building an editable installation."""
    return build_meta.get_requires_for_build_editable(config_settings) + _compiler()

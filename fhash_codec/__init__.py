"""fhash: a codec for time-varying volumes (t, z, y, x).

    import fhash_codec

    fhash_codec.encode("run.h5", "run.fhz", fhash_codec.EncodeConfig(features=("interval:0.5:1",)))
    with fhash_codec.open("run.fhz") as volume:
        frame = volume[42]
        fhash_codec.render(volume).save("view.png")

Names load on first use, so that importing the package is cheap. torch loads only where a network
is trained, or drawn on a GPU.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from fhash_formats.errors import (
    ClusterError,
    DamagedFileError,
    FhashError,
    FhashWarning,
    InputError,
    InterruptedEncodingError,
    MissingDependencyError,
    MissingInputError,
    OutputError,
    OutputExistsError,
    QualityError,
    RegionError,
    TrainingError,
    UnsupportedFileError,
)

if TYPE_CHECKING:
    from fhash_codec.appending.parts import merge
    from fhash_codec.appending.writer import Writer, append
    from fhash_codec.comparison import diff
    from fhash_codec.config import EncodeConfig
    from fhash_codec.dataset import Dataset, open
    from fhash_codec.encoding import encode, encode_dataset
    from fhash_codec.plain import export_plain
    from fhash_codec.rendering import render
    from fhash_codec.rendering.renderer import Renderer
    from fhash_codec.rendering.scenes import Scene
    from fhash_codec.views.pack import pack
    from fhash_codec.views.store import zarr_store
    from fhash_codec.views.unpack import unpack
    from fhash_codec.volume import Volume

_MODULES = {
    "Dataset": "dataset",
    "EncodeConfig": "config",
    "Renderer": "rendering.renderer",
    "Scene": "rendering.scenes",
    "Volume": "volume",
    "Writer": "appending.writer",
    "append": "appending.writer",
    "diff": "comparison",
    "encode": "encoding",
    "encode_dataset": "encoding",
    "export_plain": "plain",
    "merge": "appending.parts",
    "open": "dataset",
    "pack": "views.pack",
    "render": "rendering",
    "unpack": "views.unpack",
    "zarr_store": "views.store",
}
"""Public names that load on first use, with their modules in this package."""

__all__ = [
    "ClusterError",
    "DamagedFileError",
    "Dataset",
    "EncodeConfig",
    "FhashError",
    "FhashWarning",
    "InputError",
    "InterruptedEncodingError",
    "MissingDependencyError",
    "MissingInputError",
    "OutputError",
    "OutputExistsError",
    "QualityError",
    "RegionError",
    "Renderer",
    "Scene",
    "TrainingError",
    "UnsupportedFileError",
    "Volume",
    "Writer",
    "append",
    "diff",
    "encode",
    "encode_dataset",
    "export_plain",
    "merge",
    "open",
    "pack",
    "render",
    "unpack",
    "zarr_store",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("fhash")
    if name not in _MODULES:
        raise AttributeError(f"module 'fhash_codec' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"fhash_codec.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

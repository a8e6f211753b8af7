"""A volume with one or some of the features of its file, as if the others were not there.

A file of the profile paper with several features keeps the occupancy of each. Decoding and drawing
take what `Volume` says is in the coreset, and so leave out, and skip, all the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.paper.model import PaperModel
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import Container, Place
from fhash_formats.errors import InputError

__all__ = ["FeatureVolume", "feature_names", "holds_features_apart", "only_features"]


class FeatureVolume(Volume):
    """A `Volume` whose coreset is that of some features of the file.

    Attributes:
        numbers: of these features among those of the file, counted from 0.
    """

    def __init__(
        self, container: Container, numbers: Sequence[int], *, fill: int | float | None = None
    ) -> None:
        """Read from an open container; `only_features` gives the numbers."""
        super().__init__(container, fill=fill)
        self.numbers = tuple(numbers)

    def _occupied(self, key: float, region: Box) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the features' coreset at a key index; region in vertices of the box."""
        assert isinstance(self._model, PaperModel), "only_features refuses other profiles"
        first, last = int(np.floor(key)), int(np.ceil(key))
        return self._model.occupied_by(self.numbers, first, last, region)

    def __reduce__(self) -> tuple[Any, tuple[Place]]:
        again = partial(_reopen, self.numbers, self.variable, self._asked_fill)
        return again, (self.container.reopening(),)


def only_features(volume: Volume, features: Sequence[str]) -> Volume:
    """The volume with some features of its file alone.

    It shares the open container, so that closing either closes both. A volume whose file has these
    features and no others comes back as it is.

    Args:
        volume: an open container.
        features: as the file names them; "segmentation" stands for the one with a threshold.

    Raises InputError for a feature that the file does not name, and for a file that keeps its
    features merged.
    """
    numbers = _numbers(volume, features)
    if set(numbers) == set(range(len(_names(volume)))):
        return volume
    if not holds_features_apart(volume):
        raise InputError(
            f"{volume.path}: its features are merged, none can be taken alone; "
            "encode with --profile paper, which keeps several features apart"
        )
    return FeatureVolume(volume.container, numbers, fill=volume._asked_fill)


def holds_features_apart(volume: Volume) -> bool:
    """Whether a file keeps the occupancy of each of its features."""
    return isinstance(volume._model, PaperModel)


def _numbers(volume: Volume, features: Sequence[str]) -> tuple[int, ...]:
    """The numbers of features among those of a file, ascending and each once; errors as above."""
    names = _names(volume)
    found = set()
    for text in features:
        equal = [
            number
            for number, name in enumerate(names)
            if name == text or (text == "segmentation" and name.startswith("segmentation:"))
        ]
        if not equal:
            raise InputError(
                f"{volume.path}: '{text[:80]}' is none of its features: {', '.join(names)[:400]}"
            )
        found.update(equal)
    return tuple(sorted(found))


def feature_names(volume: Volume) -> list[str]:
    """The features that a volume shows, as its file names them: all, or those chosen."""
    names = _names(volume)
    if isinstance(volume, FeatureVolume):
        return [names[number] for number in volume.numbers]
    return names


def _names(volume: Volume) -> list[str]:
    """The features of a file, as it names them."""
    return [str(name) for name in volume.container.header["features"]]


def _reopen(
    numbers: Sequence[int], variable: str | None, fill: int | float | None, path: Place
) -> Volume:
    """A volume of some features of the file at a place."""
    container = open_volume(path, variable=variable, fill=fill).container
    return FeatureVolume(container, numbers, fill=fill)

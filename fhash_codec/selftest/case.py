"""What a hard case is, and what is found of it: the interface between the catalogue, the properties and the runner."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.volume import Volume
from fhash_formats.series import Series

__all__ = ["Case", "Check", "Finding", "Run"]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A property of a case, measured: it holds where `worst` is at most `limit`; what is not a number does not.

    name: of the property. unit: of both figures, such as 'values', 'of the bound', 'of the range', 'dB'. under: settings or engine.
    """

    name: str
    worst: float
    limit: float
    unit: str
    under: str = ""

    @property
    def holds(self) -> bool:
        """Whether the figure keeps to its limit."""
        return bool(self.worst <= self.limit)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A case encoded with one of its settings.

    values: of the source (t, z, y, x), as they were given. under: name of the settings. path: of the container; `folder` is for more
    files. volume: the container, open.
    """

    case: Case
    series: Series
    values: npt.NDArray[np.generic]
    under: str
    config: EncodeConfig
    folder: Path
    path: Path
    volume: Volume


Check = Callable[[Run], Iterable[Finding]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One hard case.

    Attributes:
        name: short, in lower case with hyphens, unique. group: values, shapes, fronts, features, times, networks, rays.
        about: one line, what is hard and what must hold.
        make: the series, small (some 10,000 values), the same on every call. It may have no NaN-free value at all.
        settings: by name, each encoded and checked.
        checks: beyond those that every run has to pass.
        quick: in the quick set, which takes less than three minutes as a whole.
        refused: where the encoding must be refused with InputError, a part of its message.
    """

    name: str
    group: str
    about: str
    make: Callable[[], Series]
    settings: Mapping[str, EncodeConfig]
    checks: tuple[Check, ...] = ()
    quick: bool = True
    refused: str | None = None

"""What a hard case is, and what is found of it: the interface between the catalogue, the properties and the runner."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.volume import Volume
from fhash_formats.series import Series

__all__ = ["RUN_THREADS", "Case", "Check", "Finding", "Run"]

RUN_THREADS = 4
"""Threads by which every case is encoded; other numbers of them are compared with it."""


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
    files. volume: the container, open. thorough: in the long set, where a check may take its time.
    """

    case: Case
    series: Series
    values: npt.NDArray[np.generic]
    under: str
    config: EncodeConfig
    folder: Path
    path: Path
    volume: Volume
    thorough: bool = False

    @cached_property
    def decoded(self) -> npt.NDArray[Any]:
        """The whole volume (t, z, y, x) as it decodes, NaN outside the coreset."""
        return self.volume[...]

    @property
    def data_range(self) -> float:
        """Of the finite values, in data units, as the codec has it; infinite where it overflows."""
        return self.volume.value_range.high - self.volume.value_range.low


Check = Callable[[Run], Iterable[Finding]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One hard case.

    Attributes:
        name: short, in lower case with hyphens, unique. group: values, shapes, fronts, features, times, networks, rays.
        about: one line, what is hard and what must hold.
        make: the series, small (some 10,000 values), the same on every call. It may have no NaN-free value at all.
        settings: by name, each encoded and checked. more: those of the long set.
        checks: beyond those that every run has to pass.
        quick: in the quick set, which takes less than three minutes as a whole.
        refused: where the encoding must be refused with InputError, or end with QualityError, a part of the message.
    """

    name: str
    group: str
    about: str
    make: Callable[[], Series]
    settings: Mapping[str, EncodeConfig]
    more: Mapping[str, EncodeConfig] = field(default_factory=dict)
    checks: tuple[Check, ...] = ()
    quick: bool = True
    refused: str | None = None

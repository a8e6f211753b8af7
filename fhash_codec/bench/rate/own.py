"""fhash's own profiles in `fhash bench rate`, through public functions; each encoding has its
file."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from contextlib import suppress
from math import prod
from pathlib import Path
from typing import Any

import fhash_codec
from fhash_codec.bench.rate.clock import Spent, spent
from fhash_codec.bench.rate.search import Trial, trial_of
from fhash_codec.boxes import Box
from fhash_codec.config import EncodeConfig
from fhash_codec.measure.errors import Errors
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import QualityError
from fhash_formats.series import Series

PROFILES: tuple[str, ...] = EncodeConfig.__dataclass_fields__["profile"].metadata["choices"]
"""Every profile there is."""


def promised(settings: Mapping[str, Any], profile: str, goal: str, asked: float) -> EncodeConfig:
    """Settings of a profile that promise a quality.

    Settings that belong to other profiles are left out. The paper profile is not steered by
    quality: its settings are the same for every goal.

    Args:
        settings: settings by name.
        profile: name of the profile.
        goal: `psnr` (dB) or `bound` (largest error as a share of the range).
        asked: the quality.
    """
    others = {
        field.name
        for field in dataclasses.fields(EncodeConfig)
        if field.metadata["profile"] not in ("", profile)
    }
    promise = {} if profile == "paper" else {"psnr" if goal == "psnr" else "max_error_rel": asked}
    own = {name: value for name, value in settings.items() if name not in others}
    return EncodeConfig.from_dict(own | {"profile": profile} | promise)


class Own:
    """Encodings of one series, each made once, and their figures.

    Attributes:
        times: of each encoding so far, by its settings.
    """

    def __init__(self, series: Series, data_range: float, folder: Path) -> None:
        """Prepare encodings of a series.

        data_range: range of the series. folder: place of the files, which the caller removes.
        """
        self._series = series
        self._range = data_range
        self._folder = folder
        self._paths: dict[EncodeConfig, Path] = {}
        self._trials: dict[EncodeConfig, Trial] = {}
        self.times: dict[EncodeConfig, list[Spent]] = {}

    def encode(self, config: EncodeConfig) -> None:
        """Encode once more, and keep how long it took."""
        path = self._paths.setdefault(config, self._folder / f"{len(self._paths)}.fhz")

        def encode() -> None:
            with suppress(QualityError):  # the file is written, and what it reaches is measured
                fhash_codec.encode(self._series, path, config, force=True)

        self.times.setdefault(config, []).append(spent(encode))

    def has_one_tile(self, config: EncodeConfig) -> bool:
        """Whether the file with these settings, of the profile compact, has a single tile."""
        with open_volume(self._paths[config]) as volume:
            table = volume.container.arrays["tables/level_1"]
            return prod(table.grid) == 1

    def trial(self, config: EncodeConfig) -> Trial:
        """Figures of the file with these settings, from every decoded frame."""
        if config not in self._trials:
            self.encode(config)
            errors = Errors(self._range)
            with open_volume(self._paths[config]) as volume:
                for step in range(volume.shape[0]):
                    errors.add(step, self._series.read(step), volume.read(step))
            self._trials[config] = trial_of(errors, 0.0, self._paths[config].stat().st_size)
        return self._trials[config]

    def decode(self, config: EncodeConfig) -> Spent:
        """Open the file and decode every frame; what it took."""

        def decode() -> None:
            with open_volume(self._paths[config]) as volume:
                for step in range(volume.shape[0]):
                    volume.read(step)

        return spent(decode)

    def read_region(self, config: EncodeConfig, step: int, region: Box) -> tuple[int, float]:
        """Open the file and read a region of one step; bytes read of the file, and seconds."""
        begun = time.perf_counter()
        with open_volume(self._paths[config]) as volume:
            volume.read(step, region)
            count = volume.container.bytes_read
        return count, time.perf_counter() - begun

"""Figures of `fhash bench ablate`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

from fhash_formats.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Run:
    """Figures of one encoding; those of a quality are of the file as it decodes, over all steps.

    Attributes:
        axis: name of the axis.
        settings: what is varied.
        reference: whether the axis's others are compared with it.
        seed: seed of the random choices.
        seconds: time of the whole encoding.
        training_seconds: time of the training; None in the profile compact.
        epochs: epochs of the training, 0 without one.
        bytes: size of the file.
        parameters: numbers of the model.
        points_per_second: points that are evaluated in a second of processors.
        psnr: dB in the coreset; None where the error is 0.
        psnr_domain: dB over all finite vertices.
        max_abs_error: largest error in the coreset, in data units.
        curve: {epoch, seconds, psnr} of the training.
    """

    axis: str
    settings: dict[str, Any]
    reference: bool
    seed: int
    seconds: float
    training_seconds: float | None
    epochs: int
    bytes: int
    parameters: int
    points_per_second: float
    psnr: float | None
    psnr_domain: float | None
    max_abs_error: float | None
    curve: tuple[dict[str, Any], ...] = ()

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Run:
        """The record that `asdict` gave. Raises InputError for other values."""
        try:
            settings = {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in values["settings"].items()
            }
            return cls(**{**values, "settings": settings, "curve": tuple(values["curve"])})
        except (AttributeError, KeyError, TypeError) as error:
            raise InputError(f"not a run of bench ablate: {error}") from error


@dataclass(frozen=True, kw_only=True)
class Row:
    """One variation over all seeds: medians, and the spread of the PSNR.

    Attributes:
        axis, settings: as in `Run`.
        seconds, training_seconds, bytes, parameters, points_per_second, psnr, psnr_domain,
            max_abs_error: medians.
        psnr_spread: largest less smallest PSNR of the seeds; None for one seed.
        seconds_ratio, bytes_ratio: over those of the axis's reference.
        psnr_gain: dB over the axis's reference.
    """

    axis: str
    settings: dict[str, Any]
    seconds: float
    training_seconds: float | None
    bytes: int
    parameters: int
    points_per_second: float
    psnr: float | None
    psnr_domain: float | None
    max_abs_error: float | None
    psnr_spread: float | None
    seconds_ratio: float | None
    bytes_ratio: float | None
    psnr_gain: float | None


@dataclass(frozen=True, kw_only=True)
class AblateBench:
    """Figures of all axes.

    Attributes:
        series: name of the series; `shape` (t, z, y, x) and `features` are what was encoded.
        common: settings of all encodings of a profile.
        runs: all encodings.
        left_out: a line for each variation that was not measured, with the reason.
        machine: what the encodings ran on.
    """

    series: str
    shape: tuple[int, ...]
    features: tuple[str, ...]
    common: dict[str, dict[str, Any]]
    runs: tuple[Run, ...]
    left_out: tuple[str, ...]
    machine: dict[str, Any] = field(default_factory=dict)

    @property
    def rows(self) -> list[Row]:
        """The variations in their order, each beside the reference of its axis."""
        groups: dict[tuple[str, str], list[Run]] = {}
        for run in self.runs:
            groups.setdefault((run.axis, str(run.settings)), []).append(run)
        references = {axis: runs for (axis, _), runs in groups.items() if runs[0].reference}
        return [_row(runs, references.get(axis)) for (axis, _), runs in groups.items()]

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "series": self.series,
            "shape": list(self.shape),
            "features": list(self.features),
            "common": self.common,
            "rows": [asdict(row) for row in self.rows],
            "runs": [asdict(run) for run in self.runs],
            "left_out": list(self.left_out),
            "machine": self.machine,
        }


def _row(runs: list[Run], reference: list[Run] | None) -> Row:
    """The row of a variation's runs, beside those of the reference if it was measured."""
    psnrs = [run.psnr for run in runs]
    known = [value for value in psnrs if value is not None]
    psnr, seconds = _median(psnrs), median(run.seconds for run in runs)
    size = median(run.bytes for run in runs)
    seconds_ratio = bytes_ratio = psnr_gain = None
    if reference is not None:
        seconds_ratio = seconds / median(run.seconds for run in reference)
        bytes_ratio = size / median(run.bytes for run in reference)
        expected = _median([run.psnr for run in reference])
        psnr_gain = None if psnr is None or expected is None else psnr - expected
    return Row(
        axis=runs[0].axis,
        settings=runs[0].settings,
        seconds=seconds,
        training_seconds=_median([run.training_seconds for run in runs]),
        bytes=round(size),
        parameters=round(median(run.parameters for run in runs)),
        points_per_second=median(run.points_per_second for run in runs),
        psnr=psnr,
        psnr_domain=_median([run.psnr_domain for run in runs]),
        max_abs_error=_median([run.max_abs_error for run in runs]),
        psnr_spread=max(known) - min(known) if len(known) > 1 else None,
        seconds_ratio=seconds_ratio,
        bytes_ratio=bytes_ratio,
        psnr_gain=psnr_gain,
    )


def _median(values: list[float | None]) -> float | None:
    """The median of some numbers; None if one of them is unknown."""
    known = [value for value in values if value is not None]
    return median(known) if known and len(known) == len(values) else None

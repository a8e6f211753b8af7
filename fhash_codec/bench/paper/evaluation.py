"""Figures of a trained encoding beside its curve: between key frames, and latency of pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.paper.latency import measure_latency
from fhash_codec.coreset.features import Feature
from fhash_codec.measure.errors import Errors
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.task.torch_arrays import TorchArrays
from fhash_codec.training.devices import choose_device

__all__ = ["Sampled", "between_key_frames", "evaluate"]

Frame = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Places = npt.NDArray[np.int64]
SampleAt = Callable[[float, Places], npt.NDArray[np.float64]]
"""Time in key frames and vertices (n, 3), z, y, x -> normalised values (n,)."""

MAX_STEPS = 40
"""Steps that are looked at, at most: of a longer series as many, evenly spread."""


class Sampled(Protocol):
    """An encoding that is sampled at any time; see `encodings.encoding.Encoding`."""

    def settle(self) -> None:
        """Finish work that training put off."""

    def sample(self, key: float, places: Any) -> Any:
        """Values (n,) at places (n, 3) of a time in key frames."""


class Sampling(Protocol):
    """The data of a cell, as far as they matter here; see `data.Data`."""

    @property
    def series(self) -> Any:
        """The series with all its steps."""

    @property
    def scanned(self) -> Any:
        """The range of the series."""

    @property
    def features(self) -> tuple[Feature, ...]:
        """The features, resolved."""

    @property
    def key_frames(self) -> tuple[int, ...]:
        """Steps of the key frames."""

    @property
    def frames(self) -> Sequence[Frame]:
        """Normalised frames (z, y, x) at the key frames."""

    @property
    def masks(self) -> Sequence[Mask]:
        """The coreset of each key frame, (z, y, x) of the domain."""


def evaluate(
    encoding: Any,
    data: Sampling,
    *,
    device: str = "cpu",
    latency: bool = True,
    between: bool = True,
    size: int | None = None,
    progress: Progress = silent,
) -> dict[str, dict[str, Any] | None]:
    """Measure a trained encoding; its results are the fields of these names of a `Cell`.

    Args:
        encoding: trained; it is settled here.
        data: what it was trained on.
        device: of the encoding, cpu or cuda.
        latency: whether to draw pictures through the encoding.
        between: whether to look at steps between key frames.
        size: pixels along both sides of those pictures; that of `measure_latency` if None.
        progress: is told about steps and pictures.

    Returns:
        {"latency": as of `measure_latency`, "between": as of `between_key_frames`}, None for what
        is not asked for.
    """
    encoding.settle()
    value_range = (data.scanned.value_range.low, data.scanned.value_range.high)
    pictures = {} if size is None else {"size": size}
    return {
        "latency": measure_latency(
            encoding,
            data.masks,
            str(data.features[0]),
            value_range=value_range,
            device=device,
            progress=progress,
            **pictures,
        )
        if latency
        else None,
        "between": between_key_frames(_sampler(encoding, device), data, progress=progress)
        if between
        else None,
    }


def between_key_frames(
    sample: SampleAt, data: Sampling, *, steps: int = MAX_STEPS, progress: Progress = silent
) -> dict[str, Any]:
    """Compare an encoding with the series at and between key frames.

    A step counts at the vertices in the coreset of the key frame before or after it. PSNR are of
    normalised values, in dB, None where nothing differs or nothing was compared.

    Args:
        sample: the encoding.
        data: what it was trained on; steps are read from its series.
        steps: steps to look at, at most.
        progress: is told about each step.

    Returns:
        - "psnr": at all steps.
        - "psnr_key_frames": at the key frames.
        - "psnr_between": at the other steps.
        - "linear_psnr": there, of the true key frames interpolated linearly in time.
        - "fringe_psnr", "fringe_linear_psnr": there, at vertices in the coreset of one of the two.
        - "fringe_share": of the vertices that count there.
        - "missed_share": of the vertices of the steps' own features, those that do not count.
        - "worst_psnr", "worst_step": the step with the largest error.
        - "steps": the number of steps looked at.
    """
    last, keys = data.series.shape[0] - 1, np.array(data.key_frames)
    looked = sorted(
        {*np.linspace(0, last, min(steps, last + 1)).round().astype(int).tolist(), *keys.tolist()}
    )
    sums = _Sums()
    for number, step in enumerate(looked):
        sums.add(step, sample, data)
        progress("between key frames", number + 1, len(looked), "")
    return {**sums.figures(), "steps": len(looked)}


class _Sums:
    """Errors of some steps, by what they are compared over."""

    def __init__(self) -> None:
        names = ("all", "keys", "between", "linear", "fringe", "fringe_linear")
        self._errors = {name: Errors(1.0) for name in names}
        self._selected = self._missed = 0

    def add(self, step: int, sample: SampleAt, data: Sampling) -> None:
        """Compare one step."""
        value_range: ValueRange = data.scanned.value_range
        frame = data.series.read(step)
        truth = np.asarray(value_range.to_unit(frame), dtype=np.float32)
        time = float(np.interp(step, data.key_frames, np.arange(len(data.key_frames))))
        before = int(time)
        after = before if time == before else before + 1
        counted = (data.masks[before] | data.masks[after]) & np.isfinite(truth)
        feature = np.logical_or.reduce([each.select(frame, step) for each in data.features])
        self._selected += int(feature.sum())
        self._missed += int((feature & ~counted).sum())
        decoded = truth.astype(np.float64)
        decoded[counted] = sample(time, np.argwhere(counted))
        self._errors["all"].add(step, truth, decoded, counted)
        if time == before and step in data.key_frames:
            self._errors["keys"].add(step, truth, decoded, counted)
            return
        self._errors["between"].add(step, truth, decoded, counted)
        linear = (1 - time + before) * data.frames[before].astype(np.float64)
        linear += (time - before) * data.frames[after]
        known = counted & np.isfinite(linear)
        self._errors["linear"].add(step, truth, linear, known)
        fringe = known & (data.masks[before] ^ data.masks[after])
        self._errors["fringe"].add(step, truth, decoded, fringe)
        self._errors["fringe_linear"].add(step, truth, linear, fringe)

    def figures(self) -> dict[str, Any]:
        """The figures of all steps added."""
        errors = self._errors
        between = max(errors["between"].count, 1)
        worst = min(
            ((step.psnr, step.step) for step in errors["all"].steps if step.psnr is not None),
            default=(None, None),
        )
        return {
            "psnr": errors["all"].psnr,
            "psnr_key_frames": errors["keys"].psnr,
            "psnr_between": errors["between"].psnr,
            "linear_psnr": errors["linear"].psnr,
            "fringe_psnr": errors["fringe"].psnr,
            "fringe_linear_psnr": errors["fringe_linear"].psnr,
            "fringe_share": errors["fringe"].count / between,
            "missed_share": self._missed / max(self._selected, 1),
            "worst_psnr": worst[0],
            "worst_step": worst[1],
        }


def _sampler(encoding: Sampled, device: str) -> SampleAt:
    """A function that samples an encoding at vertices, with arrays of numpy."""
    arrays = TorchArrays(choose_device(device))

    def sample(time: float, places: Places) -> npt.NDArray[np.float64]:
        """Values (n,) at vertices (n, 3)."""
        values = encoding.sample(time, arrays.array(places.astype(np.float32)))
        return np.asarray(arrays.host(values.detach()), dtype=np.float64)

    return sample

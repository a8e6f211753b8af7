"""Any series under any settings keeps its promise, or is refused in one line.

The promise is checked on the decoded values, independently of the encoder.
"""

from __future__ import annotations

import math
import os
import tempfile
import warnings
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import example, given
from hypothesis import strategies as st
from properties import FLOATS, INTEGERS, Draw, looking, one_line, same

import fhash_codec
from fhash_codec import EncodeConfig, FhashWarning
from fhash_formats.container import Container
from fhash_formats.errors import FhashError, QualityError

pytestmark = pytest.mark.hard

DTYPES = (*FLOATS, *INTEGERS, "int64", "uint64")  # those of 64 bits twice: floats have not all
Shape = tuple[int, int, int, int]


def waves(chance: np.random.Generator, shape: Shape) -> np.ndarray:
    """Return the sum of three plane waves."""
    places = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return sum(np.sin(sum(chance.normal(0, 6) * place for place in places)) for _ in range(3))


def front(chance: np.random.Generator, shape: Shape) -> np.ndarray:
    """Return a step that moves 0.3 vertices along x per time step."""
    t, x = np.arange(shape[0])[:, None, None, None], np.arange(shape[3])
    return np.broadcast_to(
        np.where(x > chance.uniform(0, shape[3]) + 0.3 * t, 1.0, 0.0), shape
    ).copy()


def spikes(chance: np.random.Generator, shape: Shape) -> np.ndarray:
    """Return zeros with a few random vertices."""
    return np.where(chance.random(shape) < 0.02, chance.normal(0, 1, shape), 0.0)


KINDS = {
    "waves": waves,
    "noise": lambda chance, shape: chance.normal(0, 1, shape),
    "front": front,
    "spikes": spikes,
    "constant": lambda chance, shape: np.full(shape, chance.normal()),
    "heavy tails": lambda chance, shape: chance.standard_cauchy(shape),
    "in time alone": lambda chance, shape: np.broadcast_to(
        chance.normal(0, 1, (shape[0], 1, 1, 1)), shape
    ).copy(),
    "waves and noise": lambda chance, shape: (
        waves(chance, shape) + 0.01 * chance.normal(0, 1, shape)
    ),
}


@st.composite
def fields(draw: Draw) -> np.ndarray:
    """Draw a series (t, z, y, x): its structure, type, magnitude and offset; floats also with
    holes."""
    shape = tuple(draw(st.integers(1, most)) for most in (6, 9, 12, 17))
    chance = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    values = KINDS[draw(st.sampled_from(sorted(KINDS)))](chance, shape)
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    if dtype.kind != "f":
        limits = np.iinfo(dtype)
        values = values - values.min()
        share = values / (values.max() or 1.0)
        most = int(limits.max) - int(limits.min)
        width = draw(st.sampled_from([most - most // 1024, 3 * most // 10, most // 100, 998]))
        width = min(width, most)
        base = draw(st.sampled_from([int(limits.min), int(limits.max) - width, -(width // 2), 0]))
        base = max(base, int(limits.min))
        # Modulo 2^64, so that nothing is rounded once the steps are whole numbers.
        steps = np.minimum(np.rint(share * width), float(width)).astype(np.uint64)
        return (steps + np.uint64(base % 2**64)).astype(dtype)
    power = draw(st.integers(-4, 3) if dtype.itemsize == 2 else st.integers(-30, 30))
    offset = draw(st.sampled_from([0.0, 0.0, 1.0, -1e3]))
    with np.errstate(over="ignore"):  # values beyond float16 become infinite
        values = ((values + offset) * 10.0**power).astype(dtype)
    holes = draw(st.sampled_from([0.0, 0.0, 0.01, 0.5]))
    values[chance.random(shape) < holes] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    return values


@st.composite
def settings(draw: Draw, values: np.ndarray) -> EncodeConfig:
    """Draw settings that do not contradict each other, with features and bounds on the scale of the
    values."""
    finite = values[np.isfinite(values)].astype(np.float64)
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    common: dict[str, Any] = {
        "seed": draw(st.integers(0, 2**63 - 1)),
        "timings": False,
        "dilation": draw(st.integers(0, 2)),
    }
    if draw(st.integers(0, 2)) == 0:
        ends = sorted(low + (high - low) * draw(st.floats(-0.2, 1.2)) for _ in range(2))
        common["features"] = (
            draw(
                st.sampled_from(
                    [f"interval:{ends[0]!r}:{ends[1]!r}", f"isosurface:{ends[0]!r}", "segmentation"]
                )
            ),
        )
    if draw(st.integers(0, 3)) == 0:
        common["tables"] = draw(st.sampled_from(["float32", "float16", "uint8", "transform"]))
        common["key_frames"] = draw(st.sampled_from(["all", "every:2", "0"]))
        common["fold"] = draw(st.integers(2, 8))
        common["embedding_size"] = draw(st.integers(1, 8))
        common["hidden_layers"] = draw(st.integers(0, 2))
        common["width"] = draw(st.integers(1, 16))
        common["learning_rate"] = draw(st.sampled_from([1e-8, 0.01, 1.0]))
        return EncodeConfig(
            preset="published",
            epochs=draw(st.integers(1, 3)),
            psnr=draw(st.sampled_from([None, None, 20.0])),
            **common,
        )
    promise = draw(
        st.sampled_from(
            [
                {},
                {"psnr": draw(st.floats(0, 120))},
                {"max_error": draw(st.floats(0, 1.5)) * (high - low)},
                {"max_error": 0.0},
                {"max_error_rel": draw(st.floats(0, 1))},
                {"ratio": draw(st.floats(1, 100))},
            ]
        )
    )
    tile = draw(st.sampled_from(["auto", "whole", "2x4x4x4", "1x3x5x9", "3x5x7x9"]))
    return EncodeConfig(effort=draw(st.integers(1, 6)), tile=tile, **promise, **common)


FAR = np.array([[[[2**54 - 1, 2**54 + 3, 2**64 - 1]]]], np.uint64)
"""Integers whose differences float64 has not."""


@st.composite
def tasks(draw: Draw) -> tuple[np.ndarray, EncodeConfig]:
    """Draw a series and settings for it."""
    values = draw(fields())
    return values, draw(settings(values))


@looking(15, 1000)
@given(task=tasks())
@example(task=(np.zeros((1, 1, 1, 1)), EncodeConfig(max_error_rel=0.0)))
@example(task=(FAR, EncodeConfig(features=("interval:0:2e16",), effort=1)))
@example(task=(FAR, EncodeConfig(features=("interval:2e16:2e19",), effort=1)))
@example(
    task=(
        FAR,
        EncodeConfig(features=("interval:0:2e16",), preset="published", tables="float16", epochs=1),
    )
)
def test_any_settings_keep_their_promise_or_are_refused_in_one_line(
    task: tuple[np.ndarray, EncodeConfig],
) -> None:
    values, config = task
    with tempfile.TemporaryDirectory(prefix="fhash-") as folder, warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", FhashWarning)
        path, missed = Path(folder) / "a.fhz", ""
        try:
            figures = fhash_codec.encode(values, path, config)
        except QualityError as error:
            one_line(error)
            figures, missed = error.figures, str(error)
        except FhashError as error:
            one_line(error)
            assert os.listdir(folder) == []
            return
        path = Path(figures["path"])
        assert os.listdir(folder) == ["a.missed.fhz" if missed else "a.fhz"] == [path.name]
        assert figures["bytes"] == path.stat().st_size
        assert figures["raw_bytes"] == values.nbytes
        with Container.open(path) as container:
            container.verify()
        with fhash_codec.open(path) as volume:
            decoded = np.asarray(volume[...])
            assert same(volume.values_of_steps(range(len(values))), decoded)
            read = volume.read_steps(range(len(values)))
            assert same(read, np.where(np.isnan(read), np.nan, decoded).astype(read.dtype))
        shown = zarr.open_group(fhash_codec.zarr_store(path), mode="r")["values"]
        assert same(np.asarray(shown[...]).reshape(decoded.shape), decoded)
        with xarray.open_dataset(path, engine="fhash", mask_and_scale=False) as dataset:
            assert same(dataset["values"].to_numpy().reshape(decoded.shape), decoded)
    check(values, config, decoded, ~np.isnan(read), figures, missed)


def check(
    values: np.ndarray,
    config: EncodeConfig,
    decoded: np.ndarray,
    kept: np.ndarray,
    figures: dict[str, Any],
    missed: str,
) -> None:
    """Compare the promise and the stated figures with the decoded values.

    kept: vertices that have a value; others have NaN, or the fill value of 64-bit integers.
    """
    whole = values.dtype.kind != "f"  # Python's integers have no end
    original = values.astype(object if whole else np.float64)
    finite = np.isfinite(values)
    assert decoded.shape == values.shape
    assert not np.isinf(decoded).any()
    assert not kept[~finite].any()
    if config.key_frames != "all":  # other steps are finite where the key frames beside them are
        pass
    elif config.features == ("all",):
        assert (kept == finite).all()
    elif config.features[0].startswith("interval"):
        ends = [float(end) for end in config.features[0].split(":")[1:]]
        assert kept[finite & (original >= ends[0]) & (original <= ends[1])].all()
    ends = [original[finite].min(), original[finite].max()]
    found = decoded[kept]
    if whole and decoded.dtype.kind == "f":  # the nearest floats of integers
        ends = [float(end) for end in ends]
        assert (found.astype(decoded.dtype) % 1 == 0).all() or config.published
    if not config.published:
        assert ends[0] <= found.min().item()
        assert found.max().item() <= ends[1]
    exact = np.array([Fraction(each) if whole else each for each in found.tolist()])
    errors = np.abs(exact - original[kept])
    span = float(original[finite].max() - original[finite].min())
    largest = errors.max() if whole else float(errors.max())
    squares = float(np.sqrt(np.mean((errors.astype(np.float64) / (span or 1.0)) ** 2)))
    # 64-bit integers in the profile paper are decoded, and compared, as float64
    unit = span * 2.0**-52 if whole and decoded.dtype.kind == "f" and span > 2.0**53 else 0.0
    assert math.isclose(float(largest), figures["max_abs_error"], rel_tol=1e-9, abs_tol=unit), (
        largest,
        figures["max_abs_error"],
    )
    psnr = math.inf if squares == 0 else -20 * math.log10(squares)
    stated = math.inf if figures["rmse"] == 0 else figures["psnr"]
    if span > 0:
        assert stated is not None
        assert psnr == stated or math.isclose(psnr, stated, abs_tol=1e-3), (psnr, stated)
    bound = config.max_error if config.max_error is not None else math.inf
    if config.max_error_rel is not None:
        bound = config.max_error_rel * span
    kept_promises = [largest <= bound]
    promised = promised_psnr(config)
    if promised is not None:  # values without a range have no PSNR, and must be exact
        kept_promises.append(psnr >= promised - 1e-9 if span > 0 else squares == 0)
    if config.ratio is not None:
        kept_promises.append(values.nbytes / figures["bytes"] >= config.ratio)
    # a promise is missed where the encoder says so, and nowhere else
    assert all(kept_promises) == (not missed), (kept_promises, missed)


def promised_psnr(config: EncodeConfig) -> float | None:
    """Return the PSNR over all values that the settings promise, in dB; None without one."""
    others = (config.max_error, config.max_error_rel, config.ratio)
    if config.psnr is None and not config.published and others == (None, None, None):
        return 50.0
    return config.psnr

"""Reads from a file: every kind, with the error of what was read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.allowance import Allowance
from fhash_codec.cost.facts import facts_of
from fhash_codec.cost.own import KeptFile
from fhash_codec.cost.reads import interpolated, measure_reads
from fhash_codec.encoding import encode
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


@pytest.fixture
def file(series: ArraySeries, tmp_path: Path) -> KeptFile:
    """A file that holds the series exactly."""
    path = tmp_path / "a.fhz"
    encode(series, path, EncodeConfig(effort=1, max_error=0.0))
    return KeptFile(name="exact", path=path, psnr=None)


def test_every_kind_is_read_and_compared(series: ArraySeries, file: KeptFile) -> None:
    facts = facts_of(series, silent)
    reads = {
        read.what: read for read in measure_reads(series, [file], facts, Allowance(1000.0), silent)
    }
    sizes = {"open": 0, "frame": 720, "region of 16^3": 720, "line in time": 4}
    assert {name: reads[name].values for name in sizes} == sizes
    for name in ("frame", "region of 16^3", "line in time"):
        assert (reads[name].psnr, reads[name].max_abs_error) == (None, 0.0)
    assert reads["level of detail 1"].values == 3 * 5 * 6
    coarse = [reads[f"level of detail {lod}"].psnr for lod in (1, 2, 3)]
    assert None not in coarse
    assert coarse == sorted(coarse, reverse=True)  # type: ignore[type-var]
    assert reads["open"].bytes_read < reads["frame"].bytes_read


def test_without_time_reads_are_left_out(series: ArraySeries, file: KeptFile) -> None:
    allowance = Allowance(1e-9)
    reads = list(measure_reads(series, [file], facts_of(series, silent), allowance, silent))
    assert len(reads) <= 1
    assert allowance.left_out


def test_interpolation_is_exact_for_linear_values_and_keeps_gaps_small() -> None:
    z, y, x = np.meshgrid(np.arange(5.0), np.arange(7.0), np.arange(9.0), indexing="ij")
    fine = z + 2 * y - x
    places = (range(0, 5, 2), range(0, 7, 2), range(0, 9, 4))
    coarse = fine[::2, ::2, ::4].copy()
    np.testing.assert_allclose(interpolated(coarse, places, fine.shape), fine)
    coarse[0, 0, 0] = np.nan
    gaps = np.isnan(interpolated(coarse, places, fine.shape))
    assert gaps.sum() == 2 * 2 * 4
    assert not gaps[2:].any()

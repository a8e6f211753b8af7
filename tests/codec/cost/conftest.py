"""A report that holds one of everything, and a small series."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.cost.results import (
    DEFAULT,
    CostReport,
    Curve,
    Encoded,
    Gain,
    LeftOut,
    Picture,
    Read,
    Stage,
    advise,
)
from fhash_codec.rendering.march_task import complete
from fhash_formats.series import ArraySeries


@pytest.fixture
def series() -> ArraySeries:
    """A moving wave, (4, 6, 10, 12) float32."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 6, 10, 12)), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    return ArraySeries(values, name="wave", units="K")


@pytest.fixture(scope="session")
def report() -> CostReport:
    """A report with encodings, reads, pictures, and what was left out."""
    point = Encoded(
        name="effort 1, 40 dB", codec="default", group="effort 1",
        options="--effort 1 --psnr 40", seconds=0.5, bytes=1000, ratio=20.0, psnr=40.1,
        psnr_bulk=38.0, max_abs_error=0.1, region_ms=3.0,
    )  # fmt: skip
    usual = replace(
        point, name=DEFAULT, group="effort 5", options="", seconds=2.0, bytes=900, psnr=50.2,
        ratio=12.8, region_ms=7.5,
    )  # fmt: skip
    other = replace(
        point, name="SZ3 <tolerance>", codec="SZ3", group="SZ3", options="", bytes=2000, psnr=51.0,
        region_ms=None,
    )  # fmt: skip
    counters = complete({"rays": 4})
    return CostReport(
        series="a.h5 </script> wave", units="K", dtype="float32", shape=(4, 6, 10, 12),
        measured="the whole series", measured_shape=(4, 6, 10, 12), raw_bytes=11520,
        value_range=(0.0, 1.0), budget_seconds=120.0, seconds=3.0, interrupted=False,
        encodings=(usual, point, other),
        curves=(Curve(name="published network, 2 epochs", points=(
            {"seconds": 1.0, "epoch": 1, "psnr": 20.0},
            {"seconds": 2.0, "epoch": 2, "psnr": None},
        )),),
        stages=(Stage(stage="head", seconds=0.1, times=1, why="effort 5"),),
        gains=(Gain(what="head", bytes=5, seconds=None),),
        per_step=({"step": 0, "psnr": 40.0, "rmse": 0.1, "max_abs_error": 0.2},),
        reads=(Read(file=point.name, file_psnr=40.1, what="frame", values=720, milliseconds=1.5,
                    bytes_read=900, psnr=40.0, max_abs_error=0.1),),
        pictures=(
            Picture(group="effect", setting="nothing named", milliseconds=9.0, counters=counters,
                    psnr=None, ssim=None),
            Picture(group="step length", setting="4", milliseconds=3.0, counters=counters,
                    psnr=30.0, ssim=0.9),
            Picture(group="step length", setting="0.03125", milliseconds=50.0, counters=counters,
                    psnr=None, ssim=1.0, best=True),
            Picture(group="encoding", setting=point.name, milliseconds=9.0, counters=counters,
                    psnr=45.0, ssim=0.99),
        ),
        advice=advise((usual, point, other), 1.0),
        left_out=(LeftOut(what="SPERR", why="not installed"),),
        machine={"cores": 2}, notes=("a note",),
    )  # fmt: skip

"""Seconds to a quality."""

from __future__ import annotations

from fhash_codec.bench.train.curves import CurvePoint, seconds_to


def test_the_first_point_that_reaches_a_quality_counts() -> None:
    curve = [
        CurvePoint(seconds=2.0 * n, cpu_seconds=float(n), epochs=1.0, psnr=psnr)
        for n, psnr in enumerate((20.0, 41.0, 39.0, 45.0))
    ]
    reached = seconds_to(curve, 40.0)
    assert reached is curve[1]
    assert seconds_to(curve, 45.0) is curve[3]
    assert seconds_to(curve, 45.1) is None


def test_an_exact_model_reaches_every_quality() -> None:
    exact = CurvePoint(seconds=1.0, cpu_seconds=1.0, epochs=1.0, psnr=None)
    assert seconds_to([exact], 50.0) is exact

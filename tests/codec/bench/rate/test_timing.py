"""Speed and access: the fastest runs, the same places for every codec."""

from __future__ import annotations

from fhash_codec.bench.rate.clock import Spent
from fhash_codec.bench.rate.search import EXACT, Trial
from fhash_codec.bench.rate.timing import access_of, places, shown_psnr, speed_of
from fhash_codec.boxes import Box

TRIAL = Trial(level=40.0, bytes=1000, psnr=45.0, max_error=0.1)


def test_the_fastest_runs_count() -> None:
    runs = [Spent(wall=2.0, core=4.0), Spent(wall=3.0, core=1.0)]
    speed = speed_of("a", "b", TRIAL, 8_000_000, runs, runs[:1])
    assert (speed.encode_mb_s, speed.encode_core_mb_s) == (4.0, 8.0)
    assert (speed.decode_mb_s, speed.decode_core_mb_s) == (4.0, 2.0)
    assert speed.encode_runs == 2


def test_places_are_the_same_for_all_and_within_the_series() -> None:
    shape = (3, 20, 5, 40)
    assert list(places(shape)) == list(places(shape))
    for step, box in places(shape):
        assert 0 <= step < 3
        assert box.shape == (16, 5, 16)
        assert all(0 <= low < high <= n for (low, high), n in zip(box, shape[1:], strict=True))


def test_access_is_the_median_without_the_first() -> None:
    answers = iter([(10**6, 99.0), (1, 0.001), (3, 0.003), (2, 0.002)])

    def read(step: int, box: Box) -> tuple[int, float]:
        return next(answers)

    access = access_of("a", "b", TRIAL, (3, 20, 5, 40), read, 3)
    assert (access.milliseconds, access.bytes_read) == (2.0, 2)
    assert access.region == (16, 5, 16)


def test_exact_values_have_no_psnr() -> None:
    assert shown_psnr(TRIAL) == 45.0
    assert shown_psnr(Trial(level=0, bytes=1, psnr=EXACT, max_error=0)) is None

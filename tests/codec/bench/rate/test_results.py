"""Results of `fhash bench rate`: ratios to the best peer."""

from __future__ import annotations

from fhash_codec.bench.rate.results import Point, RateBench


def result(points: tuple[Point, ...]) -> RateBench:
    return RateBench(
        series="a",
        shape=(2, 3, 4, 5),
        dtype="float32",
        raw_bytes=480,
        value_range=(0.0, 1.0),
        missing=0,
        points=points,
        speeds=(),
        access=(),
        tiles=(),
        refused={},
        machine={},
        notes=(),
    )


def test_ratios_are_to_the_best_peer_that_reached_it() -> None:
    def point(codec: str, count: int, reached: bool) -> Point:
        return Point(
            codec=codec,
            goal="psnr",
            asked=45.0,
            reached=reached,
            bytes=count,
            psnr=45.0,
            max_error=0.1,
            setting="",
            as_asked=None,
        )

    points = (
        point("SZ3", 300, True),
        point("ZFP", 100, False),
        point("SPERR", 200, True),
        point("fhash compact", 80, True),
    )
    row = {
        "goal": "psnr",
        "asked": 45.0,
        "peer": "SPERR",
        "bytes": 200,
        "ratios": {"fhash compact": 2.5},
    }
    assert result(points).best_peers() == result(points).to_dict()["best_peers"] == [row]
    unreached = result((*points[:3], point("fhash compact", 80, False)))
    assert unreached.best_peers() == [row | {"ratios": {"fhash compact": None}}]
    alone = result(points[3:])
    assert alone.best_peers() == [
        row | {"peer": None, "bytes": None, "ratios": {"fhash compact": None}}
    ]

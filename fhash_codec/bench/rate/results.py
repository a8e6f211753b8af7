"""Results of `fhash bench rate`, as records and JSON values."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

PEERS = ("SZ3", "SPERR", "ZFP", "BitRound", "Blosc")
"""Names of the peers."""
OWN = "fhash "
"""Prefix of the names of fhash's own profiles among the codecs."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """The smallest size at which a codec reached a quality, or the closest it came.

    Attributes:
        codec: name of a peer, or "fhash PROFILE".
        goal: "psnr" (dB) or "bound" (share of the range).
        asked: the quality.
        reached: whether the codec reached it.
        bytes, psnr, max_error: figures of the file; psnr in dB, None where exact, max_error as a
            share of the range.
        setting: setting in words.
        as_asked: for a bound, whether the codec's own tolerance of that bound kept it; None where
            it has no such setting.
    """

    codec: str
    goal: str
    asked: float
    reached: bool
    bytes: int
    psnr: float | None
    max_error: float
    setting: str
    as_asked: bool | None


@dataclass(frozen=True, kw_only=True)
class Speed:
    """Speed of a codec at a quality in 10^6 bytes of raw data a second, the best of some runs.

    Attributes:
        encode_mb_s, decode_mb_s: by the clock on the wall.
        encode_core_mb_s, decode_core_mb_s: by the time of all cores in user mode, so those of one.
        encode_runs: runs of encoding.
    """

    codec: str
    setting: str
    psnr: float | None
    encode_mb_s: float
    decode_mb_s: float
    encode_core_mb_s: float
    decode_core_mb_s: float
    encode_runs: int


@dataclass(frozen=True, kw_only=True)
class Access:
    """Access to a small region of one step: medians over random places.

    Attributes:
        region: lengths (z, y, x).
        bytes: size of all the data in this layout.
        psnr: dB of all the data.
        bytes_read: bytes that one region takes.
    """

    codec: str
    setting: str
    region: tuple[int, int, int]
    bytes: int
    psnr: float | None
    milliseconds: float
    bytes_read: int


@dataclass(frozen=True, kw_only=True)
class TilePrice:
    """Bytes of the default tiles of fhash beside those of one tile, at a quality.

    Attributes:
        goal, asked: the quality, as of `Point`.
        bytes: of the file as it is encoded.
        one_tile_bytes: of a file with one tile.
        price: the first over the second.
        steps: of the series that were encoded for both; fewer than it has where one tile would be
            too large.
    """

    goal: str
    asked: float
    bytes: int
    one_tile_bytes: int
    price: float
    steps: int


@dataclass(frozen=True, kw_only=True)
class RateBench:
    """Everything that `bench_rate` measured.

    Attributes:
        tiles: price of the tiles of the profile compact at each quality.
        missing: number of values that are not finite. Lossy peers were given neighbouring values in
            their place.
        refused: for each codec or variant that could not be measured, the reason.
        machine: the machine. notes: how the figures were taken.
    """

    series: str
    shape: tuple[int, ...]
    dtype: str
    raw_bytes: int
    value_range: tuple[float, float]
    missing: int
    points: tuple[Point, ...]
    speeds: tuple[Speed, ...]
    access: tuple[Access, ...]
    tiles: tuple[TilePrice, ...]
    refused: dict[str, str]
    machine: dict[str, Any]
    notes: tuple[str, ...]

    def best_peers(self) -> list[dict[str, Any]]:
        """The best peer at each quality, beside fhash.

        A row is {goal, asked, peer, bytes, ratios}; ratios: for each profile of fhash the bytes of
        the best peer over its own, or None.
        """
        rows = []
        for goal, asked in dict.fromkeys((point.goal, point.asked) for point in self.points):
            here = [point for point in self.points if (point.goal, point.asked) == (goal, asked)]
            own = [point for point in here if point.codec.startswith(OWN)]
            best = min(
                (point for point in here if point.reached and point not in own),
                key=lambda point: point.bytes,
                default=None,
            )
            ratios = {
                point.codec: best.bytes / point.bytes if best and point.reached else None
                for point in own
            }
            rows.append(
                {
                    "goal": goal,
                    "asked": asked,
                    "peer": best and best.codec,
                    "bytes": best and best.bytes,
                    "ratios": ratios,
                }
            )
        return rows

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, and "best_peers"."""
        return {**asdict(self), "best_peers": self.best_peers()}

"""What `fhash bench rate` finds, as records and JSON values."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

PEERS = ("SZ3", "SPERR", "ZFP", "BitRound", "Blosc")
"""Names of the peers."""
OWN = "fhash "
"""How the names of fhash's own profiles begin among codecs."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """The smallest size at which a codec reached a quality, or the closest it came.

    Attributes:
        codec: name of a peer, or "fhash PROFILE". goal: "psnr" (dB) or "bound" (share of the range), and `asked` of it.
        reached: whether it did. bytes, psnr (dB, None where exact), max_error (share of the range): what it came to.
        setting: for people.
        as_asked: for a bound, whether the codec's own tolerance of just that bound kept it; None where it has no such setting.
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
    """10^6 bytes of raw data a second of a codec at a quality, the best of some runs."""

    codec: str
    setting: str
    psnr: float | None
    encode_mb_s: float
    decode_mb_s: float
    encode_runs: int


@dataclass(frozen=True, kw_only=True)
class Access:
    """Reading a small region of one step: medians over random places.

    bytes: of all the data, so stored that this is the cost, at a PSNR in dB. region: lengths (z, y, x).
    """

    codec: str
    setting: str
    region: tuple[int, int, int]
    bytes: int
    psnr: float | None
    milliseconds: float
    bytes_read: int


@dataclass(frozen=True, kw_only=True)
class RateBench:
    """What `bench_rate` measured.

    Attributes:
        missing: number of values that are not finite; peers other than lossless ones were given their neighbours' values instead.
        refused: by codec or variant, why it could not be measured. machine, notes: what the figures were taken on, and how.
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
    refused: dict[str, str]
    machine: dict[str, Any]
    notes: tuple[str, ...]

    def best_peers(self) -> list[dict[str, Any]]:
        """For each quality asked: {goal, asked, peer, bytes, ratios: {codec of fhash: bytes of the best peer / its own, or None}}."""
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

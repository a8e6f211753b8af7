"""Programs by name: unknown ones are refused, unsuitable ones left out with a reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.bench.rate.programs.registry import PROGRAMS, programs
from fhash_codec.bench.rate.rate import bench_rate
from fhash_formats.errors import InputError


def test_every_name_has_variants(tthresh: str, qoz: str, ffmpeg: str) -> None:
    paths = {"tthresh": tthresh, "hevc": ffmpeg} | dict.fromkeys(("qoz", "hpez", "sz3"), qoz)
    found, refused = programs(paths | {"av1": ffmpeg})
    assert list(found) == ["TTHRESH", "HEVC", "QoZ", "HPEZ", "SZ3 program"]
    assert all(variant.peer == peer for peer, several in found.items() for variant in several)
    assert list(refused) == ["av1"]
    assert set(PROGRAMS) == {*paths, "av1", "vvc"}
    with pytest.raises(InputError, match="peer is 'zip'; programs: tthresh, qoz"):
        programs({"zip": qoz})


def test_programs_are_measured_like_other_peers(
    tthresh: str, qoz: str, ffmpeg: str, field: Callable[..., np.ndarray]
) -> None:
    values = field((2, 3, 12, 14))
    values[1, 2, 3, 4] = np.nan
    result = bench_rate(
        values,
        targets=(40.0,),
        bounds=(0.05,),
        names=(),
        named={"tthresh": tthresh, "qoz": qoz, "hevc": ffmpeg, "vvc": ffmpeg},
        profiles=(),
    )
    points = {(point.codec, point.goal): point for point in result.points}
    assert points.keys() == {
        (codec, goal) for codec in ("TTHRESH", "QoZ") for goal in ("psnr", "bound")
    } | {("HEVC", "psnr")}
    assert all(point.reached for point in result.points)
    assert points["QoZ", "bound"].as_asked
    assert points["TTHRESH", "psnr"].psnr < 40.2
    assert {speed.codec for speed in result.speeds} == {"TTHRESH", "QoZ", "HEVC"}
    assert all(speed.encode_core_mb_s > 0 for speed in result.speeds)
    assert {entry.bytes_read for entry in result.access} == {
        points[codec, "psnr"].bytes for codec in ("TTHRESH", "QoZ", "HEVC")
    }
    assert result.refused == {"vvc": f"peer vvc: {ffmpeg} has no encoder libvvenc"}


def test_a_failing_program_is_said_in_one_line(
    script: Callable[[str, str], str], field: Callable[..., np.ndarray], tmp_path: Path
) -> None:
    broken = script("broken", "print('out of luck', file=sys.stderr)\nsys.exit(7)")
    result = bench_rate(
        field((2, 3, 8, 9)),
        targets=(40.0,),
        bounds=(),
        names=(),
        named={"tthresh": broken},
        profiles=(),
    )
    assert result.points == ()
    assert set(result.refused.values()) == {
        f"TTHRESH PSNR, a file per {layout}: broken failed with 7: out of luck"
        for layout in ("series", "frame")
    }

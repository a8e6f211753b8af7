"""Programs as peers: what they must give back, and errors in one line."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rarely import rarely

from fhash_bench.rate.peers import (
    ENCODERS,
    PROGRAMS,
    QOZ_NAMES,
    PeerFiles,
    ProgramVariant,
    all_filters,
    as_float,
    called,
    executable,
    folder_of,
    programs,
    qoz_variants,
    read_raw,
    read_region,
    spans_of,
    there_and_back,
    touched_bytes,
    tthresh_variants,
    video_variants,
    write_raw,
)
from fhash_bench.rate.rate import bench_rate
from fhash_codec.boxes import Box
from fhash_codec.cost.peers import (
    LAYOUTS,
    Variant,
    filled,
    joined,
    parts_of,
    read_all,
    stored,
    stored_bytes,
)
from fhash_formats.errors import InputError
from fhash_formats.support.values import Values

Script = Callable[[str, str], str]
VALUES = np.random.default_rng(0).normal(size=(3, 4, 5, 6)).astype(np.float32)


class Keeper:
    """A codec that keeps everything."""

    def __init__(self, *, writes: bool = True) -> None:
        self.writes = writes
        self.shapes: list[tuple[int, ...]] = []

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        self.shapes.append(part.shape)
        assert part.flags.c_contiguous
        assert scale == (float(VALUES.min()), 2.5)
        if level < 0:
            raise InputError("it is too coarse")
        if self.writes:
            part.tofile(file)

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        return np.fromfile(file, np.float32).reshape(shape)


def variant(program: Keeper, layout: str = "series") -> ProgramVariant:
    return ProgramVariant(peer="Keeper", mode="all", layout=layout, goals=(), program=program)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_parts_of_a_layout_come_back(tmp_path: Path, layout: str) -> None:
    program = Keeper()
    coded = variant(program, layout).encode(VALUES, 2.5, 40.0, tmp_path)
    assert coded.bytes == VALUES.nbytes
    np.testing.assert_array_equal(variant(program, layout).decode(coded), VALUES)
    shapes = {
        "frame": [(4, 5, 6)] * 3,
        "plane": [(3, 5, 6)] * 4,
        "series": [(3, 4, 5, 6)],
        "folded": [(12, 5, 6)],
        "turned": [(12, 5, 6)],
    }
    assert program.shapes == shapes[layout]


def test_errors_name_the_variant(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Keeper all, a file per series: it is too coarse"):
        variant(Keeper()).encode(VALUES, 2.5, -1.0, tmp_path)
    with pytest.raises(InputError, match="the program wrote no file"):
        variant(Keeper(writes=False)).encode(VALUES, 2.5, 1.0, tmp_path)


def test_a_program_is_found_or_refused(script: Script, tmp_path: Path) -> None:
    path = script("here", "")
    assert executable("qoz", path) == path
    for missing in (tmp_path / "gone", tmp_path):
        with pytest.raises(InputError, match=r"peer qoz: '.*' is no program that can be run"):
            executable("qoz", str(missing))


def test_what_a_program_says_last_is_the_error(script: Script) -> None:
    assert called([script("fine", "print('out')")]) == b"out\n"
    code = "print('first', file=sys.stderr)\nprint('last \\x1b[1m', file=sys.stderr)\nsys.exit(3)"
    with pytest.raises(InputError, match=r"^bad failed with 3: last \?\[1m$"):
        called([script("bad", code)])
    with pytest.raises(InputError, match="mute failed with 1: it said nothing"):
        called([script("mute", "sys.exit(1)")])
    path = Path(script("broken", ""))
    path.write_text("no program")
    with pytest.raises(InputError, match="broken cannot be run: "):
        called([path])


@pytest.mark.skipif(os.name != "posix", reason="sessions are those of Unix")
def test_a_program_that_takes_too_long_is_ended_with_its_children(
    script: Script, tmp_path: Path
) -> None:
    mark = tmp_path / "mark"
    child = f"import time; time.sleep(1.5); open({str(mark)!r}, 'w')"
    code = f"import subprocess, time\nsubprocess.Popen([sys.executable, '-c', {child!r}])\n"
    with pytest.raises(InputError, match=r"slow was ended after 0.5 s"):
        called([script("slow", code + "time.sleep(60)")], 0.5)
    time.sleep(2)
    assert not mark.exists()


def test_temporary_files_go_away(tmp_path: Path) -> None:
    def fail() -> None:
        with folder_of(tmp_path) as folder:
            (folder / "a").write_text("a")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.every
@pytest.mark.parametrize("name", QOZ_NAMES)
@pytest.mark.parametrize("shape", [(3, 1, 1, 9), *rarely((4, 6, 20, 24), (1, 6, 20, 24))])
@pytest.mark.parametrize("dtype", [np.float32, *rarely(np.float64)])
def test_the_level_is_a_tolerance(
    qoz: str,
    field: Callable[..., np.ndarray],
    tmp_path: Path,
    name: str,
    shape: tuple[int, ...],
    dtype: type,
) -> None:
    values = field(shape).astype(dtype) + dtype(0.1)
    for variant in qoz_variants(name, qoz):
        coded = variant.encode(values, 3.0, 40.0, tmp_path)
        difference = variant.decode(coded).astype(float) - values
        assert 0 < np.abs(difference).max() <= 0.03 * (1 + 1e-6)
        assert variant.peer == QOZ_NAMES[name]


def test_values_are_float32_where_that_holds_them() -> None:
    for values, dtype in (
        (np.arange(5, dtype=np.int16), "<f4"),
        (np.array([0.5, 2.0]), "<f4"),
        (np.array([0.1]), "<f8"),
        (np.array([2**24 + 1]), "<f8"),
    ):
        floats = as_float(values)
        assert floats.dtype == np.dtype(dtype)
        np.testing.assert_array_equal(floats, values)


def test_other_sizes_are_refused(tmp_path: Path) -> None:
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    write_raw(values, tmp_path / "a")
    np.testing.assert_array_equal(read_raw(tmp_path / "a", "<f4", (2, 3)), values)
    with pytest.raises(InputError, match="it gave 6 values, not 8"):
        read_raw(tmp_path / "a", "<f4", (2, 4))
    with pytest.raises(InputError, match="it wrote no values"):
        read_raw(tmp_path / "b", "<f4", (2, 4))


def test_every_name_has_variants(tthresh: str, qoz: str, ffmpeg: str) -> None:
    paths = {"tthresh": tthresh, "hevc": ffmpeg} | dict.fromkeys(("qoz", "hpez", "sz3"), qoz)
    found, refused = programs(paths | {"av1": ffmpeg})
    assert list(found) == ["TTHRESH", "HEVC", "QoZ", "HPEZ", "SZ3 program"]
    assert all(variant.peer == peer for peer, several in found.items() for variant in several)
    assert list(refused) == ["av1"]
    assert set(PROGRAMS) == {*paths, "av1", "vvc"}
    with pytest.raises(InputError, match="peer is 'zip'; programs: tthresh, qoz"):
        programs({"zip": qoz})


@pytest.mark.every
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
        presets=(),
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
        presets=(),
    )
    assert result.points == ()
    assert set(result.refused.values()) == {
        f"TTHRESH PSNR, a file per {layout}: broken failed with 7: out of luck"
        for layout in ("series", "frame")
    }


@pytest.mark.parametrize("shape", [(3, 1, 1, 9), *rarely((4, 6, 20, 24), (1, 6, 20, 24))])
@pytest.mark.parametrize("dtype", [np.float32, *rarely(np.float64, np.int16)])
def test_the_psnr_is_that_of_the_level(
    tthresh: str,
    field: Callable[..., np.ndarray],
    tmp_path: Path,
    shape: tuple[int, ...],
    dtype: type,
) -> None:
    values = (100 * field(shape)).astype(dtype)
    data_range = float(np.ptp(values))
    for variant in tthresh_variants(tthresh):
        coded = variant.encode(values, data_range, 40.0, tmp_path)
        difference = variant.decode(coded).astype(float) - values
        # A uniform error of that tolerance has a PSNR 4.8 dB above the level.
        reached = 20 * np.log10(data_range / np.sqrt(np.mean(difference**2)))
        assert 43 < reached < 48
        assert 0 < coded.bytes < 8 * values.size + 600
    assert {variant.goals for variant in tthresh_variants(tthresh)} == {("psnr", "bound")}


def test_a_constant_part_is_kept_without_the_program(tmp_path: Path) -> None:
    """The program takes minutes on it, and megabytes."""
    values = np.linspace(0, 1, 2 * 3 * 4 * 5).reshape(2, 3, 4, 5)
    values[0] = 0.3
    frames = next(variant for variant in tthresh_variants("/nowhere") if variant.layout == "frame")
    file = tmp_path / "part"
    frames.program.encode(values[0], file, (0.0, 1.0), 45.0)
    assert file.stat().st_size == 8
    np.testing.assert_array_equal(frames.program.decode(file, (3, 4, 5), (0.0, 1.0)), values[0])


Field = Callable[..., np.ndarray]


def psnr(values: np.ndarray, decoded: np.ndarray) -> float:
    """dB over the range of the values."""
    return float(20 * np.log10(np.ptp(values) / np.sqrt(np.mean((decoded - values) ** 2.0))))


@pytest.mark.every
@pytest.mark.parametrize("shape", [(2, 1, 1, 9), *rarely((4, 6, 20, 24), (1, 3, 65, 72))])
def test_a_finer_level_is_better(
    ffmpeg: str, field: Field, tmp_path: Path, shape: tuple[int, ...]
) -> None:
    values = field(shape)
    data_range = float(np.ptp(values))
    found = video_variants("hevc", ffmpeg)
    assert {variant.program.bits for variant in found} == {10, 12}
    for variant in found:
        assert variant.goals == ("psnr",)
        reached = []
        for level in (30.0, 50.0, 90.0):
            coded = variant.encode(values, data_range, level, tmp_path)
            decoded = variant.decode(coded)
            assert decoded.shape == values.shape
            reached.append(psnr(values, decoded))
        assert reached == sorted(reached)
        # The finest is the quantisation alone.
        assert reached[-1] == pytest.approx(6.02 * variant.program.bits + 10.8, abs=2)


def test_an_encoder_that_is_not_there_is_named(ffmpeg: str) -> None:
    with pytest.raises(InputError, match="has no encoder libvvenc"):
        video_variants("vvc", ffmpeg)
    with pytest.raises(InputError, match="has no encoder libaom-av1 or libsvtav1"):
        video_variants("av1", ffmpeg)


def real() -> str | None:
    """Path of an ffmpeg, of imageio's or of the machine."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return shutil.which("ffmpeg")


@pytest.mark.parametrize("name", [*list(ENCODERS)[:1], *rarely(*list(ENCODERS)[1:])])
def test_an_ffmpeg_codes_what_it_is_given(field: Field, tmp_path: Path, name: str) -> None:
    path = real()
    if path is None:
        pytest.skip("there is no ffmpeg")
    try:
        found = video_variants(name, path)
    except InputError as error:
        pytest.skip(str(error))
    values = field()
    for variant in found:
        coded = variant.encode(values, float(np.ptp(values)), 50.0, tmp_path)
        assert coded.bytes < values.nbytes / 2
        assert psnr(values, variant.decode(coded)) > 30


def test_files_of_a_filter_are_read_by_regions(
    field: Callable[..., np.ndarray], tmp_path: Path
) -> None:
    values = field()
    for variant in all_filters()["SZ3"]:
        decoded, count = there_and_back(values, variant, 3.0, 40.0, tmp_path)
        assert np.abs(decoded - values).max() <= 0.03 * (1 + 1e-4)
        files = PeerFiles(values, variant, 3.0, 40.0, tmp_path)
        files.encode()
        files.decode()
        read, taken = files.read_region(1, Box.of(((0, 2), (3, 9), (0, 5))))
        assert 0 < read <= count
        assert min(taken.wall, taken.core) > 0


VALUES_LAYOUTS = np.arange(3 * 4 * 5 * 6).reshape(3, 4, 5, 6)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_parts_come_back_and_regions_are_found(layout: str) -> None:
    parts = parts_of(VALUES_LAYOUTS, layout)
    np.testing.assert_array_equal(joined(parts, layout, VALUES_LAYOUTS.shape), VALUES_LAYOUTS)
    assert sum(part.size for part in parts) == VALUES_LAYOUTS.size
    box = Box.of(((1, 3), (0, 2), (2, 6)))
    found = [
        parts[number][tuple(slice(*span) for span in spans)].ravel()
        for number, spans in spans_of(layout, VALUES_LAYOUTS.shape, 2, box)
    ]
    np.testing.assert_array_equal(np.concatenate(found), VALUES_LAYOUTS[2, 1:3, 0:2, 2:6].ravel())


VARIANTS = [variant for chosen in all_filters().values() for variant in chosen]
"""Every variant of every peer."""
CUT = [replace(variant, chunk=8) for variant in VARIANTS if variant.layout == "frame"]
"""Variants with chunks of a frame, cut into small ones."""
REGION = ((1, 4), (2, 12), (5, 17))


@pytest.mark.parametrize("variant", [*VARIANTS, *CUT], ids=lambda variant: variant.name)
def test_a_peer_returns_the_region_of_what_it_returns(variant: Variant, field: Field) -> None:
    values = field()
    with stored(values, variant, 3.0, 60.0) as file:
        decoded = read_all(file, variant, values.shape)
        assert decoded.shape == values.shape
        assert np.abs(decoded - values).max() < 0.5
        region = read_region(file, variant, values.shape, 2, REGION)
        np.testing.assert_array_equal(region, decoded[2][tuple(slice(*span) for span in REGION)])
        touched, total = touched_bytes(file, variant, values.shape, 2, REGION), stored_bytes(file)
    assert 0 < touched <= total
    if variant.layout == "frame":
        assert touched < total / 2
    if variant.lossless:
        np.testing.assert_array_equal(decoded, values)
    else:
        assert total < values.nbytes


@pytest.mark.parametrize(
    "variant",
    [variant for variant in VARIANTS if variant.mode == "tolerance"],
    ids=lambda variant: variant.name,
)
def test_a_level_is_a_tolerance(variant: Variant, field: Field) -> None:
    values = field()
    with stored(values, variant, 3.0, 40.0) as file:
        assert np.abs(
            read_all(file, variant, values.shape).astype(np.float64) - values
        ).max() <= 0.03 * (1 + 1e-4)


def test_sperr_is_given_the_axes_in_its_own_order() -> None:
    """A field that is smooth along x and y alone costs far more with its axes in reverse."""
    import hdf5plugin

    values = np.broadcast_to(
        np.random.default_rng(0).normal(size=(2, 3, 1, 1)), (2, 3, 40, 90)
    ).astype(np.float32)
    values = values + np.sin(np.linspace(0, 3, 90, dtype=np.float32))
    variant = next(
        variant
        for variant in all_filters()["SPERR"]
        if variant.layout == "frame" and variant.mode == "tolerance"
    )
    other = replace(
        variant,
        setting=lambda part, data_range, level: hdf5plugin.Sperr(
            absolute=data_range * 10 ** (-level / 20)
        ),
    )
    with (
        stored(values, variant, 6.0, 50.0) as file,
        stored(values.copy(), other, 6.0, 50.0) as file_without,
    ):
        assert stored_bytes(file) < 0.8 * stored_bytes(file_without)


def test_missing_values_are_filled_from_their_row_first() -> None:
    values = np.arange(24, dtype=np.float32).reshape(1, 2, 3, 4)
    broken = values.copy()
    broken[0, 0, 0, 1:3] = np.nan
    broken[0, 0, 1, 0] = np.inf
    broken[0, 1, 2] = np.nan
    result = filled(broken)
    known = np.isfinite(broken)
    np.testing.assert_array_equal(result[known], values[known])
    assert result[0, 0, 0].tolist() == [0, 0, 0, 3]
    assert result[0, 0, 1, 0] == 5
    np.testing.assert_array_equal(result[0, 1, 2], values[0, 1, 1])

"""Files through libfhash: what its functions give equals what Python reads, bit for bit."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
import pytest
from edited import edit
from reference import rounding

import fhash_codec
from fhash_codec import DamagedFileError, EncodeConfig, Volume, encoding
from fhash_codec.compact import encode as compact
from fhash_formats import native
from fhash_formats.container import Container
from fhash_formats.native import ffi, pointer
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.head import Layer, NeighbourHead

GOLDEN = Path(__file__).parents[1] / "golden"
NAMES = sorted(path.stem for path in GOLDEN.glob("*.fhz"))
TYPES = tuple(DTYPES)
ARGUMENT, MEMORY, DAMAGED, READ = -1, -2, -3, -5
UNLIMITED = 0

Region = Sequence[tuple[int, int]]
LIBRARY, NULL = native.library(), ffi.NULL


class Refused(Exception):
    """A status other than FHASH_OK: its number and its text."""


def call(function: Callable[..., int], *arguments: Any) -> None:
    failure = ffi.new("fhash_error *")
    status = function(*arguments, failure)
    if status:
        assert failure.status == status
        assert failure.text[0] != b"\0"
        raise Refused(status, ffi.string(failure.text).decode())


class Opened:
    """An open file, of a path or of bytes; `reads` has the offset and length of each read."""

    def __init__(
        self, source: Path | bytes, *, memory: int = UNLIMITED, fails_at: int = -1, threads: int = 1
    ) -> None:
        self.reads: list[tuple[int, int]] = []
        self._context = LIBRARY.fhash_context_create(memory, threads)
        opened = ffi.new("fhash_file **")

        def read(_: Any, offset: int, length: int, place: Any) -> int:
            self.reads.append((offset, length))
            assert isinstance(source, bytes)
            assert offset + length <= len(source), "a read beyond the end"
            ffi.memmove(place, source[offset : offset + length], length)
            return int(len(self.reads) - 1 == fails_at)

        # It must live as long as the file.
        self._read = ffi.callback("fhash_read_function", read)
        try:
            if isinstance(source, bytes):
                place = (self._read, NULL, len(source))
                call(LIBRARY.fhash_open, self._context, *place, opened)
            else:
                path = os.fsencode(source)
                call(LIBRARY.fhash_open_path, self._context, path, opened)
        except Refused:
            assert not opened[0]
            LIBRARY.fhash_context_destroy(self._context)
            raise
        self._file = opened[0]

    def __enter__(self) -> Opened:
        return self

    def __exit__(self, *_: object) -> None:
        LIBRARY.fhash_close(self._file)
        LIBRARY.fhash_context_destroy(self._context)

    @property
    def header(self) -> Any:
        return json.loads(ffi.string(LIBRARY.fhash_header(self._file)))

    def facts(self) -> list[Any]:
        size, count = ffi.sizeof("fhash_variable"), LIBRARY.fhash_variables(self._file)
        found = [ffi.new("fhash_variable *", {"size": size}) for _ in range(count)]
        for number, each in enumerate(found):
            call(LIBRARY.fhash_variable_get, self._file, number, each)
        return found

    def coordinate(self, number: int, axis: int, length: int) -> tuple[npt.NDArray[Any], Any]:
        positions, attributes = np.empty(length), ffi.new("char **")
        places = (pointer(positions), attributes)
        call(LIBRARY.fhash_coordinate, self._file, number, axis, *places)
        return positions, json.loads(ffi.string(attributes[0]))

    def read(
        self,
        step: float,
        shape: Region | Sequence[int],
        *,
        number: int = 0,
        lod: int = 0,
        dtype: str = "float32",
    ) -> npt.NDArray[Any]:
        """Values of a region, or of the whole domain of a shape (z, y, x)."""
        region: Region = [n if isinstance(n, tuple) else (0, n) for n in shape]
        every = 1 << lod
        values = np.full([-(-b // every) - -(-a // every) for a, b in region], 77, dtype)
        whole = all(not isinstance(n, tuple) for n in shape)
        ends = NULL if whole else [end for span in region for end in span]
        kind = TYPES.index(dtype) + 1
        call(LIBRARY.fhash_read, self._file, number, step, ends, lod, kind, pointer(values))
        return values


def middle(shape: Sequence[int]) -> list[tuple[int, int]]:
    return [(n // 3, max(n - n // 4, n // 3 + 1)) for n in shape]


def volumes(path: Path) -> Iterator[Volume]:
    with Container.open(path) as container:
        names = container.names
    for name in names:
        with fhash_codec.open(path, variable=name) as volume:
            yield volume


def assert_same(found: npt.NDArray[Any], wanted: npt.NDArray[Any], tolerance: float | None) -> None:
    assert (found.shape, found.dtype) == (wanted.shape, wanted.dtype)
    if tolerance is not None:
        np.testing.assert_allclose(found, wanted, atol=tolerance, rtol=0)
        return
    if found.dtype.kind == "f":
        np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
        found, wanted = np.nan_to_num(found, nan=7), np.nan_to_num(wanted, nan=7)
    assert found.tobytes() == wanted.tobytes()


def assert_equal(file: Opened, number: int, volume: Volume) -> None:
    """Every step, between steps, a region, integers and levels of detail of a variable."""
    facts, (steps, *space) = file.facts()[number], volume.shape
    tolerance = rounding(volume) or None
    floats = volume.float_dtype.name
    for step in (*range(steps), *(first + 0.3 for first in range(steps - 1))):
        found = file.read(step, space, number=number, dtype=floats)
        assert_same(found, volume.read(step), tolerance)
        part = middle(space)
        found = file.read(step, part, number=number, dtype=floats)
        assert_same(found, volume.read(step, tuple(part)), tolerance)
    if volume.dtype == volume.source_dtype:
        own = file.read(0, space, number=number, dtype=volume.dtype.name)
        assert_same(own, volume.values(0), tolerance)
    assert bool(facts.levels) == (volume.profile == "compact" and max(volume.box.shape) > 2)
    for lod in range(1, facts.levels + 1):
        every = 1 << lod
        if any(first % every for first in volume.box.first):
            continue
        inside = tuple(slice(first // every, -(-end // every)) for first, end in volume.box)
        found = file.read(steps - 1, space, number=number, lod=lod, dtype=floats)
        assert_same(found[inside], volume.read_lod(steps - 1, lod), tolerance)


@pytest.mark.parametrize("name", NAMES)
def test_golden_containers_equal_what_python_reads(name: str) -> None:
    path = GOLDEN / f"{name}.fhz"
    with Opened(path) as file:
        for number, volume in enumerate(volumes(path)):
            assert_equal(file, number, volume)
    with Opened(path.read_bytes(), threads=2) as file:
        assert len(file.reads) <= 3
        for number, volume in enumerate(volumes(path)):
            assert_equal(file, number, volume)


@pytest.mark.parametrize("name", ["compact-variables", "compact-named", "paper-plain-coded"])
def test_headers_and_positions_are_those_of_python(name: str) -> None:
    path = GOLDEN / f"{name}.fhz"
    with Opened(path) as file, Container.open(path) as container:
        headers = file.header["variables"]
        assert len(headers) == len(file.facts()) == len(container.names)
        for number, (volume, facts) in enumerate(zip(volumes(path), file.facts(), strict=True)):
            assert ffi.string(facts.name).decode() == container.names[number]
            assert ffi.string(facts.units).decode() == volume.units
            assert json.loads(ffi.string(facts.attributes)) == volume.attrs
            assert tuple(facts.shape) == volume.shape
            assert TYPES[facts.type - 1] == volume.source_dtype.name
            assert tuple(facts.box) == tuple(end for span in volume.box for end in span)
            tile = volume.chunks if volume.profile == "compact" else (0, 0, 0, 0)
            assert tuple(facts.tile) == tuple(tile)
            for axis, coordinate in enumerate(volume.coords.values()):
                positions, described = file.coordinate(number, axis, volume.shape[axis])
                assert positions.tobytes() == coordinate.values.tobytes()
                assert described["name"] == coordinate.name
                assert described["attributes"] == dict(coordinate.attributes)


def test_positions_that_are_no_numbers_are_those_of_python(tmp_path: Path) -> None:
    path = tmp_path / "a.fhz"
    path.write_bytes((GOLDEN / "compact-cubic.fhz").read_bytes())

    def change(root):
        header = root["attributes"]["fhash"]["variables"][0]
        values = [0.5, "NaN", "Infinity", "-Infinity", *range(header["domain"]["shape"][0])]
        header["coordinates"] = {"time": {"values": values[:-4]}, "x": {"ulps": [3], "step": 0.1}}
        return root

    edit(path, "zarr.json", change)
    with Opened(path) as file, fhash_codec.open(path) as volume:
        for axis, coordinate in enumerate(volume.coords.values()):
            positions, _ = file.coordinate(0, axis, volume.shape[axis])
            assert positions.tobytes() == coordinate.values.tobytes()


SPACE = (16, 32, 32)


@pytest.fixture(scope="module")
def tiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of noise, 4 steps in 64 tiles of two steps each; its end has not all of its tiles."""
    path = tmp_path_factory.mktemp("libfhash") / "tiled.fhz"
    values = np.random.default_rng(7).normal(size=(4, *SPACE)).astype(np.float32)
    config = EncodeConfig(
        max_error=1e-4, effort=1, tile="2x4x16x16", timings=False, without=("ssim",)
    )
    fhash_codec.encode(values, path, config)
    assert path.stat().st_size > 100_000
    return path


def test_few_reads_and_few_bytes_and_no_tile_twice(tiled: Path) -> None:
    region = [(0, 4), (0, 16), (0, 16)]
    with Opened(data := tiled.read_bytes()) as file:
        assert len(file.reads) <= 3
        assert sum(length for _, length in file.reads) < 70_000
        for step in range(4):
            file.reads.clear()
            found = file.read(step, region)
            read = sum(length for _, length in file.reads)
            # The first step of a tile needs it, and the sizes of tiles where they are not known.
            assert len(file.reads) <= (2, 0, 1, 0)[step]
            assert read < len(data) / 16
            with fhash_codec.open(tiled) as volume:
                assert_same(found, volume.read(step, tuple(region)), None)
        file.reads.clear()
        file.read(0, SPACE)
        assert len(file.reads) <= 2  # all tiles of the layer lie together


def random_head() -> NeighbourHead:
    chance = np.random.default_rng(3)
    layers = tuple(
        Layer(
            weights=chance.integers(-20, 21, shape).astype(np.int8),
            biases=chance.integers(-99, 100, shape[0]).astype(np.int8),
            weight_scale=0.0123291015625,
            bias_scale=0.0078125,
        )
        for shape in [(4, 28), (3, 4), (1, 3)]
    )
    return NeighbourHead(layers=layers, sigma=0.125, low=-4.0, high=4.0)


def test_a_region_of_a_tile_with_a_head_equals_that_part_of_the_tile(tmp_path: Path) -> None:
    code, path = compact.code_series, tmp_path / "head.fhz"

    def coded(*arguments: Any, **options: Any) -> Any:
        table = code(*arguments, **options)
        settings = replace(table.plan.settings, head=random_head())
        return replace(table, plan=replace(table.plan, settings=settings), decoded={})

    values = np.random.default_rng(8).normal(size=(2, *SPACE)).astype(np.float32)
    config = EncodeConfig(psnr=50.0, effort=2, tile="2x16x32x16", timings=False)
    with (
        mock.patch.object(compact, "code_series", coded),
        mock.patch.object(encoding, "missed_promise", return_value=None),
    ):
        fhash_codec.encode(values, path, config)
    with fhash_codec.open(path) as volume:
        assert volume.container.arrays["table_1"].settings.head is not None
        wanted = [volume.read(step) for step in range(2)]
    places = [(0, 0, 0), (5, 9, 8), (13, 29, 29), (7, 15, 14)]
    for place in places:
        part = [(first, first + 3) for first in place]
        slices = tuple(slice(*span) for span in part)
        with Opened(path, threads=2) as file:
            for step in (0, 1, 0):  # before the tile is whole, and once it is
                assert_same(file.read(step, part), wanted[step][slices], None)
            assert_same(file.read(1, SPACE), wanted[1], None)


def test_threads_read_one_file_at_once(tiled: Path) -> None:
    with fhash_codec.open(tiled) as volume:
        wanted = [volume.read(step) for step in range(4)]
    wrong: list[int] = []
    with Opened(tiled, memory=64 << 20) as file:

        def read(first: int) -> None:
            for step in (first, 3 - first, first):
                if not np.array_equal(file.read(step, SPACE), wanted[step]):
                    wrong.append(step)

        threads = [threading.Thread(target=read, args=(first,)) for first in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not wrong


@pytest.mark.parametrize("name", ["compact-mask", "compact-variables", "paper-sparse"])
def test_files_that_were_cut_are_refused(name: str) -> None:
    data = (GOLDEN / f"{name}.fhz").read_bytes()
    for length in (*range(0, len(data), 97), len(data) - 1):
        with pytest.raises(Refused) as refused:
            Opened(data[:length])
        assert refused.value.args[0] == DAMAGED


@pytest.mark.parametrize("name", ["compact-mask", "compact-variables", "paper-sparse"])
def test_flipped_bits_are_refused_or_change_nothing(name: str) -> None:
    data = (GOLDEN / f"{name}.fhz").read_bytes()

    def values(source: bytes) -> bytes:
        with Opened(source) as file:
            facts = file.facts()
            return b"".join(
                file.read(0.5, list(each.shape)[1:], number=number).tobytes()
                for number, each in enumerate(facts)
            )

    sound, refused = values(data), 0
    for place in range(0, len(data), 23):
        flipped = bytearray(data)
        flipped[place] ^= 1 << place % 8
        try:
            found = values(bytes(flipped))
        except Refused as why:
            found, refused = sound if why.args[0] == DAMAGED else b"", refused + 1
        assert found == sound, f"byte {place}"
    assert refused > len(data) / 23 / 3


def test_a_function_that_cannot_read_is_told(tiled: Path) -> None:
    data = tiled.read_bytes()
    with pytest.raises(Refused) as refused:
        Opened(data, fails_at=0)
    assert refused.value.args[0] == READ
    with Opened(data) as file:
        opening = len(file.reads)
    with Opened(data, fails_at=opening) as file:
        with pytest.raises(Refused) as refused:
            file.read(0, SPACE)
        assert refused.value.args[0] == READ
        with fhash_codec.open(tiled) as volume:  # nothing wrong is kept
            assert_same(file.read(0, SPACE), volume.read(0), None)


def test_a_limit_of_memory_is_kept(tiled: Path) -> None:
    data = tiled.read_bytes()
    with pytest.raises(Refused) as refused:
        Opened(data, memory=1000)
    assert refused.value.args[0] == MEMORY
    with Opened(data, memory=70_000) as file, pytest.raises(Refused) as refused:
        file.read(0, SPACE)
    assert refused.value.args[0] == MEMORY
    with Opened(data, memory=1 << 20) as file, fhash_codec.open(tiled) as volume:
        assert_same(file.read(2.25, SPACE), volume.read(2.25), None)


def test_wrong_arguments_are_refused(tiled: Path) -> None:
    with Opened(tiled) as file:
        for step, shape, settings in (
            (-0.5, SPACE, {}),
            (3.5, SPACE, {}),
            (float("nan"), SPACE, {}),
            (0, [(0, 17), (0, 4), (0, 4)], {}),
            (0, [(3, 3), (0, 4), (0, 4)], {}),
            (0, [(-1, 3), (0, 4), (0, 4)], {}),
            (0, [(1, 2), (0, 4), (0, 4)], {"lod": 1}),
            (0, SPACE, {"lod": 9}),
            (0, SPACE, {"number": 1}),
            (0, SPACE, {"dtype": "int16"}),
        ):
            with pytest.raises(Refused) as refused:
                file.read(step, shape, **settings)  # type: ignore[arg-type]
            assert refused.value.args[0] == ARGUMENT
    with pytest.raises(Refused) as refused:
        Opened(tiled.with_name("none.fhz"))
    assert refused.value.args[0] == READ


def test_integers_have_the_fill_value_where_they_have_no_value(tmp_path: Path) -> None:
    values = np.arange(4 * 6 * 8 * 10, dtype=np.int16).reshape(4, 6, 8, 10) % 300
    config = EncodeConfig(
        max_error=0.0, effort=1, timings=False, features=("interval:150:299",), dilation=0
    )
    path = tmp_path / "counts.fhz"
    fhash_codec.encode(values, path, config)
    with Opened(path) as file:
        with pytest.raises(Refused) as refused:
            file.read(1, (6, 8, 10), dtype="int16")
        assert refused.value.args[0] == ARGUMENT
    path = GOLDEN / "compact-many-labels.fhz"
    with Opened(path) as file, fhash_codec.open(path) as volume:
        assert volume.fill is not None
        found = file.read(1, volume.shape[1:], dtype="int16")
        assert_same(found, volume.values(1), None)


def test_an_unknown_rule_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.fhz"
    path.write_bytes((GOLDEN / "compact-cubic.fhz").read_bytes())

    def change(root):
        root["attributes"]["fhash"]["variables"][0]["model"]["between"]["rule"] = "sinc"
        return root

    edit(path, "zarr.json", change)
    with pytest.raises(DamagedFileError, match=r"model[.]between[.]rule is not linear or cubic"):
        fhash_codec.open(path)
    with pytest.raises(Refused, match="linear or cubic") as refused:
        Opened(path)
    assert refused.value.args[0] == DAMAGED

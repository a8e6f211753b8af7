"""Mistakes of users: each ends with its exit code and one clear line, and changes no file."""

from __future__ import annotations

import errno
import json
import resource
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from click.testing import Result
from command_line import Fhash, Refused
from rarely import rarely
from source_kinds import KINDS

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.times import time_of, time_text
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import FhashWarning
from fhash_formats.readers.registry import open_series

SMALL = ["--effort", "1", "--quiet"]
PAPER = ["--preset=published", "--tables=float16", "--epochs", "1", "--width", "4", "--quiet"]


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """A folder of unsuitable inputs."""
    folder = tmp_path / "in"
    folder.mkdir()
    with h5py.File(folder / "many.h5", "w") as file:
        file["line"] = np.zeros(9)
        file["sheet"] = np.zeros((9, 9))
        file["five"] = np.zeros((2, 2, 3, 3, 3))
        file["complex"] = np.zeros((3, 3, 3, 3), dtype=complex)
        file["text"] = np.full((2, 3, 3, 3), b"abc")
        file["words"] = np.full((2, 3, 3, 3), "abc", dtype=h5py.string_dtype())
        file["pairs"] = np.zeros((2, 3, 3, 3), dtype=[("a", "f4"), ("b", "f4")])
        file["empty"] = np.zeros((0, 3, 3, 3))
        file["hollow"] = np.zeros((2, 3, 0, 3))
        file["nowhere"] = np.full((2, 3, 3, 3), np.nan)
        file["endless"] = np.full((2, 3, 3, 3), np.inf)
        file["good"] = np.arange(2 * 3 * 4 * 5, dtype=float).reshape(2, 3, 4, 5)
        file.create_group("group")
    whole = (folder / "many.h5").read_bytes()
    (folder / "cut.h5").write_bytes(whole[: len(whole) // 2])
    (folder / "text.h5").write_text("this is no HDF5 file")
    (folder / "text.xyz").write_text("of no format at all")
    (folder / "nothing.npy").write_bytes(b"")
    (folder / "bytes.bin").write_bytes(bytes(100))
    np.save(folder / "complex.npy", np.zeros((2, 3, 3, 3), dtype=complex))
    np.save(folder / "objects.npy", np.array([[[["a"]]]], dtype=object))
    np.save(folder / "five.npy", np.zeros((1, 2, 3, 3, 3)))
    np.save(folder / "good.npy", np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5))
    (folder / "plain").mkdir()
    return folder


INPUTS = [
    ("missing.h5", [], "does not exist"),
    ("plain", [], "is a folder"),
    ("text.h5", [], "text.h5"),
    ("cut.h5", ["--var", "good"], "cut.h5"),
    ("nothing.npy", [], "empty"),
    ("complex.npy", [], "complex128"),
    ("five.npy", [], "5"),
    ("good.npy", ["--axes", "t,z,y"], "axes"),
    ("good.npy", ["--t", "5:9"], "2 steps"),
    ("bytes.bin", ["--shape", "x=2,y=2,z=2,t=2", "--dtype", "float32"], "100"),
    ("bytes.bin", ["--shape", "x=5,y=0,z=4", "--dtype", "uint8"], "y=0"),
    ("many.h5", [], "--var"),
    *(("many.h5", ["--var", name], name) for name in ("line", "five", "text", "empty")),
    ("many.h5", ["--var", "nowhere"], "nowhere"),
]


@pytest.mark.parametrize(
    ("name", "words", "message"),
    INPUTS,
    ids=lambda value: "-".join(value) if isinstance(value, list) else str(value),
)
def test_unsuitable_input(
    refused: Refused, inputs: Path, name: str, words: list[str], message: str
) -> None:
    output = inputs.parent / "out.fhz"
    assert message in refused(2, "encode", inputs / name, "-o", output, *words, *SMALL)


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [("missing.h5", [], "does not exist"), ("many.h5", ["--var", "line"], "line")],
)
def test_every_command_opens_its_data_alike(
    refused: Refused, inputs: Path, run: Path, name: str, words: list[str], message: str
) -> None:
    data = inputs / name
    assert message in refused(2, "diff", data, run, *words)
    assert message in refused(2, "bench", "rate", data, "--target", "40", "-q", *words)


SETTINGS = [
    (["--feature", "interval:1e9:2e9"], "select"),
    (["--feature", "interval:2:1"], "interval"),
    (["--feature", "blob"], "blob"),
    (["--feature", ""], "feature"),
    (["--feature", "mask:missing.npy"], "missing.npy"),
    (["--preset", "published", "--key-frames", "every:0"], "every"),
    (["--preset", "published", "--key-frames", "5,9"], "9"),
    (["--preset", "published", "--key-frames", ""], "key"),
    (["--key-frames", "0,1"], "key-frames belongs to --preset published; the preset is default"),
    (["--ratio", "40", "--max-error", "0.1"], "max-error and ratio are given; promise one of them"),
    (["--ratio", "1e6"], "the ratio is out of reach: it leaves 0 bytes for the file"),
    (["--max-error", "-1"], "--max-error"),
    (["--max-error-rel", "2"], "--max-error-rel"),
    (["--tile", "0x4x4x4"], "4x32x32x32"),
    (["--width", "many"], "--width"),
    (["--learning-rate", "nan"], "learning-rate"),
    (["--preset", "huge"], "--preset"),
    (["--t", "a"], "half-open range"),
    (["--endian", "middle"], "--endian"),
    (["--unknown"], "--unknown"),
]


@pytest.mark.parametrize(
    ("words", "message"),
    SETTINGS,
    ids=lambda value: "-".join(value) if isinstance(value, list) else None,
)
def test_unsuitable_setting(refused: Refused, inputs: Path, words: list[str], message: str) -> None:
    line = refused(
        2, "encode", inputs / "good.npy", "-o", inputs.parent / "out.fhz", "--quiet", *words
    )
    assert message in line


def test_container_is_no_input(refused: Refused, run: Path, tmp_path: Path) -> None:
    assert "fhash decode" in refused(2, "encode", run, "-o", tmp_path / "out.fhz")


REGIONS = [
    (["--t", "3"], "steps 0 to 2"),
    (["--time", "-0.1"], "time"),
    (["--time", "2001-02-10"], "the times are no dates (they have no units)"),
    (["--t", "1", "--time", "1"], "exclude"),
    (["--roi", "0:7,:,:"], "6 vertices along z"),
    (["--roi", ":,:,5:5"], "8 vertices along x"),
    (["--roi", ":,3:1"], "chooses nothing, since it ends before it begins; the domain has 7"),
    (["--roi", "0:16"], "--roi along z is 0:16, which is not all inside; the domain has 6"),
    (["--box", "-5:1"], "is -5:1; the domain has positions 0 to 2.5"),
    (["--roi", ":,:,:", "--box", ":,:,:"], "exclude"),
    (["--box", "0:2.6,:,:"], "positions 0 to 2.5"),
    (["--box", "2:1,:,:"], "ends before it begins"),
    (["--box", "0.6:0.9,:,:"], "no vertex"),
    (["--outside", "zero"], "--outside"),
    (["--dtype", "uint8"], "--outside background"),
    (["--lod", "3", "--roi", "2:3,:,:"], "holds no vertex of level of detail 3"),
    (["--lod", "1", "--roi", "0:99,:,:"], "--roi along z is 0:99"),
    (["--lod", "1", "--time", "0.5"], "lies between two"),
    (["--lod", "1", "--outside", "background"], "leave out --outside"),
]


@pytest.mark.parametrize(
    ("words", "message"),
    REGIONS,
    ids=lambda value: "-".join(value) if isinstance(value, list) else None,
)
def test_unsuitable_region(
    refused: Refused, run: Path, tmp_path: Path, words: list[str], message: str
) -> None:
    assert message in refused(2, "decode", run, "-o", tmp_path / "out.npy", *words)


def outputs(data: Path, run: Path, folder: Path) -> dict[str, list[object]]:
    """Command lines that write OUT in a folder."""
    return {
        "encode": ["encode", data, *SMALL, "-o", folder / "out.fhz"],
        "decode": ["decode", run, "-o", folder / "out.npy"],
        "zarr": ["decode", run, "-o", folder / "out.zarr"],
        "steps": ["decode", run, "-o", folder / "out.pvd"],
    }


@pytest.mark.parametrize("kind", ["encode", "decode", "zarr", "steps"])
def test_output_in_a_missing_folder(
    refused: Refused, data: Path, run: Path, tmp_path: Path, kind: str
) -> None:
    assert "does not exist" in refused(2, *outputs(data, run, tmp_path / "missing")[kind])


@pytest.mark.parametrize("kind", ["encode", "decode", "zarr", "steps"])
def test_existing_output(
    refused: Refused, data: Path, run: Path, tmp_path: Path, kind: str
) -> None:
    words = outputs(data, run, tmp_path)[kind]
    Path(str(words[-1])).write_text("old")
    assert "--force" in refused(2, *words)


@pytest.mark.parametrize("kind", ["encode", "decode", "steps"])
def test_output_that_is_a_folder_is_refused_with_force(
    refused: Refused, data: Path, run: Path, tmp_path: Path, kind: str
) -> None:
    words = outputs(data, run, tmp_path)[kind]
    Path(str(words[-1])).mkdir()
    assert "directory" in refused(2, *words, "--force")


def test_output_is_checked_before_the_input_is_read(refused: Refused, tmp_path: Path) -> None:
    assert "missing-folder" in refused(
        2, "encode", tmp_path / "no.h5", "-o", tmp_path / "missing-folder" / "out.fhz"
    )
    assert "missing-folder" in refused(
        2, "decode", tmp_path / "no.fhz", "-o", tmp_path / "missing-folder" / "out.npy"
    )


def test_full_disk_while_encoding(
    refused: Refused, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: ContainerWriter, *_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(ContainerWriter, "add_array", full)
    for words in (SMALL, PAPER):
        assert "no space left" in refused(1, "encode", data, "-o", tmp_path / "out.fhz", *words)


@contextmanager
def small_files(limit: int) -> Iterator[None]:
    """Limits files to `limit` bytes: the system fails a write half-way, as on a full disk.

    Python would leave cut bytecode of what is imported meanwhile, so it writes none.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writes, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = writes


@pytest.mark.parametrize("suffix", ["fhz", "npy", "h5", "raw", "vti", "zarr"])
def test_a_write_that_fails_half_way_leaves_nothing(
    refused: Refused, data: Path, run: Path, tmp_path: Path, suffix: str
) -> None:
    output = tmp_path / f"out.{suffix}"
    words = (
        ["encode", data, "-o", output, *SMALL]
        if suffix == "fhz"
        else ["decode", run, "--t", "0", "-o", output]
    )
    with small_files(200 if suffix == "zarr" else 1000):
        assert str(output) in refused(1, *words)
    old = b"the old file"
    if suffix != "zarr":
        output.write_bytes(old)
        with small_files(1000):
            refused(1, *words, "--force")
        assert output.read_bytes() == old


@pytest.mark.parametrize("link", [False, True])
def test_force_never_replaces_the_input(
    refused: Refused, data: Path, run: Path, tmp_path: Path, link: bool
) -> None:
    series, container = tmp_path / "tiny.h5", tmp_path / "tiny_0000.vti"
    shutil.copy(data, series)
    shutil.copy(run, container)
    output = tmp_path / "link.h5" if link else series
    if link:
        output.symlink_to(series)
    assert "is the input itself" in refused(2, "encode", series, "-o", output, "--force", *SMALL)
    assert "is the input itself" in refused(2, "encode", series, "-o", output, *SMALL)
    refused(2, "encode", tmp_path / "tin*.h5", "-o", output, "--force", *SMALL)
    assert "is the input itself" in refused(2, "decode", container, "-o", container, "--force")
    assert "is the input itself" in refused(
        2, "decode", container, "-o", tmp_path / "tiny.vti", "--force"
    )


LINES = [
    ("info", "Missing argument 'RUN.fhz|DATA' (see 'fhash info --help')"),
    ("enode", "No such command 'enode'"),
    ("encode --psnr 50", "Missing argument 'DATA'"),
    ("info x --jsn", "No such option"),
    ("info x y", "unexpected extra argument"),
    (
        "bench train x --engines native,fast",
        "'fast' is no engine; allowed, separated by commas: fused, native",
    ),
    ("bench", "Missing command; give one of "),
    ("bench foo", "No such command 'foo'"),
    ("completion", "Missing argument 'SHELL'. Choose from: bash, zsh, fish"),
    ("completion csh", "Invalid value for 'SHELL': 'csh' is not one of"),
    ("encode DATA -o x.fhz --psnr forty", "'forty' is not a valid number"),
    ("encode DATA -o x.fhz --pnsr 40", "--psnr"),  # the words around it are those of click
    ("encode DATA -o x.fhz --ratio 0.5", "0.5 is not in the range 1<=x<=1e+09"),
    ("encode DATA -o x.fhz --var a --var b", "--var is given more than once"),
    ("diff RUN DATA", "the data come first: fhash diff DATA RUN"),
    ("decode RUN -o x.npy -o y.npy", "-o is given more than once"),
    ("render RUN -o x.png --effect foo", "effect 'foo' is not known; known: shading, shadows,"),
    ("render RUN -o x.png --set foo=1", "unknown setting 'foo' of scene; known: "),
    ("render RUN -o x.png --opacity foo", "opacity 'foo' is not known; known: "),
    ("selftest --case foo", "unknown case 'foo'; known: "),
    ("selftest --group time", "unknown group 'time'; did you mean 'times'?"),
]


@pytest.mark.parametrize(("line", "words"), LINES, ids=[line for line, _ in LINES])
def test_a_wrong_line_is_refused_with_its_true_reason(
    refused: Refused,
    data: Path,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    line: str,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    names = {"DATA": str(data), "RUN": str(run)}
    message = refused(2, *(names.get(word, word) for word in line.split()))
    assert words.replace("DATA RUN", f"{data} {run}") in message


@pytest.fixture(scope="module")
def dated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of four steps of six hours, made of four files that count from their own day."""
    from fhash_formats.readers.registry import open_series

    folder = tmp_path_factory.mktemp("dated")
    for step in range(4):
        with h5py.File(folder / f"s{step}.h5", "w") as file:
            file["u"] = np.full((3, 4, 5), step, "f4") + np.arange(5, dtype="f4")
            file["time"] = [0.25 * step - (0 if step < 2 else 0.5)]
            start = "2001-02-10" if step < 2 else "2001-02-10 12:00"
            file["time"].attrs["units"] = f"days since {start}"
    with open_series(folder / "s*.h5") as series:
        fhash_codec.encode(series, folder / "run.fhz", fhash_codec.EncodeConfig(effort=1))
    return folder / "run.fhz"


@pytest.mark.parametrize(
    ("time", "step"), [("2001-02-10T06:00", 1), ("2001-02-10 09:00", 1.5), ("2001-02-10", 0)]
)
def test_decode_takes_dates(fhash: Fhash, dated: Path, time: str, step: float) -> None:
    text = fhash("decode", dated, "--time", time).stdout
    rows = dict(line.split(None, 1) for line in text.splitlines())
    assert rows["steps"] == f"{step:g}"
    assert rows["dates"] == f"2001-02-10T{6 * step:02.0f}:00".replace("T00:00", "")


HOURLY = {"units": "hours since 2010-02-01"}
LETTERS = np.array([list(f"2010-02-01_{hour:02}:00:00") for hour in range(4)], "S1")
ODD: dict[str, tuple[xr.Variable, dict[str, Any], list[float], str | None]] = {
    # the variable of the times, its encoding, the times told, and the date of step 1
    "missing": (
        xr.Variable("time", [0.0, 1, 2, np.nan], HOURLY),
        {"_FillValue": -999.0},
        [0, 1, 2, 3],
        None,
    ),
    "months": (
        xr.Variable("time", [0.5, 1.5, 2.5, 3.5], {"units": "months since 1960-01-01"}),
        {},
        [15.5, 45.5, 75.5, 106],
        "1960-02-15T12:00",
    ),
    "alias": (
        xr.Variable("time", [0, 1, 2, 3], {"units": "days since 1960-02-28", "calendar": "360"}),
        {},
        [0, 1, 2, 3],
        "1960-02-29",
    ),
    "weeks": (
        xr.Variable("time", [0, 1, 2, 3], {"units": "weeks since 1960-02-28"}),
        {},
        [0, 7, 14, 21],
        "1960-03-06",
    ),
    "unknown": (
        xr.Variable("time", [0, 1, 2, 3.5], {"units": "days since the start"}),
        {},
        [0, 1, 2, 3.5],
        None,
    ),
    "texts": (
        xr.Variable("time", np.array(["20100201", "20100203", "20100204", "20100207"], object)),
        {},
        [0, 2, 3, 6],
        "2010-02-03",
    ),
    "names": (xr.Variable("time", np.array(list("abcd"), object)), {}, [0, 1, 2, 3], None),
    "letters": (xr.Variable(("time", "length"), LETTERS), {}, [0, 1, 2, 3], "2010-02-01T01:00"),
}


KEPT = {"letters": "Times", "unknown": "time"}
"""Names under which the times of the source are kept, others than the usual one."""


def odd_series(kind: str, form: str, folder: Path) -> Any:
    """A source whose times are odd, as a file, many files, a store or a dataset."""
    variable, encoding, _, _ = ODD[kind]
    name = "Times" if kind == "letters" else "time"
    values = np.arange(4.0 * 3 * 4 * 5, dtype="f4").reshape(4, 3, 4, 5)
    data = xr.Dataset({"rho": (("time", "z", "y", "x"), values), name: variable})
    data[name].encoding = encoding
    if form == "files":
        for number in range(4):
            part = data.isel(time=slice(number, number + 1))
            part.to_netcdf(folder / f"run_{number}.nc", engine="h5netcdf")
        return folder / "run_*.nc"
    data.to_netcdf(folder / "run.nc", engine="h5netcdf")
    if form == "file":
        return folder / "run.nc"
    with xr.open_dataset(folder / "run.nc", decode_times=False) as read:
        loaded = read.load()
    if form == "store":
        loaded.to_zarr(folder / "run.zarr", consolidated=False, zarr_format=2)
        return folder / "run.zarr"
    return loaded


@pytest.mark.filterwarnings("ignore:.*Zarr V3 specification")  # of texts
@pytest.mark.parametrize("form", ["file", "store", *rarely("files", "dataset")])
@pytest.mark.parametrize("kind", ODD)
def test_odd_times_have_one_answer_everywhere(
    fhash: Fhash, tmp_path: Path, kind: str, form: str
) -> None:
    _, _, expected, date = ODD[kind]
    if (kind, form) == ("texts", "files"):
        expected = [24 * each for each in expected]  # of one step each: counted in hours
    if kind == "alias" and form == "store":
        pytest.skip("xarray cannot write it")
    path = tmp_path / "run.fhz"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)  # what stands for the times, and what differs
        fhash_codec.encode(odd_series(kind, form, tmp_path), path, EncodeConfig(effort=1, psnr=40))

    exports = {suffix: tmp_path / f"out.{suffix}" for suffix in ("nc", "zarr")}
    for output in exports.values():
        assert fhash("decode", path, "-o", output).exit_code == 0
    with fhash_codec.open(path) as volume:
        times = volume.coords["t"]
        assert np.isfinite(times.values).all()
        label = time_text(times, times.values[1])
        assert "nan" not in label
        if date is None:
            assert times.values.tolist() == expected
            assert "units" not in times.attributes
            assert label == "1"
        else:
            assert label == date
            assert time_of(times, date, "run.fhz") == times.values[1]
            assert times.values.tolist() == expected
        for options in ({}, {"decode_times": False}):
            opened = [xr.open_dataset(path, engine="fhash", **options)]
            opened += [xr.open_dataset(exports["nc"], **options)]
            opened += [xr.open_zarr(exports["zarr"], **options)]
            for dataset in opened:
                with dataset:
                    found = dataset["time"]
                    if date is None or options:
                        assert found.values.tolist() == times.values.tolist()
                    else:
                        assert found[1].dt.strftime("%Y-%m-%d").item() == date[:10]
                    if (kind, form) != ("missing", "files"):  # where the files differ
                        assert KEPT.get(kind, "time_in_source") in dataset.variables


@pytest.fixture
def url(run: Path, range_server) -> str:
    return range_server.put("run.fhz", run.read_bytes())


def told(result: Result) -> dict:
    assert (result.exit_code, result.stderr) == (0, ""), result.output
    return json.loads(result.stdout)


def test_info(fhash: Fhash, run: Path, url: str) -> None:
    here, there = told(fhash("info", run, "--json")), told(fhash("info", url, "--json"))
    assert there["path"] == url
    assert {**there, "path": ""} == {**here, "path": ""}
    assert url in fhash("info", url).stdout


def test_decode(fhash: Fhash, run: Path, url: str, tmp_path: Path) -> None:
    for place, name in ((run, "here"), (url, "there")):
        told(fhash("decode", place, "-o", tmp_path / f"{name}.npy", "--json", "--quiet"))
    np.testing.assert_array_equal(np.load(tmp_path / "there.npy"), np.load(tmp_path / "here.npy"))
    assert told(fhash("decode", url, "--t", "1", "--json", "--quiet"))["paths"] == []


def test_a_local_url_is_not_overwritten(fhash: Fhash, run: Path) -> None:
    before = run.read_bytes()
    result = fhash("export", f"file://{run}", "--plain", "-o", run, "--force")
    assert result.exit_code == 2
    assert "is the input itself" in result.stderr
    assert run.read_bytes() == before


@pytest.mark.parametrize("command", ["info", "decode", "render", "verify"])
def test_errors_are_one_line(refused: Refused, url: str, command: str) -> None:
    missing = url.replace("run", "none")
    assert f"{missing}: no such file" in refused(2, command, missing)
    assert "nowhere" in refused(2, command, "nowhere://run.fhz")


RELATIVE = 1e-3
"""Promised share of the range."""


@pytest.mark.parametrize("name", KINDS)
def test_a_source_comes_back_from_its_own_format(fhash: Fhash, tmp_path: Path, name: str) -> None:
    """Values within the promise; missing values, coordinates, times and units equal."""
    (tmp_path / "source").mkdir()
    source = KINDS[name](tmp_path / "source")
    promise = ["--max-error", 0] if source.exact else ["--max-error-rel", RELATIVE]
    words = [source.path, *source.options]

    listed = fhash("info", *words, "--json")
    assert listed.exit_code == 0, listed.stderr
    assert any(entry["commands"] for entry in json.loads(listed.stdout)["variables"])

    run = tmp_path / "run.fhz"
    encoded = fhash("encode", *words, *promise, "-o", run, "--effort", "1", "--quiet")
    assert encoded.exit_code == 0, encoded.stderr
    decoded = fhash("decode", run, "-o", tmp_path / f"out{source.suffix}", "--json", "-q")
    assert decoded.exit_code == 0, decoded.stderr
    data_range = np.ptp(source.values[np.isfinite(source.values)])
    bound = 0.0 if source.exact else RELATIVE * data_range
    with open_series(json.loads(decoded.stdout)["paths"][-1]) as series:
        assert (series.source_dtype or series.dtype).name == source.dtype
        assert source.units in (None, series.units)
        values = np.stack(list(series.frames())).astype(np.float64)
        np.testing.assert_array_equal(np.isnan(values), np.isnan(source.values))
        # the source itself may be rounded to float32
        slack = np.spacing(np.nanmax(np.abs(source.values)), dtype=np.float32)
        assert np.nanmax(np.abs(values - source.values)) <= bound + slack
        for axis, positions in source.coords.items():
            np.testing.assert_array_equal(series.coords[axis].values, positions)
        found = series.coords["t"].attributes
        assert {key: found.get(key) for key in source.time} == source.time

"""Kinds of data: what they are, and figures that find a damaged array."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import Fhash, Refused

import fhash_codec
from fhash_bench.rate import kinds_bench
from fhash_bench.rate.kinds import KINDS, Settings
from fhash_bench.rate.kinds_bench import (
    bench_kinds,
    counted_vertices,
    judge,
)
from fhash_bench.rate.mine import gradient, near_borders
from fhash_codec.config import EncodeConfig
from fhash_formats.errors import FhashError, InputError
from fhash_formats.support.values import Values

ROOT = Path(fhash_codec.__file__).parents[1]


@pytest.mark.parametrize("name", KINDS)
def test_a_kind_is_the_same_at_each_call(name: str) -> None:
    values, settings = KINDS[name].series(name, 0.25)
    again, same = KINDS[name].series(name, 0.25)
    np.testing.assert_array_equal(again, values)
    assert (settings, values.ndim) == (same, 4)
    assert np.isfinite(values).any(axis=(1, 2, 3)).all()
    EncodeConfig.from_dict(settings)


def test_kinds_are_what_their_names_say() -> None:
    made = {name: KINDS[name].series(name, 0.4) for name in KINDS}
    assert np.isnan(made["missing"][0]).mean() == pytest.approx(0.3, abs=0.01)
    assert made["thin"][0].shape[1] == 1
    assert made["thin-3"][0].shape[1] == 3
    for name, share in (("feature-shell", 0.02), ("feature-blob", 0.02), ("feature-fifth", 0.2)):
        values, settings = made[name]
        low = float(settings["features"][0].split(":")[1])
        assert (values >= low).mean() == pytest.approx(share, rel=0.01)
    types = {name: values.dtype.name for name, (values, _) in made.items()}
    assert {name: kind for name, kind in types.items() if kind != "float32"} == {
        "labels": "uint8",
        "counts": "uint16",
        "int16": "int16",
        "offset": "float64",
    }
    assert [kind.chosen for kind in KINDS.values()] == sorted(
        kind.chosen for kind in KINDS.values()
    )


@pytest.fixture
def values() -> Values:
    """Values (t, z, y, x) with some missing."""
    values, _ = KINDS["missing"].series("missing", 0.4)
    return values


def noisy(values: Values, psnr: float) -> Values:
    """Values with an alternating error of a PSNR in dB."""
    error = np.nanmax(values) - np.nanmin(values)
    signs = 1 - 2 * (np.indices(values.shape).sum(axis=0) % 2)
    return values.astype(np.float64) + signs * error * 10 ** (-psnr / 20)


@pytest.mark.parametrize(
    ("settings", "good", "bad"),
    [({}, 50.01, 49.99), ({"psnr": 45.0}, 45.01, 44.99), ({"max_error_rel": 1e-3}, 60.01, 59.99)],
)
def test_a_promise_is_kept_or_missed(
    values: Values, settings: Settings, good: float, bad: float
) -> None:
    judged = judge(values, noisy(values, good), settings)
    assert judged.kept
    assert judged.psnr == pytest.approx(good)
    assert judged.max_error == pytest.approx(10 ** (-good / 20))
    assert not judge(values, noisy(values, bad), settings).kept


@pytest.mark.parametrize("settings", [{}, {"psnr": 45.0}, {"max_error_rel": 1e-3}])
def test_damage_misses_every_promise(values: Values, settings: Settings) -> None:
    finite = np.argwhere(np.isfinite(values))[0]
    missing = np.argwhere(np.isnan(values))[0]
    for place, wrong in ((finite, np.nan), (missing, 0.0), (finite, 1e3)):
        damaged = values.copy()
        damaged[tuple(place)] = wrong
        assert not judge(values, damaged, settings).kept
    assert judge(values, values, settings).kept


def test_one_wrong_label_misses_the_exact_promise() -> None:
    labels, settings = KINDS["labels"].series("labels", 0.2)
    assert judge(labels, labels, settings).kept
    damaged = labels.copy()
    damaged[1, 2, 3, 4] += 1
    assert not judge(labels, damaged, settings).kept


def test_a_bulk_within_a_wide_range_has_a_promise() -> None:
    values = np.random.default_rng(0).normal(size=(2, 8, 16, 16))
    values[0, 0, 0, :4] = 30
    assert judge(values, noisy(values, 60), {}).kept
    assert judge(values, noisy(values, 51), {"psnr": 50.0}).kept
    assert not judge(values, noisy(values, 51), {}).kept


def test_vertices_of_a_feature_are_those_that_a_file_holds(tmp_path: Path) -> None:
    values, settings = KINDS["feature-shell"].series("feature-shell", 0.3)
    config = EncodeConfig.from_dict({**settings, "effort": 1})
    fhash_codec.encode(values, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        decoded = np.asarray(volume[...])
    np.testing.assert_array_equal(counted_vertices(values, settings), np.isfinite(decoded))
    assert judge(values, decoded, settings).kept
    assert not judge(values, np.where(np.isfinite(decoded), decoded + 0.1, np.nan), settings).kept


def test_gradient_and_spectrum_of_known_errors() -> None:
    field = KINDS["single"].series("single")[0].astype(np.float64)
    shifted, louder, exact = (judge(field, each, {}) for each in (field + 1, 1.01 * field, field))
    assert (shifted.gradient_psnr or 999) > 250
    assert shifted.spectrum_error < 1e-9
    assert louder.spectrum_error == pytest.approx(1.01**2 - 1)
    (spread,) = np.ptp(np.concatenate(list(map(gradient, field)))[None], axis=1)
    rms = np.sqrt(np.mean(np.concatenate(list(map(gradient, 0.01 * field))) ** 2))
    assert louder.gradient_psnr == pytest.approx(20 * np.log10(spread / rms))
    assert (exact.psnr, exact.gradient_psnr, exact.spectrum_error) == (None, None, 0.0)


def test_seams_are_errors_at_borders_of_tiles() -> None:
    field, _ = KINDS["single"].series("single", 0.5)
    tiles = [[8, 0, 8], [8, 0, 16], [6, 2, 16]]
    near = near_borders(field.shape[1:], tiles)
    assert [int(near.any(axis=axes).sum()) for axes in ((1, 2), (0, 2), (0, 1))] == [8, 16, 16]
    assert near[:, 7:9].all()
    assert near[:, :, [7, 8, 13, 14]].all()
    assert near.mean() == 1 - (14 / 16) * (12 / 16)
    errors = np.where(near, 0.03, 0.01)
    assert judge(field, field + errors, {}, tiles).seams == pytest.approx(3, rel=1e-3)
    assert judge(field, field + errors, {}, [[8, 0, 8], [16, 0, 16], [16, 0, 16]]).seams is None


def test_kinds_are_measured_beside_the_same_code_and_peers() -> None:
    result = bench_kinds(("labels", "single"), beside=ROOT, scale=0.5)
    labels, single = result.cases
    assert [(case.kind, case.goal) for case in result.cases] == [
        ("labels", "exact"),
        ("single", "default"),
    ]
    assert [each.coder for each in labels.figures] == ["fhash", "beside"]
    assert [each.coder for each in single.figures] == ["fhash", "beside", "SPERR"]
    assert all(each.kept for case in result.cases for each in case.figures)
    ratios = {(row["coder"], row["measure"]): row for row in result.ratios()}
    assert ratios["beside", "bytes"]["worst"] == ratios["beside", "bytes"]["mean"] == 1
    assert ratios["SPERR", "bytes"]["case"] == "single, default"
    assert result.commits.keys() == {"fhash", "beside"}


def test_kinds_are_measured_at_an_effort_and_on_all_processors() -> None:
    result = bench_kinds(("single",), names=("threads",), effort=1, scale=0.5)
    (case,) = result.cases
    assert case.settings["effort"] == 1
    one, two = case.figures
    assert (one.coder, two.coder, one.bytes) == ("fhash", "threads", two.bytes)
    assert {(row["coder"], row["measure"]) for row in result.ratios()} == {
        ("threads", "encode_seconds"),
        ("threads", "decode_seconds"),
    }


def test_unknown_kinds_and_folders_without_fhash_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'shok' is no kind; did you mean 'shock'"):
        bench_kinds(("shok",))
    with pytest.raises(InputError, match="has no package fhash_codec"):
        bench_kinds(("single",), beside=tmp_path)


def test_an_encode_that_fails_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kinds_bench, "DECODINGS", 0)
    with pytest.raises(FhashError, match="the process of fhash ended"):
        bench_kinds(("single",), scale=0.3)


def test_the_command_prints_ratios_last_and_keeps_a_record(
    fhash: Fhash, refused: Refused, tmp_path: Path
) -> None:
    record = tmp_path / "kinds.json"
    words = ("bench", "kinds", "--only", "single", "-o", record, "-q")
    result = fhash(*words)
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert lines[0].split()[:4] == ["kind", "use", "goal", "coder"]
    assert lines[1].split()[:4] == ["single", "chosen", "on", "default"]
    assert lines[-1].startswith("SPERR")
    kept = json.loads(record.read_text())
    assert {"processor", "date"} <= kept["machine"].keys()
    assert kept["cases"][0]["figures"][0]["kept"] is True
    assert "exists; use --force" in refused(2, *words)
    assert "'shok' is no kind" in refused(2, "bench", "kinds", "--only", "shok")

"""Parts of a series: which layers each has, and what no part alone can promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.appending.merging import merge
from fhash_codec.appending.parts import COLUMNS, Part, comparisons_of, encode_part
from fhash_codec.appending.series_plan import SeriesPlan, plan_parts
from fhash_formats.series import ArraySeries


@pytest.mark.parametrize("count", [1, 2, 7, 16, 100])
@pytest.mark.parametrize("of", [1, 2, 5, 16])
def test_parts_share_all_layers_evenly(count, of) -> None:
    if of > count:
        with pytest.raises(InputError, match=f"{of} parts of {count} layers"):
            Part(number=1, of=of).layers(count)
        return
    spans = [Part(number=number, of=of).layers(count) for number in range(1, of + 1)]
    assert [layer for span in spans for layer in span] == list(range(count))
    assert max(map(len, spans)) - min(map(len, spans)) <= 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "1/3/5", "-1/3", "a/b", "1/0", "1 / 3"])
def test_other_texts_name_no_part(text) -> None:
    with pytest.raises(InputError, match=r"allowed: |part"):
        Part.parse(text)
    assert Part.parse("3/16") == Part(number=3, of=16)


@pytest.mark.parametrize("config", [{"psnr": 40}, {"ratio": 9}, {}, {"profile": "paper"}])
def test_only_a_bound_is_kept_by_parts(tmp_path, config) -> None:
    with pytest.raises(InputError, match="give max_error or max_error_rel"):
        encode_part(
            np.zeros((3, 2, 2, 2), np.float32),
            tmp_path / "a.fhz",
            EncodeConfig(**config),
            Part(number=1, of=1),
        )
    assert not list(tmp_path.iterdir())


def test_errors_come_back_as_they_were_stored() -> None:
    rows = np.arange(2.0 * COLUMNS).reshape(2, COLUMNS)
    first, second = comparisons_of(rows, 5)
    assert (first.step, second.step) == (5, 6)
    assert first.coreset == (0, 1.0, 2.0, 3, 4.0)
    assert second.domain[:3] == (15, 16.0, 17.0)
    assert second.similarity == (18.0, 19)


SHAPE = (6, 4, 6, 8)
CONFIG = EncodeConfig(max_error=0.02, tile="1x4x6x8", effort=2)
FEATURES = {
    "all": ("all",),
    "interval": ("interval:0.2:9",),
    "in time": ("change:0.3", "onset:0.4"),
    "threshold": ("segmentation",),
}


def values() -> np.ndarray:
    noise = np.random.default_rng(0).random(SHAPE)
    return (np.sin(np.linspace(0, 6, SHAPE[3])) + 0.5 * noise).astype(np.float32)


class Watched(ArraySeries):
    """A series that knows which steps were read."""

    def __init__(self, array: np.ndarray) -> None:
        super().__init__(array)
        self.steps: set[int] = set()

    def read(self, step: int) -> np.ndarray:
        self.steps.add(step)
        return super().read(step)


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("case", FEATURES)
def test_a_part_with_a_plan_reads_its_own_steps_alone(tmp_path, case, missing) -> None:
    data, config = values(), replace(CONFIG, features=FEATURES[case])
    if missing:
        data[4, 1] = np.nan
    plan_parts(data, tmp_path / "run.plan", config)
    plan = SeriesPlan.read(tmp_path / "run.plan")
    parts = [tmp_path / f"{number}.fhz" for number in (1, 2, 3)]
    for number, path in enumerate(parts, start=1):
        series, beside = Watched(data), case == "in time"
        encode_part(series, path, None, Part(number=number, of=3), plan=plan)
        own = range(max(2 * number - 2 - beside, 0), min(2 * number + beside, 6))
        assert series.steps == set(own)
    merge(parts, tmp_path / "run.fhz")
    fhash_codec.encode(data, tmp_path / "whole.fhz", replace(config, timings=False))
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()


def test_a_part_refuses_a_plan_of_others(tmp_path) -> None:
    plan, one = plan_parts(values(), tmp_path / "run.plan", CONFIG), Part(number=2, of=3)
    for source, config, message in (
        (values()[:, :3], None, "they differ in shape"),
        (values() + 9, None, "step 2 has values from"),
        (np.where(values() > 1, np.nan, values()), None, "missing values, and the plan is of data"),
        (values(), replace(CONFIG, max_error=0.5), "max_error is 0.5, and 0.02 in the plan"),
    ):
        with pytest.raises(InputError, match=message):
            encode_part(source, tmp_path / "2.fhz", config, one, plan=plan)
    encode_part(values(), tmp_path / "2.fhz", CONFIG, one, plan=plan)
    assert len(list(tmp_path.iterdir())) == 2

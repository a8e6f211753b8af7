"""Whatever a source, a history or a report holds is stored as strict JSON, or as null."""

from __future__ import annotations

import contextlib
import io
import json
import math
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from properties import looking

import fhash_codec
from fhash_cli.output import emit
from fhash_codec import EncodeConfig, FhashWarning
from fhash_codec.header import brief_history, brief_quality, history_points
from fhash_formats.container import ContainerWriter
from fhash_formats.container import record as strict_json
from fhash_formats.series import ArraySeries, Coordinate
from fhash_formats.support.values import json_attributes, plain_json

TEXT = st.text(st.characters(codec=None), max_size=8)
"""Text with lone surrogates."""
NUMBERS = st.one_of(
    st.floats(),
    st.integers(),
    st.integers(-(10**320), 10**320),
    st.floats(width=32).map(np.float32),
    st.floats().map(np.longdouble),
    st.integers(0, 2**64 - 1).map(np.uint64),
    st.booleans().map(np.bool_),
    st.complex_numbers(),
    st.lists(st.floats(), max_size=3).map(np.array),
    st.lists(st.floats(), max_size=3).map(lambda numbers: np.array(numbers, "g")),
)
SCALARS = st.one_of(
    NUMBERS,
    TEXT,
    TEXT.map(np.str_),
    st.binary(max_size=6),
    st.none(),
    st.booleans(),
    st.just(np.datetime64("NaT")),
    st.just(np.zeros(1, "i4,f4")),
    st.builds(object),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.tuples(inner, inner),
        st.dictionaries(st.one_of(TEXT, st.integers(), st.floats()), inner, max_size=3),
    ),
    max_leaves=8,
)
OBJECTS = st.dictionaries(TEXT, VALUES, max_size=4)
FIGURE = st.one_of(st.none(), st.floats(), st.floats().map(np.float64))


@looking(50)
@given(value=OBJECTS)
def test_anything_becomes_strict_json_and_stays_it(value: dict[str, Any]) -> None:
    for convert in (plain_json, json_attributes):
        converted = convert(value)
        assert strict_json.loads(strict_json.dumps(converted, "it")) == converted
        assert convert(converted) == converted


@looking(50)
@given(
    points=st.lists(
        st.fixed_dictionaries({"seconds": FIGURE, "epoch": st.integers(0, 9), "psnr": FIGURE}),
        max_size=30,
    ),
    timings=st.booleans(),
)
def test_any_history_is_stored_and_read(points: list[dict[str, Any]], timings: bool) -> None:
    stored = strict_json.dumps({"history": brief_history(points, timings=timings)}, "it")
    read = history_points(strict_json.loads(stored)["history"])
    assert len(read) == min(len(points), 24)
    for point in read:
        assert all(value is None or math.isfinite(value) for value in point.values())


@looking(30)
@given(figures=st.lists(FIGURE, min_size=3, max_size=3), largest=st.floats(0))
def test_any_quality_is_stored_and_printed(figures: list[Any], largest: float) -> None:
    step = {"step": 0, "psnr": figures[0], "rmse": figures[1], "max_abs_error": largest}
    quality = {"psnr": figures[2], "max_abs_error": largest, "per_step": [step], "ssim_window": {}}
    finite = plain_json(quality)
    strict_json.dumps(
        plain_json(brief_quality(ContainerWriter("unused.fhz"), finite, 1.0, 1)), "it"
    )
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        emit({"quality": quality, "data_range": math.inf}, "", as_json=True)
    assert json.loads(printed.getvalue(), parse_constant=lambda name: 1 / 0)["data_range"] is None


@looking(8, 300)
@given(
    attributes=OBJECTS,
    along=OBJECTS,
    name=TEXT,
    units=TEXT,
    bound=st.sampled_from([0.0, 0.3, 0.9, 2.0]),
    dtype=st.sampled_from(["u1", "i2", "f4", "f8"]),
    scale=st.sampled_from([1.0, 1e300]),
)
def test_any_labels_and_any_bound_make_a_file_that_opens(
    attributes: Any, along: Any, name: str, units: str, bound: float, dtype: str, scale: float
) -> None:
    t, x = np.arange(2.0)[:, None, None, None], np.arange(6.0)
    values = np.broadcast_to(np.rint(20 + 10 * np.sin(x + t)), (2, 3, 4, 6)).copy()
    values = (values * scale if dtype == "f8" else values).astype(dtype)
    series = ArraySeries(
        values,
        name=name,
        units=units,
        coords={"x": Coordinate(name=name, values=x, attributes=along)},
    )
    series.attributes = attributes
    with tempfile.TemporaryDirectory(prefix="fhash-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        path = Path(folder) / "a.fhz"
        figures = fhash_codec.encode(
            series, path, EncodeConfig(max_error=bound, effort=1, timings=False)
        )
        with fhash_codec.open(path) as volume:
            assert volume.attrs == json_attributes(attributes, without=frozenset())
            assert volume.coords["x"].attributes == json_attributes(along, without=frozenset())
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            emit(figures, "", as_json=True)
        assert strict_json.loads(printed.getvalue().encode())["raw_bytes"] == values.nbytes

"""Labels and clipped values: any numbers.

Tiles of labels come back bit by bit, clipped values lie in their range and within their bound.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from properties import NUMBERS, Draw, looking

from fhash_formats.transform.coder import MAX_LABELS, MaskLevels, decode_labels, encode_labels
from fhash_formats.transform.decoding import decode_tile, decode_tile_mask
from fhash_formats.transform.encoding import Coding, encode_tile
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import TileSettings, labelled_stream

_T, _Z, _Y, _X = (AxisTransform(kind="5/3", depth=1) for _ in range(4))
SPEC = TransformSpec(axes=(_T, _Z, _Y, _X))
SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 4), st.integers(1, 20))


@st.composite
def labels(draw: Draw) -> tuple[npt.NDArray[np.uint16], int]:
    """Draw labels in regions, of which some are random, and their number."""
    shape, count = draw(SHAPES), draw(st.integers(1, MAX_LABELS))
    lengths = draw(st.tuples(*(st.integers(1, 20) for _ in shape)))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    places = np.indices(shape) // np.array(lengths).reshape(4, 1, 1, 1, 1)
    regions = (places * np.array([7, 5, 3, 1]).reshape(4, 1, 1, 1, 1)).sum(0) % count
    alone = random.random(shape) < draw(st.sampled_from([0.0, 0.1, 1.0]))
    return np.where(alone, random.integers(0, count, shape), regions).astype(np.uint16), count


@looking(20)
@given(drawn=labels())
def test_any_labels_come_back(
    drawn: tuple[npt.NDArray[np.uint16], int],
) -> None:
    source, count = drawn
    data = encode_labels(source, count)
    np.testing.assert_array_equal(decode_labels(data, count, source.shape), source)


@looking(60)
@given(
    dtype=st.sampled_from(NUMBERS),
    shape=SHAPES,
    masked=st.booleans(),
    own=st.booleans(),
    data=st.data(),
)
def test_tiles_of_any_few_bits_come_back(
    dtype: str, shape: tuple[int, ...], masked: bool, own: bool, data: Draw
) -> None:
    kind = np.dtype(dtype)
    unsigned = np.dtype(f"u{kind.itemsize}")
    palette = data.draw(hnp.arrays(unsigned, st.integers(1, 40)))
    random = np.random.default_rng(data.draw(st.integers(0, 99)))
    values = palette[random.integers(0, len(palette), shape)].view(kind)
    settings = TileSettings(
        transform=SPEC,
        step=1.0,
        center=0.0,
        low=0.0,
        high=1.0,
        labels=True,
        mask=MaskLevels() if masked else None,
    )
    occupied = random.random(shape) < 0.7 if masked else None
    stream = labelled_stream(values, settings if own else None, occupied)
    assert stream is not None
    decoded, mask = decode_tile_mask(stream, shape, kind, None if own else settings)  # type: ignore[arg-type]
    counted = np.ones(shape, bool) if occupied is None else occupied
    np.testing.assert_array_equal(mask, counted)
    assert decoded[counted].tobytes() == values[counted].tobytes()


@looking(60)
@given(
    dtype=st.sampled_from(["int8", "uint16", "int32", "float16", "float32", "float64"]),
    shape=SHAPES,
    power=st.integers(-8, 8),
    share=st.sampled_from([1e-3, 0.02, 0.3, 0.9]),
    data=st.data(),
)
def test_clipped_values_lie_in_their_range_and_bound(
    dtype: str, shape: tuple[int, ...], power: int, share: float, data: Draw
) -> None:
    kind = np.dtype(dtype)
    random = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    values = random.normal(size=shape) * 2.0**power
    if kind.kind != "f":
        values = np.clip(values * 64, *(np.iinfo(kind).min, np.iinfo(kind).max))
    values = values.astype(kind)
    low, high = float(values.min()), float(values.max())
    error = max(share * (high - low), 0.0 if kind.kind == "f" else 1.0)
    whole = kind.kind != "f"
    settings = TileSettings(
        transform=SPEC,
        # Coarse steps leave much to the residual, which alone can pass the ends of the range.
        step=max(error, 1e-30) * data.draw(st.sampled_from([1, 5, 20])),
        center=(low + high) / 2,
        low=low,
        high=high,
        quantum=2 * int(error) + 1.0 if whole else 1.9 * error,
        clip=True,
        double=kind.itemsize > 2,
    )
    coded = encode_tile(values, settings, Coding(error=error))
    decoded = decode_tile(coded.data, shape, kind, settings)  # type: ignore[arg-type]
    assert decoded.tobytes() == coded.decoded.tobytes()
    assert decoded.min() >= values.min()
    assert decoded.max() <= values.max()
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= error

"""The codecs of heads and masks in arrays of their own."""

from __future__ import annotations

import numpy as np
import pytest
from heads import random_head

from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.transform.parts import HeadCoder, MaskCoder, head_parameters

FLOAT = np.dtype(np.float32)


@pytest.mark.parametrize("cross", [False, True])
def test_parameters_are_the_layers_in_order(cross: bool) -> None:
    head = random_head((5, 3), cross=cross)
    data = head.to_bytes()
    size = sum(layer.weights.size + layer.biases.size for layer in head.layers)
    values = HeadCoder([{"name": "fhash.head"}], FLOAT, (size,)).decode(memoryview(data))
    np.testing.assert_array_equal(values, head_parameters(data))
    first = head.layers[0]
    np.testing.assert_array_equal(
        values[: first.weights.size].reshape(first.weights.shape),
        first.weights * np.float32(first.weight_scale),
    )
    np.testing.assert_array_equal(
        values[-1:], head.layers[-1].biases * np.float32(head.layers[-1].bias_scale)
    )
    with pytest.raises(DamagedFileError, match=f"{size} parameters; its array has {size + 1}"):
        HeadCoder([{"name": "fhash.head"}], FLOAT, (size + 1,)).decode(data)
    with pytest.raises(DamagedFileError, match="damaged neighbourhood head"):
        HeadCoder([{"name": "fhash.head"}], FLOAT, (size,)).decode(data[:-1])


def test_what_the_arrays_may_be() -> None:
    for dtype, shape in ((np.dtype(np.float64), (3,)), (FLOAT, (3, 1))):
        with pytest.raises(DamagedFileError, match="float32 with one axis"):
            HeadCoder([{"name": "fhash.head"}], dtype, shape)
    with pytest.raises(DamagedFileError, match="uint8"):
        MaskCoder([{"name": "fhash.mask"}], FLOAT, (1, 1, 1, 1))
    for codecs in ([{"name": "fhash.mask", "configuration": {"a": 1}}], [{"name": "a"}] * 2):
        with pytest.raises(UnsupportedFileError, match="no settings"):
            MaskCoder(codecs, np.dtype(np.uint8), (1, 1, 1, 1))


def test_neither_encodes_and_a_mask_is_not_decoded_alone() -> None:
    head = HeadCoder([{"name": "fhash.head"}], FLOAT, (3,))
    mask = MaskCoder([{"name": "fhash.mask"}], np.dtype(np.uint8), (1, 1, 1, 1))
    for coder in (head, mask):
        with pytest.raises(InputError):
            coder.encode(np.zeros(3))
    with pytest.raises(InputError, match=r"fhash_codec\.open"):
        mask.decode(b"")

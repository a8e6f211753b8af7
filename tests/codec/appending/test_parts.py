"""Parts of a series: which layers each has, and what no part alone can promise."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import EncodeConfig, InputError
from fhash_codec.appending.parts import COLUMNS, Part, comparisons_of, encode_part


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

"""Numbers of a step on the device: in one copy, from pinned memory, to one place for each size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pretended_cuda import CUDA, pretended_cuda

from fhash_codec.paper.engines.sending import SCALARS, Sender, Sent
from fhash_codec.training.adam import CatchUp


def sent(sender: Sender, count: int) -> tuple[Sent, list[np.ndarray]]:
    """Numbers that are sent, and the same as arrays of numpy."""
    random = np.random.default_rng(count)
    chosen = random.permutation(2**40)[:count] if count < 0 else random.integers(0, 2**40, count)
    columns = [random.random(count, dtype=np.float32) for _ in CatchUp._fields]
    scalars = [float(np.float32(number)) for number in random.random(SCALARS)]
    expected = [chosen, *columns, *map(np.float32, scalars)]
    return sender.send(chosen, CatchUp(*columns), tuple(scalars)), expected  # type: ignore[arg-type]


def received(numbers: Sent) -> list[np.ndarray]:
    columns = numbers.caught_up.cpu().numpy()
    assert columns.shape == (4, len(numbers.ids))
    scalars = (numbers.correction, numbers.pace, numbers.scale)
    return [
        numbers.ids.cpu().numpy(),
        *columns,
        *(scalar.cpu().numpy() for scalar in scalars),
    ]


@pytest.mark.parametrize("count", [1, 3, 64])
def test_numbers_arrive_as_they_were(count: int) -> None:
    numbers, expected = sent(Sender(torch.device("cpu")), count)
    for got, wanted in zip(received(numbers), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)


def test_on_a_device_they_come_to_the_same_place_for_each_size() -> None:
    with pretended_cuda() as pretended:
        sender = Sender(torch.device("cuda"))
        first, _ = sent(sender, 5)
        other, expected_of_other = sent(sender, 7)
        pretended.forget()
        again, expected = sent(sender, 5)
        assert dict(pretended.counts) == {"launches": 1, "copies": 1, "pageable": 0}
        assert first.ids.device == again.pace.device == CUDA
        assert first.ids.data_ptr() == again.ids.data_ptr() != other.ids.data_ptr()
        for numbers, wanted in ((again, expected), (other, expected_of_other)):
            for got, right in zip(received(numbers), wanted, strict=True):
                np.testing.assert_array_equal(got, right)

"""The vertices of a table that the coreset depends on."""

from __future__ import annotations

import numpy as np

from fhash_codec.paper.points import decode_region


def test_the_coreset_does_not_depend_on_what_is_not_needed(random_model) -> None:
    for table in random_model.trained[:2]:
        region = tuple(slice(0, n) for n in table.shape[:4])
        assert (~table.needed(region)).sum() > 50
    one, other = random_model.network(fill=5.0), random_model.network(fill=-7.0)
    box = tuple((0, n) for n in one.box_size)
    for key in range(5):
        mask = random_model.bricks.mask(key, box)
        np.testing.assert_array_equal(
            decode_region(one, key, box)[mask], decode_region(other, key, box)[mask]
        )

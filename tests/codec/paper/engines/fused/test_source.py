"""The sizes that kernels are compiled for, and their text."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused import points
from fhash_codec.paper.engines.fused.source import (
    COLUMNS,
    FILES,
    KERNELS,
    DeviceLimits,
    Unavailable,
    kernel_sizes,
)

H100 = DeviceLimits(
    multiprocessors=132, shared_per_block=227 << 10, shared_per_multiprocessor=228 << 10
)


@pytest.fixture
def sizes_of(noise_coreset):
    """A function of limits and of settings of the model: the sizes."""

    def make(limits=H100, shape=(2, 16, 16, 32), **settings):
        coreset = noise_coreset(shape)
        architecture = Architecture.for_box(coreset.box.shape, shape[0], **settings)
        return kernel_sizes(architecture, coreset, limits)[0]

    return make


def test_tiles_are_as_large_as_two_blocks_of_a_multiprocessor_allow(sizes_of) -> None:
    sizes = [sizes_of(width=64, hidden_layers=layers) for layers in (0, 1, 2)]
    assert [size.columns for size in sizes] == [128, 128, 64]
    for size in sizes:
        assert 2 * size.shared_bytes <= H100.shared_per_multiprocessor
        assert size.sums_in_shared


def test_gradients_are_summed_in_the_devices_memory_where_shared_memory_is_short(sizes_of) -> None:
    tight = replace(H100, shared_per_block=120 << 10, shared_per_multiprocessor=128 << 10)
    sizes = sizes_of(tight, width=128, hidden_layers=2)
    assert not sizes.sums_in_shared
    assert sizes.shared_bytes <= tight.shared_per_block


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hidden_layers": 3}, "3 hidden layers of 64"),
        ({"width": 129}, "2 hidden layers of 129"),
        ({"embedding_size": 16}, "inputs"),
        ({"limits": replace(H100, shared_per_block=1 << 12)}, "more shared memory"),
        ({"shape": (1, 1, 1, 1000)}, "more shared memory"),
    ],
)
def test_what_the_kernels_cannot_do_is_said(sizes_of, settings, message) -> None:
    with pytest.raises(Unavailable, match=message):
        sizes_of(**settings)


def test_places_in_shared_memory_follow_each_other(sizes_of) -> None:
    places = sizes_of().places
    assert list(places.values()) == sorted(places.values())
    # Vectors of four numbers are read from any of them, and doubles are kept in PARTS.
    assert all(place % 4 == 0 for place in places.values())


def test_the_text_defines_each_size_once_and_names_no_other_file(sizes_of) -> None:
    text = sizes_of().text()
    names = re.findall(r"^(?:constexpr|__constant__) (?:\w+ )+(\w+)", text, flags=re.MULTILINE)
    assert len(names) == len(set(names))
    assert {"LEVELS", "PITCH", "AT_END", "LATTICE_SHAPE"} <= set(names)
    assert "#include" not in text
    assert all((KERNELS / name).exists() for name in FILES)
    assert {path.name for path in KERNELS.iterdir()} == {*FILES, *points.FILES}


def test_kernels_fit_into_the_columns() -> None:
    for name in {*FILES, *points.FILES}:
        lines = (KERNELS / name).read_text().splitlines()
        assert len(lines) <= 400
        assert max(map(len, lines)) <= 100


def test_tiles_of_every_width_have_whole_groups_of_threads(sizes_of) -> None:
    for columns in COLUMNS:
        sizes = sizes_of(replace(H100, columns=(columns,)), width=32, hidden_layers=1)
        assert sizes.threads % (sizes.columns // 4) == 0

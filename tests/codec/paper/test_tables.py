"""Coded tables: their components, their loss, and the error that keeps a promise."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product
from math import prod
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, FhashWarning, QualityError
from fhash_codec.compact.goal import Bracket
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything, FeatureChoice, Interval
from fhash_codec.features.occupancy import unpack
from fhash_codec.features.scan import scan
from fhash_codec.paper import tables as small_parts
from fhash_codec.paper.coding import COMMON, MAX_LOSS, WRITINGS, Component, ModelCoding
from fhash_codec.paper.encode import select
from fhash_codec.paper.fit import TrainedModel
from fhash_codec.paper.model import PointSampler, PointTables, SparsePatch, decode_region
from fhash_codec.paper.network import Architecture, ArrayTable, Network, level_resolutions
from fhash_codec.paper.storage import (
    Needed,
    SparseTable,
    StoredTable,
    fringe_step,
    mix_components,
    needed_by,
    round_fringe,
    table_chunk,
    write_tables,
)
from fhash_codec.paper.tables import (
    WEIGHT_STEPS,
    CoarseTable,
    Samples,
    quantised_layers,
)
from fhash_codec.progress import silent
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import ArraySeries
from fhash_formats.transform.tile import plain_step


@pytest.mark.parametrize("key", range(5))
def test_regions_are_those_of_the_frame(random_model, key) -> None:
    bricks, coreset = random_model.bricks, random_model.selection.coreset
    size = random_model.selection.architecture.box_size
    box = tuple((0, n) for n in size)
    mask, values = bricks.mask(key, box), bricks.samples(key, box)
    occupied = unpack(coreset.occupancy[key], size)
    assert not (occupied & ~mask).any()
    assert (mask & ~occupied).any()  # the fringe
    assert 0 < mask.mean() < 1
    to_unit = random_model.selection.scanned.value_range.to_unit
    frame = random_model.field[(key, *(slice(low, high) for low, high in coreset.box))]
    np.testing.assert_array_equal(values[mask], to_unit(frame[mask]))
    embeddings = bricks.embeddings(random_model.fine, key, box)
    assert not embeddings[~mask].any()
    for region in (((1, 4), (0, 3), (7, 11)), ((3, 4), (5, 6), (2, 3))):
        inner = tuple(slice(*span) for span in region)
        np.testing.assert_array_equal(bricks.mask(key, region), mask[inner])
        np.testing.assert_array_equal(bricks.samples(key, region), values[inner])
        np.testing.assert_array_equal(
            bricks.embeddings(random_model.fine, key, region),
            embeddings[inner],
        )


def test_errors_are_those_of_the_clipped_values_at_all_samples(random_model) -> None:
    network = random_model.network()
    coreset = random_model.selection.coreset
    samples = Samples(coreset)
    box = tuple((0, n) for n in network.box_size)
    masks = [unpack(coreset.occupancy[key], network.box_size) for key in range(5)]
    # Samples of the fringe do not count: the promise is about the coreset.
    assert coreset.values.size > samples.count == sum(int(mask.sum()) for mask in masks)
    direct = 0.0
    for key, mask in enumerate(masks):
        unit = np.clip(decode_region(network, key, box).astype(np.float64), 0, 1)
        error = unit - random_model.bricks.samples(key, box)
        direct += float((error[mask] ** 2).sum())
    assert samples.error(network) == pytest.approx(direct / samples.count)
    # Here a few bricks are all.
    assert samples.error_of_few(network) == pytest.approx(direct / samples.count)
    assert samples.slopes(network).shape == (network.inputs, samples.count)


def layers(rows: int, columns: int):
    random = np.random.default_rng(0)
    return [
        (
            random.standard_normal((rows, columns)).astype(np.float32),
            random.standard_normal(rows).astype(np.float32),
        ),
        (np.ones((1, rows), np.float32), np.zeros(1, np.float32)),
    ]


def worst(changed, original) -> float:
    return max(
        float(np.square(a - b).mean()) for (a, _), (b, _) in zip(changed, original, strict=True)
    )


@pytest.mark.parametrize("allowed", [1e-2, 1e-4, 1e-6])
def test_the_largest_step_that_is_allowed_is_taken(allowed) -> None:
    original = layers(32, 16)
    quantised, scales, added = quantised_layers(
        original, lambda changed: worst(changed, original), allowed
    )
    assert scales is not None
    assert worst(quantised, original) == added <= allowed
    for part, scale in zip((part for layer in quantised for part in layer), scales, strict=True):
        numbers = part.astype(np.float64) / (scale or 1.0)
        np.testing.assert_allclose(numbers, np.rint(numbers), rtol=1e-6)
    np.testing.assert_allclose(quantised[0][1], original[0][1], atol=4 / 65534)
    # Twice the scale would have been too large.
    assert scales[0] > 0.8 * np.sqrt(12 * allowed) / 2 or scales[0] >= WEIGHT_STEPS[0] / 2


def test_layers_that_no_scale_keeps_stay_as_they_are() -> None:
    original = layers(32, 32)
    quantised, scales, added = quantised_layers(original, lambda _: 1.0, 0.5)
    assert scales is None
    assert added == 0
    assert quantised[0][0] is original[0][0]


@pytest.mark.parametrize("vertices", [1, 5000, 1 << 22])
def test_the_masks_are_the_coreset(tmp_path, waves, coded_config, monkeypatch, vertices) -> None:
    monkeypatch.setattr(small_parts, "MASK_VERTICES", vertices)
    config = replace(coded_config, epochs=1, features=("interval:50:150",), dilation=0)
    path = tmp_path / "a.fhz"
    fhash_codec.encode(waves(), path, config)
    coreset = select(ArraySeries(waves()), config, silent).coreset
    with Container.open(path) as container:
        masks, blocks = (container.arrays[name] for name in ("coreset", "occupancy"))
        block, found = (
            blocks.attributes["block"],
            list(zip(masks.read(), blocks.read()[0], strict=True)),
        )
    for (mask, bits), packed in zip(found, coreset.occupancy, strict=True):
        np.testing.assert_array_equal(mask != 0, occupancy.unpack(packed, coreset.box.shape))
        coarse = occupancy.any_of_blocks(mask != 0, block)
        np.testing.assert_array_equal(occupancy.unpack(bits, coarse.shape), coarse)
    with fhash_codec.open(path) as volume:
        both = volume.occupancy(0.5)
        np.testing.assert_array_equal(both, volume.occupancy(0) | volume.occupancy(1))


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_whole_bit_for_bit(pair, index) -> None:
    path = pair["coded"][1]
    whole = decoded(path)
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume[index], whole[index])


def test_points_and_times_between_are_as_smooth_as_before(waves, pair) -> None:
    random = np.random.default_rng(0)
    points = {
        axis: random.random(300) * (n - 1) for axis, n in zip("tzyx", waves().shape, strict=True)
    }
    with fhash_codec.open(pair["coded"][1]) as volume, fhash_codec.open(pair["exact"][1]) as other:
        values, slopes = volume.sample(**points, gradient=True)
        expected = other.sample(**points)
        finite = np.isfinite(expected)
        assert finite.sum() > 30
        np.testing.assert_array_equal(finite, np.isfinite(values))
        assert np.isfinite(slopes[finite]).all()
        span = float(np.ptp(waves()))
        assert np.sqrt(np.mean((values - expected)[finite] ** 2)) < 0.05 * span


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


def coding_of(model, psnr: float | None = None) -> ModelCoding:
    """The coding of a random model, as if it had been trained."""
    trained = SimpleNamespace(fine=model.fine, tables=model.tables, layers=list(model.layers))
    return ModelCoding.of(
        model.selection.architecture,
        model.selection.coreset,
        cast(TrainedModel, trained),
        psnr,
        silent,
    )


def test_components_keep_the_embeddings_and_lie_in_their_range(random_model) -> None:
    coding = coding_of(random_model)
    for table, components in zip(random_model.trained, coding.components, strict=True):
        mixing = np.stack([component.mixing for component in components])
        unmixing = np.stack([component.unmixing for component in components])
        np.testing.assert_allclose(unmixing @ mixing.T, np.eye(len(mixing)), atol=1e-9)
        region = tuple(slice(0, n) for n in table.shape)
        needed = table.needed(region)
        values = [
            np.stack([component.read(node) for node in range(table.shape[0])])
            for component in components
        ]
        # Each of the two float32 products and the sums lose a rounding step or so.
        largest = max(float(np.abs(each).max()) for each in values)
        tolerance = 8 * np.finfo(np.float32).eps * largest * float(np.abs(mixing).max())
        mixed = mix_components(values, mixing)
        np.testing.assert_allclose(mixed, table.read(region), atol=tolerance, rtol=1e-6)
        for component, each in zip(components, values, strict=True):
            assert component.count == needed.sum()
            assert component.value_range.ends == (each[needed].min(), each[needed].max())
            assert component.variance == pytest.approx(each[needed].var(), rel=1e-5)


def test_equal_errors_of_components_add_what_is_foretold(random_model) -> None:
    """Errors of components that know nothing of one another, however long their mixing is."""
    coding, network = coding_of(random_model), random_model.network()
    box = tuple((0, n) for n in network.box_size)
    random, size = np.random.default_rng(2), 1e-3
    tables = []
    for table, components in zip(network.tables, coding.components, strict=True):
        values = table.values.astype(np.float64)
        for component in components:
            error = random.standard_normal(values.shape[:-1])[..., None]
            values = values + size * error * component.mixing
        tables.append(ArrayTable(values))
    foretold = size**2 * sum(each.count for level in coding.components for each in level)
    found, masks = 0.0, random_model.selection.coreset.occupancy
    double = replace(network, tables=tables)
    for key, bits in enumerate(masks):
        before, after = (decode_region(each, key, box) for each in (network, double))
        inside = unpack(bits, network.box_size)
        found += float(np.square((after - before)[inside].astype(np.float64)).sum())
    assert found == pytest.approx(foretold, rel=0.3)


@pytest.mark.parametrize("gain", [-3.0, -0.5, 0.0, 0.5, 3.0])
def test_a_correction_changes_steps_by_what_is_missing(random_model, gain) -> None:
    """gain: dB of the error that coding has added beyond what it may."""
    coding = coding_of(random_model)
    found = coding.error + (coding.allowed - coding.error) * 10 ** (gain / 10)
    missing, loss = (10 * math.log10(found / each) for each in (coding.allowed, coding.exact))
    assert coding.unused(missing) == pytest.approx(-gain)
    if -0.06 < gain <= 0:
        assert coding.following(missing, loss, silent) is None
        return
    following = coding.following(missing, loss, silent)
    assert 5.5 * math.log(following.step / coding.step) == pytest.approx(-gain - 0.03)
    assert (following.kept is None) == (gain > 0)
    # Never what was tried already.
    begun = math.log(coding.step)
    for tried in (Bracket(begun, begun + 0.1), Bracket(begun - 0.1, begun)):
        between = math.log(replace(coding, tried=tried).following(missing, loss, silent).step)
        assert tried.low <= between <= tried.high
    # More is missing than coding has cost.
    assert coding.following(missing + 9, loss, silent) is None


def test_the_last_file_is_the_nearest_that_kept_the_promise(random_model) -> None:
    first = coding_of(random_model)
    second = first.following(-0.02, 0.0, silent)
    assert second.step > first.step
    third = second.following(-0.05, 0.0, silent)
    assert third.kept[1].step == first.step
    refined = replace(third, writings=COMMON).following(0.01, 0.2, silent)
    changed = [
        ours is not theirs for ours, theirs in zip(refined.tables, third.tables, strict=True)
    ]
    assert sum(changed) == 1
    last = replace(refined, writings=WRITINGS - 1).following(0.01, 0.2, silent)
    assert last.step == first.step
    assert last.following(-0.1, 0.0, silent) is None


def test_a_component_has_the_transform_that_suits_its_numbers() -> None:
    """A basis of their own suits a pattern whose strength changes at random."""
    random = np.random.default_rng(0)
    pattern = random.standard_normal((16, 1, 1, 1)) * random.standard_normal((1, 8, 12, 12))
    values = pattern.astype(np.float32)[..., None]
    one = np.ones(1)
    component = Component(
        CoarseTable(values, np.ones(pattern.shape, bool)), one.astype(np.float32), one
    )
    table = component.code(1e-4, silent)
    assert table.plan.settings.transform.axes[0].kind == "klt"
    assert 0.9e-4 < table.outcome.squares / table.outcome.count <= 1e-4


def test_components_have_one_step_and_the_error_that_they_may(random_model) -> None:
    coding = coding_of(random_model)
    tables = [table for tables in coding.tables for table in tables]
    for table in tables:
        assert plain_step(table.plan.settings) == pytest.approx(coding.step)
    squares = sum(table.outcome.squares for table in tables) / coding.samples.count
    assert squares == pytest.approx(coding.allowed - coding.error, rel=0.2)


def test_vertices_that_are_not_needed_are_not_told(random_model) -> None:
    for tables in coding_of(random_model).tables:
        for table in tables:
            assert table.plan.settings.mask is None


@pytest.fixture(scope="module")
def rough_waves(waves) -> np.ndarray:
    """Waves with noise: their tables hold many coefficients, so that their error hardly jumps."""
    noise = np.random.default_rng(0).normal(0, 3, (5, 9, 12, 20))
    return waves() + noise.astype(np.float32)


def test_the_loss_is_within_its_limit_and_what_is_said(pair) -> None:
    (exact, _), (coded, path) = pair["exact"], pair["coded"]
    loss = exact["psnr"] - coded["psnr"]
    assert exact["tables_loss_db"] is None
    assert coded["tables_loss_db"] <= MAX_LOSS + 1e-4
    if len(coded["key_frames"]) == 5:
        assert coded["tables_loss_db"] == pytest.approx(loss, abs=2e-4)
    else:
        # The loss is that at key frames alone.
        between, other = (run["quality"]["between"] for run in (coded, exact))
        loss = other["psnr_key_frames"] - between["psnr_key_frames"]
        assert loss <= MAX_LOSS + 1e-3
    with fhash_codec.open(path) as volume:
        assert volume.info["model"]["tables_loss_db"] == coded["tables_loss_db"]
        assert volume.info["model"]["tables"] == "transform"
        assert volume.info["required_features"] == ["transform"]
        assert "occupancy" in volume.container.arrays
        assert coded["bytes"] < 0.75 * exact["bytes"]
        assert volume.verify() == len(volume.info["arrays"])
    with fhash_codec.open(path) as volume, fhash_codec.open(pair["exact"][1]) as other:
        for t in (0, 1.5, 4):
            np.testing.assert_array_equal(volume.occupancy(t), other.occupancy(t))


@pytest.mark.parametrize("below", [1.0, 4.0])
def test_a_promise_is_kept_and_no_more(rough_waves, coded_config, tmp_path, below) -> None:
    source = rough_waves
    config = replace(coded_config, epochs=10)
    free = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    wanted = free["psnr"] - below
    figures = fhash_codec.encode(source, tmp_path / "b.fhz", replace(config, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.1
    assert figures["bytes"] < free["bytes"]
    lost = free["psnr"] + free["tables_loss_db"] - figures["psnr"]
    assert figures["tables_loss_db"] == pytest.approx(lost, abs=1e-3)


def test_a_promise_out_of_reach_costs_no_bytes(waves, coded_config, tmp_path) -> None:
    config = replace(coded_config, epochs=0)
    free = fhash_codec.encode(waves(), tmp_path / "a.fhz", config)
    with (
        pytest.warns(FhashWarning, match="ends at its limit of 0 more seconds: the model has"),
        pytest.raises(QualityError, match="85 dB were asked for") as missed,
    ):
        fhash_codec.encode(
            waves(), tmp_path / "b.fhz", replace(config, psnr=85.0, train_on_seconds=0)
        )
    assert "Training ended at its limit of --train-on-seconds 0: more may help" in str(missed.value)
    assert missed.value.figures["tables_loss_db"] <= MAX_LOSS + 1e-4
    assert missed.value.figures["bytes"] <= free["bytes"] + 40  # the texts of the settings


def test_training_goes_on_for_a_promise(rough_waves, coded_config, tmp_path) -> None:
    config = replace(coded_config, epochs=0)
    free = fhash_codec.encode(rough_waves, tmp_path / "a.fhz", config)
    wanted = free["psnr"] + 1.0
    figures = fhash_codec.encode(rough_waves, tmp_path / "b.fhz", replace(config, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.1
    assert figures["epochs"] > free["epochs"]


def test_epochs_asked_for_are_trained_and_no_more(waves, tmp_path) -> None:
    config = EncodeConfig(preset="published", epochs=1, width=4)
    with pytest.raises(QualityError, match=r"50 dB .*--epochs 1 ended the training") as missed:
        fhash_codec.encode(waves(), tmp_path / "a.fhz", config)
    assert missed.value.figures["epochs"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.missed.fhz"]


def test_other_readers_see_what_is_needed(pair) -> None:
    with Container.open(pair["coded"][1]) as container:
        json.dumps(container.header)
        size = container.header["model"]["embedding_size"]
        names = [name for name in container.arrays if name.startswith("table_")]
        assert len(names) == size * len(container.header["model"]["levels"])
        assert container.arrays["table_1/component_1"].shape == tuple(
            container.header["model"]["levels"][0]
        )


def coreset_of(fringe: bool) -> Coreset:
    """A plane that moves through the box from one key frame to the next."""
    values = np.zeros((3, 6, 5, 7), np.float32)
    for step in range(3):
        values[step, 2 * step : 2 * step + 2] = 1.0
    series = ArraySeries(values)
    scanned = scan(series, silent)
    return build_coreset(
        series, scanned, FeatureChoice(range(3), [Interval(0.5, 2.0)]), silent, fringe=fringe
    )


@pytest.fixture
def coreset() -> Coreset:
    return coreset_of(fringe=True)


def finest(scale: float = 1.0):
    frames = np.random.default_rng(0).standard_normal((3, 6, 5, 7, 2)).astype(np.float32)
    frames[0, 4:] = 0.0  # in no coreset beside this key frame: no samples
    frames[2, :2] = 0.0
    return lambda key: frames[key] * np.float32(scale)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1.7, 300.0])
def test_only_the_fringe_is_rounded_and_by_half_a_step_at_most(coreset, scale) -> None:
    table = finest(scale)
    step = fringe_step(coreset, 3, table)
    for key in range(3):
        rounded = round_fringe(coreset, key, table(key), step)
        inside = unpack(coreset.occupancy[key], coreset.box.shape)
        np.testing.assert_array_equal(rounded[inside], table(key)[inside])
        assert np.abs(rounded - table(key)).max() <= step / 2
        assert not np.array_equal(rounded, table(key))
        multiples = rounded[~inside] / step
        np.testing.assert_array_equal(multiples, np.rint(multiples))
        assert not np.signbit(rounded[~inside][rounded[~inside] == 0]).any()


def test_without_a_fringe_nothing_is_rounded(coreset) -> None:
    assert fringe_step(coreset, 3, lambda key: np.zeros((6, 5, 7, 2), np.float32)) is None
    table = finest()
    np.testing.assert_array_equal(round_fringe(coreset, 0, table(0), None), table(0))


@pytest.fixture(scope="module")
def tiny() -> Coreset:
    series = ArraySeries(np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5))
    return build_coreset(
        series, scan(series, silent), FeatureChoice(range(2), [Everything()]), silent
    )


class Stored:
    """Stands for a writer, and for the last array that was written."""

    def add_array(self, name, *, shape, dtype, chunk_shape, chunks, dimension_names, attributes):
        self.values = np.concatenate([chunk.reshape(-1) for chunk in chunks])
        self.shape, self.dtype, self.attributes = shape, dtype, attributes or {}

    def read(self, region):
        return self.values


def written(tiny: Coreset, kind: str, values: list[float]) -> np.ndarray:
    """The coarsest table as it is read back, of a model with `values` first in every level."""
    architecture = Architecture.for_box(tiny.box.shape, 2, embedding_size=1)
    fine = np.zeros((1, len(tiny.values)), np.float32)
    tables = [np.zeros((prod(level), 1), np.float32) for level in architecture.levels[1:]]
    for table in (fine, *tables):
        table.reshape(-1)[: len(values)] = values
    stored = Stored()
    write_tables(stored, architecture, tiny, fine, tables, kind)
    return StoredTable(stored).read(())


@pytest.mark.parametrize("kind", ["float32", "float16", "uint8"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(tiny, kind, value) -> None:
    with pytest.raises(InputError, match="not finite"):
        written(tiny, kind, [0.5, value])


def test_a_range_that_eight_bits_cannot_give_back_is_refused(tiny) -> None:
    with pytest.raises(InputError, match=r"more than uint8 holds; use --tables float32"):
        written(tiny, "uint8", [-3e38, 3e38])


@pytest.mark.parametrize(
    ("kind", "values", "within"),
    [
        ("float32", [-3e38, 1e-45, 3e38], 0.0),
        ("float16", [-65504.0, 65504.0, 6e-8], 1e-8),
        ("float16", [1e-9, -1e-9], 1e-9),
        ("uint8", [-1e38, 2e38], 3e38 / 255),
        ("uint8", [7.5], 7.5 / 255),
        ("uint8", [-1e-40, 1e-45], 6e-39),
        ("uint8", [1e-45], 6e-39),
        ("uint8", [0.0], 0.0),
    ],
)
def test_what_fits_comes_back_within_the_step_of_its_type(tiny, kind, values, within) -> None:
    back = written(tiny, kind, values).astype(np.float64)
    assert np.all(np.isfinite(back))
    exact = np.zeros(len(back), np.float32)
    exact[: len(values)] = values
    assert np.abs(back - exact.astype(np.float64)).max() <= within


@pytest.mark.parametrize("shape", [(3, 1, 1, 1, 2), (2, 300, 200, 100, 2), (9, 1, 1, 10**7, 4)])
def test_chunks_are_one_time_node_of_bounded_size(shape) -> None:
    chunk = table_chunk(shape, 4)
    assert (chunk[0], chunk[-1]) == (1, shape[-1])
    assert prod(chunk) * 4 <= 2 << 20
    assert all(1 <= n <= length for n, length in zip(chunk, shape, strict=True))


def rewritten(path, target, mixing) -> None:
    """Write the same arrays, not coded, with other attributes of a component of level 1."""
    with Container.open(path) as container, ContainerWriter(target) as writer:
        for name, array in container.arrays.items():
            attributes = mixing if name == "table_1/component_2" else dict(array.attributes)
            writer.add_whole(name, array.read(), attributes=attributes)
        writer.commit(container.header)


@pytest.fixture(scope="module")
def coded_small(tmp_path_factory):
    """A small file with coded tables of two components."""
    path = tmp_path_factory.mktemp("small") / "a.fhz"
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 4, 5, 6)), indexing="ij")
    field = (100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)).astype(np.float32)
    config = EncodeConfig(
        preset="published", epochs=2, width=16, embedding_size=2, tables="transform"
    )
    fhash_codec.encode(field, path, config)
    return path


@pytest.mark.parametrize(
    "mixing",
    [{}, {"mixing": 1.0}, {"mixing": [1.0]}, {"mixing": [1.0, "2"]}, {"mixing": [1.0, 2.0, 3.0]}],
    ids=str,
)
def test_a_mixing_of_other_numbers_is_refused(tmp_path, coded_small, mixing) -> None:
    with pytest.raises(InputError, match="array table_1/component_2 attribute mixing"):
        rewritten(coded_small, tmp_path / "a.fhz", mixing)


def test_a_mixing_beyond_float32_is_damage(tmp_path, coded_small) -> None:
    rewritten(coded_small, tmp_path / "a.fhz", {"mixing": [1e308, 0.0]})
    with (
        fhash_codec.open(tmp_path / "a.fhz") as volume,
        pytest.raises(DamagedFileError, match="not finite"),
    ):
        volume.read(0)


@pytest.mark.parametrize("fringe", [False, True])
@pytest.mark.parametrize(
    ("box", "keys", "fold"), [((5, 6, 7), 5, 2), ((1, 9, 4), 1, 2), ((4, 3, 11), 7, 3)]
)
def test_needed_are_the_corners_around_samples(box, keys, fold, fringe) -> None:
    """The law in words: every corner with a weight, of every sample, and nothing else."""
    random = np.random.default_rng(0)
    masks = random.random((keys, *box)) < 0.04
    levels = level_resolutions(box, keys, fold)
    packed = [occupancy.pack(mask) for mask in masks]
    needed = Needed(levels, packed.__getitem__, fringe=fringe)
    samples = masks.copy()
    if fringe:
        samples[1:] |= masks[:-1]
        samples[:-1] |= masks[1:]
    for number, level in enumerate(levels):
        expected = np.zeros(level, np.bool_)
        sizes = (keys, *box)
        for sample in np.argwhere(samples):
            around = [
                {p * (r - 1) // max(n - 1, 1), -(-p * (r - 1) // max(n - 1, 1))}
                for p, r, n in zip(sample.tolist(), level, sizes, strict=True)
            ]
            for corner in product(*around):
                expected[corner] = True
        if fringe:
            # Samples of the steps between need no more.
            for key, *place in np.argwhere(masks[1:] | masks[:-1]).tolist():
                for share in (0.3, 0.5, 0.8):
                    around = [
                        {int(p * (r - 1) / max(n - 1, 1)), math.ceil(p * (r - 1) / max(n - 1, 1))}
                        for p, r, n in zip((key + share, *place), level, sizes, strict=True)
                    ]
                    assert all(expected[corner] for corner in product(*around))
        found = np.stack([needed.mask(number, node) for node in range(level[0])])
        np.testing.assert_array_equal(found, expected)
        assert needed.counts(number) == expected.sum(axis=(1, 2, 3)).tolist()


FEATURE = EncodeConfig(
    preset="published",
    tables="float16",
    epochs=2,
    width=8,
    features=("interval:80:120",),
    dilation=0,
    key_frames="0,2,4",
    timings=False,
)


def sparse(network: Network, model: Any) -> Network:
    """The network with tables that hold the needed vertices of a random model alone."""
    needed = needed_by(model.selection.architecture, model.selection.coreset)
    tables = []
    for level, table in enumerate(network.tables):
        values = table.read(tuple(slice(0, n) for n in table.shape))
        masks = np.stack([needed.mask(level, node) for node in range(len(values))])
        held = values[masks]
        tables.append(
            SparseTable(
                values.shape,
                masks.sum(axis=(1, 2, 3)).tolist(),
                lambda first, end, held=held: held[first:end],
                lambda node, masks=masks: masks[node],
                f"level {level + 1}",
            )
        )
    return replace(network, tables=tables)


def test_regions_of_a_table_are_those_of_a_dense_one(random_model) -> None:
    dense = random_model.network(fill=0.0)
    chance = np.random.default_rng(0)
    for table, other in zip(sparse(dense, random_model).tables, dense.tables, strict=True):
        assert tuple(table.shape) == tuple(other.shape)
        for _ in range(20):
            spans = [sorted(chance.choice(n + 1, 2, replace=False)) for n in table.shape]
            region = tuple(slice(int(start), int(stop)) for start, stop in spans)
            np.testing.assert_array_equal(table.read(region), other.read(region))


@pytest.mark.parametrize("small", [0, 200, 10**6])
@pytest.mark.parametrize("key", [0.0, 0.4, 2.0, 3.75, 4.0])
def test_a_decoded_region_has_the_bits_of_a_dense_one(
    random_model, monkeypatch, key, small
) -> None:
    """Whichever levels get all their vertices first."""
    monkeypatch.setattr("fhash_codec.paper.model.SMALL_NUMBERS", small)
    dense = random_model.network(fill=0.0)
    network = sparse(dense, random_model)
    whole = tuple((0, n) for n in dense.box_size)
    for region in (whole, ((2, 7), (0, 12), (3, 17)), tuple((n - 1, n) for n in dense.box_size)):
        np.testing.assert_array_equal(
            decode_region(network, key, region), decode_region(dense, key, region)
        )
    requested = np.random.default_rng(1).random(dense.box_size) < 0.1
    np.testing.assert_array_equal(
        decode_region(network, key, whole, requested=requested)[requested],
        decode_region(dense, key, whole, requested=requested)[requested],
    )


@pytest.mark.parametrize("key", [0.0, 1.3, 4.0])
def test_points_of_one_time_are_found_by_ranks(random_model, key) -> None:
    """Pictures through the network do so."""
    dense = random_model.network(fill=0.0)
    network = sparse(dense, random_model)
    tables = PointTables.of_box(network, key)
    assert all(isinstance(patch, SparsePatch) for patch in tables.patches)
    chance = np.random.default_rng(3)
    places = [np.zeros(1), *(chance.random(300) * (n - 1) for n in dense.box_size)]
    for column, size in zip(places[1:], dense.box_size, strict=True):
        column[:20] = chance.integers(0, size, 20)
    read = []
    for box in (tables, PointTables.of_box(dense, key)):
        values, slopes = np.empty(300, np.float32), np.empty((300, 4), np.float32)
        PointSampler(box, key).sample(places, values, slopes, 1)
        read.append((values, slopes))
    np.testing.assert_array_equal(read[0][0], read[1][0])
    np.testing.assert_array_equal(read[0][1], read[1][1])


def test_sparse_parts_of_two_times_are_not_read_by_rank(random_model) -> None:
    tables = PointTables.of_box(sparse(random_model.network(fill=0.0), random_model), 1.3)
    with pytest.raises(AssertionError, match="at several times"):
        PointSampler(tables)
    PointSampler(tables, 1.3)


def test_numbers_that_are_not_finite_are_damage(random_model) -> None:
    network = sparse(random_model.network(fill=0.0), random_model)
    frame = network.tables[1].frame(0)
    frame.values[0, 0] = np.nan
    with pytest.raises(DamagedFileError, match="level 2 holds numbers that are not finite"):
        decode_region(network, 0.0, tuple((0, n) for n in network.box_size))


@pytest.fixture(scope="module", params=["float16", "float32", "uint8"])
def files(request, tmp_path_factory, waves) -> tuple[Path, Path]:
    """The files of one training: with all vertices, and with the needed ones alone."""
    folder = tmp_path_factory.mktemp("sparse")
    config = replace(FEATURE, tables=request.param)
    for name, share in {"dense": 0.0, "sparse": 2.0}.items():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("fhash_codec.paper.encode.SPARSE_BELOW", share)
            fhash_codec.encode(waves(), folder / f"{name}.fhz", config)
    return folder / "dense.fhz", folder / "sparse.fhz"


def test_both_files_decode_to_the_same_bits(files) -> None:
    with fhash_codec.open(files[0]) as dense, fhash_codec.open(files[1]) as other:
        assert "sparse" not in dense.info["model"]
        assert other.info["model"]["sparse"] == "fringe"
        assert other.info["required_features"] == ["sparse-tables"]
        for t in (0, 0.7, 1, 2, 3.5, 4):
            np.testing.assert_array_equal(dense.read(t), other.read(t))
        points = np.random.default_rng(0).random((2000, 4)) * [4, 8, 11, 19]
        np.testing.assert_array_equal(dense.model(points), other.model(points))
        assert np.isfinite(other.model(points)).sum() > 20


def copied(source: Path, target: Path, changes: dict[str, Any]) -> None:
    """Write the same arrays, some of them replaced by (values, attributes)."""
    with Container.open(source) as container, ContainerWriter(target) as writer:
        for name, array in container.arrays.items():
            values, attributes = changes.get(name, (array.read(), dict(array.attributes)))
            writer.add_whole(name, values, attributes=attributes)
        writer.commit(container.header)


def test_counts_that_are_not_those_of_the_occupancy_are_damage(files, tmp_path) -> None:
    with Container.open(files[1]) as container:
        table = container.arrays["table_1"]
        values, attributes = table.read(), dict(table.attributes)
        bits = container.arrays["occupancy"].read()
    first, *others = attributes["counts"]
    moved = {**attributes, "counts": [first - 1, others[0] + 1, *others[1:]]}
    copied(files[1], tmp_path / "a.fhz", {"table_1": (values, moved)})
    message = rf"a.fhz: array table_1 has {first - 1} vertices at time node 0; .* {first}$"
    with (
        fhash_codec.open(tmp_path / "a.fhz") as volume,
        pytest.raises(DamagedFileError, match=message),
    ):
        volume.read(0)
    everywhere = np.full_like(bits, 255)
    copied(files[1], tmp_path / "b.fhz", {"occupancy": (everywhere, {})})
    with (
        fhash_codec.open(tmp_path / "b.fhz") as volume,
        pytest.raises(DamagedFileError, match="the occupancy asks for"),
    ):
        volume.read(0)


def test_a_table_of_other_rows_is_refused(files, tmp_path) -> None:
    with Container.open(files[1]) as container:
        table = container.arrays["table_2"]
        values, attributes = table.read(), dict(table.attributes)
    with pytest.raises(InputError, match=r"array table_2 is .* asks for"):
        copied(files[1], tmp_path / "a.fhz", {"table_2": (values[1:], attributes)})

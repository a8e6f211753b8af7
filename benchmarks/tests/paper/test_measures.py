"""Quality between key frames."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

import fhash_codec
from fhash_bench.paper import measures as between
from fhash_bench.paper.cells import Point
from fhash_bench.paper.data import DILATION, Data, arrangement, gather_data
from fhash_bench.paper.encodings import GatherModel
from fhash_bench.paper.measures import (
    IDENTICAL,
    EncodingField,
    PictureProbe,
    masked_psnr,
    measure_between,
    measure_latency,
    measured_epochs,
    places_of,
    rank,
    train,
    view_of_feature,
)
from fhash_bench.paper.trained import TrainedEncoding, build
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import dilate, parse_feature
from fhash_codec.paper.storage import load_network
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.torch_arrays import TorchArrays
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


def test_places_of_steps(data: Data) -> None:
    places = places_of(data)
    assert [step.key for step in places] == [0, 0.5, 1, 1.5, 2]
    assert len(places[0].vertices) == data.masks[0].sum()
    assert len(places[1].vertices) == (data.masks[0] | data.masks[1]).sum()
    np.testing.assert_array_equal(places[2].truth, places[2].linear)
    middle = data.frames[0] + data.frames[1]
    np.testing.assert_allclose(places[1].linear, middle[tuple(places[1].vertices.T)] / 2, atol=1e-6)


def trained(data: Data, epochs: int, seed: int = 1) -> TrainedEncoding:
    """F-Hash on equal terms."""
    arranged = arrangement("equal", "fhash", data)
    encoding = build(
        "fhash",
        data,
        arranged,
        steps=arranged.steps[0],
        epochs=epochs,
        seed=seed,
        device=torch.device("cpu"),
    )
    for epoch in range(epochs):
        encoding.train_epoch(epoch)
    encoding.settle()
    return encoding


def test_places_of_steps_have_a_time_of_their_own(data: Data) -> None:
    """Places are integers, as `measure_between` gives them: the share of the time stays."""
    encoding, (low, step, high) = trained(data, 4), places_of(data)[:3]
    places = torch.from_numpy(step.vertices)
    assert not places.is_floating_point()
    between = encoding.sample(step.key, places)
    torch.testing.assert_close(between, encoding.sample(step.key, places.double()))
    for key in (low.key, high.key):
        assert not torch.allclose(between, encoding.sample(key, places), atol=1e-3)


def test_the_figures_are_those_of_the_codec(
    series: ArraySeries, data: Data, tmp_path: Path
) -> None:
    """The numbers of a container, in the bench's model: `fhash info` prints the same quality."""
    config = EncodeConfig(
        preset="published",
        features=("interval:0.2:2",),
        key_frames="0,2,4",
        dilation=DILATION,
        tables="float32",
        epochs=20,
    )
    fhash_codec.encode(series, tmp_path / "blob.fhz", config)
    encoding = trained(data, 1)
    model = encoding.parts[0].model
    assert isinstance(model, GatherModel)
    with fhash_codec.open(tmp_path / "blob.fhz") as volume:
        codec = volume.info["quality"]["between"]
        network = load_network(volume.container)
        tables = [level.read((slice(None),) * 5) for level in network.tables]
        table = np.concatenate([level.reshape(-1, 2) for level in tables])
        held = table if model.rank is None else table[model.rank >= 0]
        with torch.no_grad():
            for number, read in zip(
                model.numbers, [held, *itertools.chain(*network.layers)], strict=True
            ):
                number.copy_(torch.from_numpy(np.array(read)))
    bench = measure_between(encoding, places_of(data))
    assert bench["psnr_between"] == pytest.approx(codec.pop("psnr"), abs=2e-3)
    assert bench["fringe_share"] == pytest.approx(codec.pop("fringe_fraction"), abs=1e-5)
    for name, figure in codec.items():
        assert bench[name] == pytest.approx(figure, abs=2e-3)


def test_steps_after_the_last_key_frame_are_between(series: ArraySeries) -> None:
    """The last key frame stands for them, as in the codec."""
    places = places_of(gather_data("blob", series, "interval:0.2:2", "0,2,3"))
    assert [step.key for step in places] == [0, 0.5, 1, 2, 2]
    assert [step.between for step in places] == [False, True, False, False, True]


def test_few_places_of_large_steps(data: Data, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(between, "MAX_PLACES", 50)
    taken = [len(step.truth) for step in places_of(data)]
    assert 50 <= sum(taken) <= 55
    monkeypatch.undo()
    every = [len(step.truth) for step in places_of(data)]
    # No step counts for more than it has.
    assert taken == [math.ceil(50 / sum(every) * each) for each in every]


SHAPE = (6, 7, 8)
FEATURE = "interval:0.3:0.8"


class Slope:
    """An encoding whose values rise along x, trilinear everywhere, so that a frame says all."""

    def frame(self, key: int) -> np.ndarray:
        _, y, x = np.indices(SHAPE)
        return np.asarray((x + 0.25 * y + 0.1 * key) / 10, dtype=np.float32)

    def sample(self, key: int, places: torch.Tensor) -> torch.Tensor:
        return (places[:, 2] + 0.25 * places[:, 1] + 0.1 * key) / 10


def mask() -> np.ndarray:
    inside = np.zeros(SHAPE, dtype=bool)
    inside[1:5, 1:6, 2:7] = True
    return inside


@pytest.mark.parametrize("feature", [FEATURE, "isosurface:0.5"])
def test_the_picture_is_that_of_the_frame(feature: str) -> None:
    arrays, slope = TorchArrays(torch.device("cpu")), Slope()
    task = view_of_feature(SHAPE, feature, size=16)
    values = np.where(mask(), slope.frame(1), np.float32(np.nan))
    expected = march(Frame(values=values, first=(0, 0, 0)), task).rgba
    assert expected[..., 3].max() > 0.2
    evaluations = []
    for occupancy in (True, False):
        field = EncodingField(slope, 1, mask(), arrays, occupancy=occupancy)  # type: ignore[arg-type]
        drawn = stream(field, task, adaptive=True).rgba
        np.testing.assert_allclose(drawn, expected, atol=2e-3)
        evaluations.append(field.evaluations)
    assert 0 < evaluations[0] < evaluations[1]


def test_slopes_are_those_of_the_encoding() -> None:
    arrays = TorchArrays(torch.device("cpu"))
    field = EncodingField(Slope(), 0, np.ones(SHAPE, dtype=bool), arrays, occupancy=True)  # type: ignore[arg-type]
    slopes = arrays.host(field.slopes(arrays.array([[3.0, 2.0, 1.0]])))
    np.testing.assert_allclose(slopes, [[0.1, 0.025, 0]], atol=1e-6)


def test_occupancy_and_adaptive_marching_are_told_apart() -> None:
    told: list[int] = []
    found = measure_latency(
        Slope(),  # type: ignore[arg-type]
        [mask(), mask()],
        FEATURE,
        size=12,
        views=2,
        progress=lambda *words: told.append(words[1]),
    )
    assert told == list(range(1, 9))
    off, on = found["off"], found["on"]
    assert min(entry[f"{mode}_ms"] for entry in (off, on) for mode in ("stream", "arm")) > 0
    assert on["evaluations"] <= on["samples"] < off["samples"] == off["evaluations"]
    for entry in (off, on):
        assert entry["arm_passes"] < entry["stream_passes"]
    again = measure_latency(Slope(), [mask(), mask()], FEATURE, size=12, views=2)  # type: ignore[arg-type]
    assert again["on"]["samples"] == on["samples"]


Single = npt.NDArray[np.float32]

LOW, HIGH = 100.0, 300.0
FEATURES = ("interval:160:240", "isosurface:200", "segmentation:200")


def ball(radius: float, side: int = 16) -> Single:
    """Normalised values (z, y, x) that fall from 1 in the middle to 0 beyond twice the radius."""
    axis = np.arange(side) - (side - 1) / 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    far = np.sqrt(x * x + y * y + z * z)
    return np.clip(1 - far / (2 * radius), 0, 1).astype(np.float32)


def probe(feature: str, **others: float) -> PictureProbe:
    return PictureProbe(
        [ball(4), ball(6)],
        feature,
        value_range=(LOW, HIGH),
        size=32,
        **others,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("feature", FEATURES)
def test_the_truth_is_identical_and_errors_count(feature: str) -> None:
    pictures = probe(feature)
    truth = [ball(4), ball(6)]
    assert all(picture[..., 3].max() > 0.2 for picture in pictures.pictures)
    assert pictures.measure(truth) == (IDENTICAL, pytest.approx(1))
    rng = np.random.default_rng(0)
    noise = [rng.normal(0, 1, frame.shape).astype(np.float32) for frame in truth]
    near, far = (
        pictures.measure([frame + share * n for frame, n in zip(truth, noise, strict=True)])
        for share in (np.float32(0.01), np.float32(0.1))
    )
    assert far.psnr < near.psnr - 5 < IDENTICAL
    assert far.ssim < near.ssim < 1


@pytest.mark.parametrize("feature", FEATURES)
def test_the_grown_feature_is_all_that_the_picture_needs(feature: str) -> None:
    truth = [ball(4), ball(6)]
    kind = parse_feature(feature)
    masks = [dilate(kind.select(LOW + frame * (HIGH - LOW), 0), 1) for frame in truth]
    wrong = [np.where(mask, frame, 0.55) for mask, frame in zip(masks, truth, strict=True)]
    pictures = probe(feature)
    assert pictures.measure(wrong, masks).psnr > 50
    if not feature.startswith("segmentation"):  # beyond its threshold all is within the mask
        assert pictures.measure(wrong).psnr < 40


def test_another_side_is_another_picture_of_the_same_size() -> None:
    front, side = probe(FEATURES[0]), probe(FEATURES[0], azimuth=30)
    assert front.pictures[0].shape == side.pictures[0].shape == (32, 32, 4)
    assert not np.array_equal(front.pictures[0], side.pictures[0])


def test_the_camera_is_aimed_at_the_feature() -> None:
    small = np.zeros((24, 24, 24), dtype=np.float32)
    small[:8, :8, :8] = ball(2, 8)
    pictures = PictureProbe([small], "interval:0.3:2", size=32)
    alpha = pictures.pictures[0][..., 3]
    rows, columns = np.nonzero(alpha > 0.01)
    assert abs(rows.mean() - 15.5) < 2
    assert abs(columns.mean() - 15.5) < 2
    assert len(rows) > 0.05 * alpha.size


def test_a_feature_without_values_shows_all_of_them() -> None:
    pictures = PictureProbe([ball(4)], "all", size=16)
    assert pictures.pictures[0][..., 3].max() > 0.2


def test_a_malformed_feature_is_refused() -> None:
    with pytest.raises(InputError, match="malformed"):
        view_of_feature((4, 4, 4), "interval:2:1:4")


class Constant:
    """An encoding that is right in half of its epochs, and not finite in one."""

    name, tables, mlp, samples_an_epoch, steps_an_epoch = "constant", 1, 1, 10, 3

    def __init__(self, data: Data) -> None:
        self.data, self.epoch, self.settled = data, -1, True

    def train_epoch(self, epoch: int) -> None:
        assert epoch == self.epoch + 1
        self.epoch, self.settled = epoch, False

    def settle(self) -> None:
        self.settled = True

    def frame(self, key: int) -> np.ndarray:
        assert self.settled
        shift = {-1: 0.5, 0: 0.1, 1: math.nan}.get(self.epoch, 0.01)
        return (self.data.frames[key] + shift).astype(np.float32)


def test_curve(data: Data) -> None:
    told = []
    result = train(
        Constant(data),  # type: ignore[arg-type]
        data,
        3,
        device=torch.device("cpu"),
        picture=lambda frames: (float(len(frames)), 0.5),
        progress=lambda *words: told.append(words),
    )
    assert [point.epoch for point in result.curve] == [0, 1, 2, 3]
    assert [point.step for point in result.curve] == [0, 3, 6, 9]
    psnr = [point.coreset_psnr for point in result.curve]
    assert psnr[2] is None
    assert [psnr[0], psnr[1], psnr[3]] == pytest.approx([6.0206, 20, 40], abs=1e-3)
    assert result.curve[3].picture_psnr == 3.0
    seconds = [point.seconds for point in result.curve]
    assert seconds == sorted(seconds)
    assert result.seconds == seconds[-1]
    assert [words[:3] for words in told] == [("training", n, 3) for n in (1, 2, 3)]


def test_psnr_of_masked_vertices(data: Data) -> None:
    wrong = [np.where(mask, frame, 7) for frame, mask in zip(data.frames, data.masks, strict=True)]
    assert masked_psnr(data.frames, wrong, data.masks) is None  # no error
    wrong[0] = wrong[0] + np.float32(0.1)
    vertices = sum(mask.sum() for mask in data.masks)
    expected = 20 + 10 * math.log10(vertices / data.masks[0].sum())
    assert masked_psnr(data.frames, wrong, data.masks) == pytest.approx(expected, abs=1e-4)
    assert masked_psnr(data.frames, wrong, [np.zeros_like(mask) for mask in data.masks]) is None


def test_measured_epochs() -> None:
    assert measured_epochs(3) == [0, 1, 2, 3]
    assert measured_epochs(20) == list(range(21))
    for epochs in (31, 60, 200, 5000):
        found = measured_epochs(epochs)
        assert {0, 20, 30, epochs} <= set(found)
        assert len(found) < 100


def test_rank_prefers_quality_then_seconds() -> None:
    def curve(*psnr: float, each: float = 1.0) -> list[Point]:
        return [
            Point(step=n, epoch=n, seconds=each * n, coreset_psnr=value)
            for n, value in enumerate(psnr)
        ]

    ordered = [
        curve(5, 18, 19),
        curve(5, 18, 19.5),
        curve(5, 20, 33, each=2),
        curve(5, 20, 31),
        curve(5, 41, 3, each=9),
    ]
    ranks = [rank(course) for course in ordered]
    assert ranks == sorted(ranks)
    assert len(set(ranks)) == len(ranks)

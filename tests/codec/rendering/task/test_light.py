"""Shadows and surroundings against closed forms, and the native library against numpy."""

import numpy as np
import pytest

from fhash_codec import native
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.scene.scene import AmbientOcclusion, Shadows
from fhash_codec.rendering.task.light import light_grid
from fhash_codec.rendering.task.task import Frame, Table
from fhash_formats.errors import InputError

UP = np.array([0.0, 0.0, 1.0])


def frame_of(values, stride=1):
    return Frame(values=np.asarray(values, dtype=np.float32), first=(0, 0, 0), stride=stride)


def grid_of(shape, spacing=(1.0, 1.0, 1.0)):
    return Grid(counts=shape[::-1], origin=np.zeros(3), spacing=np.array(spacing))


def table_of(extinctions):
    return Table(
        low=0.0,
        high=1.0,
        colours=np.ones((len(extinctions), 3), dtype=np.float32),
        extinctions=np.array(extinctions),
    )


@pytest.mark.parametrize("resolution", [1.0, 2.0])
@pytest.mark.parametrize("spacing", [1.0, -0.5])
def test_the_shadow_within_a_slab_is_its_closed_form(way, resolution, spacing) -> None:
    shape = (41, 9, 9)
    settings = Shadows(strength=0.75, resolution=resolution)
    lamp = UP * np.sign(spacing)
    light = light_grid(
        frame_of(np.ones(shape)),
        grid_of(shape, (1, 1, spacing)),
        table_of([0.05, 0.05]),
        shadows=settings,
        lamp=lamp,
    )
    depth = (40 - np.arange(light.shares.shape[0]) * light.cell) * abs(spacing)
    exact = 1 - 0.75 * (1 - np.exp(-0.05 * depth))
    middle = light.shares[:, light.shares.shape[1] // 2, light.shares.shape[2] // 2]
    np.testing.assert_allclose(middle[:, 0], exact, atol=1e-4)
    assert np.all(middle[:, 1] == 1)
    assert light.cell == resolution
    assert light.secondary_rays == light.shares[..., 0].size


def test_a_block_throws_its_shadow_away_from_the_lamp(way) -> None:
    values = np.zeros((40, 40, 40))
    values[18:22, 18:22, 18:22] = 1.0
    lamp = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    light = light_grid(
        frame_of(values),
        grid_of(values.shape),
        table_of([0.0, 5.0]),
        shadows=Shadows(strength=1.0, resolution=1.0),
        lamp=lamp,
    )
    lamp_share = light.shares[..., 0]
    assert lamp_share[10, 20, 10] < 0.01
    assert lamp_share[30, 20, 30] > 0.99
    assert lamp_share[10, 20, 30] > 0.99
    assert lamp_share[10, 30, 10] > 0.99


def test_surroundings_take_light_only_where_there_are_any(way) -> None:
    values = np.zeros((40, 40, 40))
    values[:20] = 1.0
    settings = AmbientOcclusion(strength=0.5, radius=6.0)
    light = light_grid(
        frame_of(values), grid_of(values.shape), table_of([0.0, 50.0]), ambient_occlusion=settings
    )
    around = light.shares[:, 10, 10, 1]
    assert np.all(light.shares[..., 0] == 1)
    assert around[5] == pytest.approx(0.5, abs=0.01)
    assert around[-4] == pytest.approx(1.0, abs=0.01)
    assert np.all(np.diff(around[2:-2]) >= -1e-6)


def test_native_and_numpy_agree(monkeypatch) -> None:
    if native.library() is None:
        pytest.skip("no native library")
    values = np.random.default_rng(4).uniform(size=(23, 30, 17)).astype(np.float32)
    values[3:6, 4:9, 5:7] = np.nan
    table = table_of(np.linspace(0, 0.4, 50))
    lamp = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    found = []
    for choice in ("1", "0"):
        monkeypatch.setenv("FHASH_NATIVE", choice)
        for stride, resolution in ((1, 1.0), (1, 3.0), (2, 4.0)):
            found.append(
                light_grid(
                    frame_of(values, stride),
                    grid_of((46, 60, 34), (1.0, 0.5, 2.0)),
                    table,
                    shadows=Shadows(resolution=resolution),
                    lamp=lamp,
                    ambient_occlusion=AmbientOcclusion(),
                )
            )
    for one, other in zip(found[:3], found[3:], strict=True):
        np.testing.assert_allclose(one.shares, other.shares, atol=1e-4)
        assert one.cell == other.cell
        assert one.shares.min() >= 0
        assert one.shares.max() <= 1


def test_nothing_that_takes_light_leaves_all_of_it(way) -> None:
    for table in (None, table_of([0.0, 0.0])):
        light = light_grid(
            frame_of(np.ones((5, 5, 5))), grid_of((5, 5, 5)), table, shadows=Shadows(), lamp=UP
        )
        assert np.all(light.shares == 1)
        assert light.secondary_rays == 0


def test_shadows_need_a_lamp() -> None:
    with pytest.raises(InputError, match="lamp"):
        light_grid(
            frame_of(np.ones((5, 5, 5))),
            grid_of((5, 5, 5)),
            table_of([1.0, 1.0]),
            shadows=Shadows(),
        )

"""The float64 oracles against closed forms, and that their checks see an error."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.paper.points import sample_points
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.scene.scene import Camera
from fhash_codec.rendering.task.task import Frame, Surface, Table, Task
from fhash_codec.selftest.cases import networks
from fhash_codec.selftest.checks import oracle
from fhash_codec.selftest.checks.oracle import Oracle
from fhash_codec.selftest.checks.ray_oracle import drawn
from fhash_codec.selftest.runner import run_case

LAYERS = next(case for case in networks.CASES if case.name == "layers")


def small_network() -> Network:
    """One level of 2 x 2 x 2 x 3 corners, value t + 10 z + 100 y + 1000 x at each; a ReLU from -500, and a readout."""
    t, z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (2, 2, 2, 3)), indexing="ij")
    table = ArrayTable((t + 10 * z + 100 * y + 1000 * x)[..., None])
    first = (np.ones((1, 1), np.float32), np.array([-500.0], np.float32))
    last = (np.full((1, 1), 2.0, np.float32), np.array([0.25], np.float32))
    return Network(
        levels=((2, 2, 2, 3),),
        embedding_size=1,
        tables=[table],
        layers=(first, last),
        box_size=(3, 3, 3),
        key_frames=5,
    )


@pytest.mark.parametrize(
    ("point", "table_value"),
    [
        ((0, 0, 0, 0), 0.0),
        ((4, 2, 2, 2), 2111.0),
        ((2, 0, 0, 1), 1000.5),
        ((1, 1, 0.5, 1.75), 0.25 + 5 + 25 + 1750),
    ],
)
def test_the_oracle_is_the_definition(point, table_value):
    answer = Oracle(small_network()).at(point)
    assert answer.value == pytest.approx(2 * max(0.0, table_value - 500) + 0.25, rel=1e-14)
    assert answer.active == (table_value > 500,)
    found = sample_points(small_network(), *point)
    assert abs(float(found[0]) - answer.value) <= answer.rounding
    assert answer.rounding < 1e-2


def test_the_bound_of_rounding_is_seen_to_be_broken(monkeypatch):
    true = sample_points
    monkeypatch.setattr(
        oracle, "sample_points", lambda *given, **more: true(*given, **more) + np.float32(1e-3)
    )
    result = run_case(LAYERS, checks=())
    assert {finding.name for finding in result.findings if not finding.holds} >= {
        "float64 oracle",
        "float64 oracle, error",
    }


def test_false_gradients_are_seen(monkeypatch):
    def turned(*given, gradient):
        values, slopes = sample_points(*given, gradient=True)
        return values, slopes[:, ::-1]

    result = run_case(LAYERS, checks=())
    assert result.holds, result.failures
    monkeypatch.setattr(
        oracle,
        "sample_points",
        lambda *given, gradient=False: (
            turned(*given, gradient=True) if gradient else sample_points(*given)
        ),
    )
    assert "gradient = differences" in {
        finding.name for finding in run_case(LAYERS, checks=()).findings if not finding.holds
    }


def task_of(shape, **more) -> Task:
    grid = Grid(counts=shape[::-1], origin=np.zeros(3), spacing=np.ones(3))
    camera = Camera(view="xy", projection="parallel", parallel_scale=1.0)
    rays = Rays.of(camera, grid, (2, 2))
    return Task(rays=rays, step=0.3, threshold=0.0, **more)


@pytest.mark.parametrize("extinction", [1e-6, 0.3, 50.0])
def test_a_constant_slab_has_its_closed_form(extinction):
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.tile(np.float32([1.0, 0.5, 0.0]), (3, 1)),
        extinctions=np.full(3, extinction),
    )
    frame = Frame(values=np.full((5, 4, 4), 0.5, np.float32), first=(0, 0, 0))
    exact = -np.expm1(-4 * extinction)
    np.testing.assert_allclose(
        drawn(frame, task_of((5, 4, 4), table=table)),
        np.broadcast_to(exact * np.array([1, 0.5, 0, 1]), (2, 2, 4)),
        rtol=1e-9,
    )


def test_surfaces_and_what_is_behind_them():
    ramp = np.broadcast_to(np.arange(5, dtype=np.float32)[:, None, None], (5, 4, 4))
    surfaces = tuple(
        Surface(value=value, colour=np.array(colour), opacity=0.5)
        for value, colour in ((1.0, (0, 1, 0)), (4.0, (1, 0, 0)))
    )
    picture = drawn(
        Frame(values=ramp, first=(0, 0, 0)), task_of((5, 4, 4), table=None, surfaces=surfaces)
    )
    # Seen from above: the one at 4 lies on the face where the rays enter, the one at 1 exactly on vertices behind it.
    np.testing.assert_allclose(
        picture, np.broadcast_to([0.5, 0.25, 0.0, 0.75], (2, 2, 4)), rtol=1e-12
    )


def test_nothing_is_seen_where_a_vertex_of_weight_has_no_value():
    values = np.full((5, 4, 4), 0.5, np.float32)
    values[2] = np.nan
    table = Table(
        low=0.0, high=1.0, colours=np.ones((2, 3), np.float32), extinctions=np.full(2, 0.1)
    )
    picture = drawn(Frame(values=values, first=(0, 0, 0)), task_of((5, 4, 4), table=table))
    # Samples at 0.15, 0.45, ..., 3.75 and one of a length of 0.1 at 3.95: those from 1 to 3 lie beside the layer without values.
    lengths = 0.3 * np.count_nonzero(np.abs(np.arange(0.15, 3.9, 0.3) - 2) >= 1) + 0.1
    np.testing.assert_allclose(picture[..., 3], -np.expm1(-0.1 * lengths), rtol=1e-6)

"""Marching rays through a frame of values, natively in packets."""

from __future__ import annotations

import dataclasses

import numpy as np

from fhash_codec import native
from fhash_codec.rendering.native.march import MAX_SURFACES, march_native
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.task import Frame, Marched, Task
from fhash_formats.errors import InputError

__all__ = ["march"]


def march(
    frame: Frame, task: Task, *, bricks: Bricks | None = None, threads: int | None = None
) -> Marched:
    """March the rays of a task.

    The last step of a ray is shorter; if its sample lies beyond the box, the nearest place in the
    box is sampled. Outside a frame that is smaller than the domain nothing is seen.

    Surfaces are searched between the entry, the samples and the exit of a ray, and lie in front of
    the next sample. They are drawn over a projection.

    The depth is where less than half of the light is left, or where the maximum is, or where the
    mean begins; the nearest one of several rays of a pixel.

    Args:
        frame: the values.
        task: what to march.
        bricks: of the frame; made if None.
        threads: most threads; None for all processors.

    Raises InputError for more than MAX_SURFACES surfaces and for a step that is not above 0.
    """
    if not task.step > 0:
        raise InputError(f"a step has the length {task.step:g}; it must be above 0")
    if len(task.surfaces) > MAX_SURFACES:
        raise InputError(f"a picture has {len(task.surfaces)} surfaces; allowed: {MAX_SURFACES}")
    if bricks is None:
        bricks = Bricks.of(frame)
    if task.projection and task.surfaces:
        surfaces = dataclasses.replace(task, projection="", table=None, shaded=False)
        projection = dataclasses.replace(task, surfaces=())
        front, back = (
            march_native(native.library(), frame, part, bricks, threads)
            for part in (surfaces, projection)
        )
        return _over(front, back)
    return march_native(native.library(), frame, task, bricks, threads)


def _over(front: Marched, back: Marched) -> Marched:
    """Put one picture over another of the same rays, and add their counters."""
    depth, normal = front.depth, front.normal
    hidden = front.rgba[..., 3] > 0.5
    if depth is not None and back.depth is not None:
        depth = np.where(hidden, depth, back.depth)
    if normal is not None and back.normal is not None:
        normal = np.where(hidden[..., None], normal, back.normal)
    return Marched(
        rgba=front.rgba + (1 - front.rgba[..., 3:]) * back.rgba,
        depth=depth,
        normal=normal,
        counters={key: front.counters[key] + back.counters[key] for key in front.counters},
    )

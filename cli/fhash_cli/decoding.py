"""The frames that options of `fhash decode` select of a variable."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from fhash_cli.conversion import check_fill, convert
from fhash_cli.frame_statistics import Statistics
from fhash_cli.selection import Span, count_inside, region_of, region_of_box, steps_at, steps_of

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fhash_codec import Volume
    from fhash_codec.progress import Progress as Callback

__all__ = ["Selection"]


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Frames that the options select of an open container, and how their values are given.

    Attributes:
        steps: step indices, fractional for times between steps.
        region: vertices ((z0, z1), (y0, y1), (x0, x1)) of the domain.
        vertices: vertices of the domain along z, y and x that a frame has.
        lod: level of detail, None for every vertex.
        outside: `nan` or `background`, the values outside the coreset.
        kind: number type of the output.
        fill: value of vertices that have none; None for NaN.
    """

    steps: list[float]
    region: tuple[Span, Span, Span]
    vertices: tuple[range, range, range]
    lod: int | None
    outside: Literal["nan", "background"]
    kind: np.dtype[Any]
    fill: float | None

    @classmethod
    def of(
        cls,
        volume: Volume,
        steps: slice | None,
        times: tuple[str, ...],
        roi: Sequence[Sequence[int | None]] | None,
        box: Sequence[Sequence[float | None]] | None,
        lod: int | None,
        outside: Literal["nan", "background"],
        dtype: str | None,
        fill: float | None,
    ) -> Selection:
        """Resolve the options; raises RegionError where they leave the series or its domain."""
        import numpy as np

        from fhash_codec.value_type import holds

        chosen = steps_at(volume, times) if times else steps_of(volume, steps)
        region = region_of_box(volume, box) if box is not None else region_of(volume, roi)
        # A level of detail has its own vertices: those of the feature bounding box in the region.
        z, y, x = (
            (range(low, high) for low, high in region)
            if lod is None
            else volume.lod_vertices(lod, region)
        )
        whole = all(float(step).is_integer() for step in chosen)
        kind = np.dtype(dtype or (volume.dtype if whole else volume.float_dtype))
        own = volume.value_type.fill
        if fill is None and own is not None and kind.kind in "iu" and holds(kind, own):
            fill = own
        check_fill(kind, fill)
        return cls(
            steps=chosen,
            region=region,
            vertices=(z, y, x),
            lod=lod,
            outside=outside,
            kind=kind,
            fill=fill,
        )

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape (t, z, y, x) of the output."""
        z, y, x = self.vertices
        return len(self.steps), len(z), len(y), len(x)

    def frames(
        self, volume: Volume, statistics: Statistics, progress: Callback
    ) -> Iterator[npt.NDArray[Any]]:
        """Decode the frames (z, y, x), small ones together; all are added to the statistics."""
        from fhash_formats.support.number_types import is_wide_integer

        background, done = self.outside == "background", 0
        wide = is_wide_integer(volume.dtype) and all(float(t).is_integer() for t in self.steps)
        for steps, frames in self._decoded(volume):
            inside = count_inside(volume, steps, self.region, frames, self.outside)
            # float64 has not every integer of 64 bits.
            integers = self._integers(volume, steps) if wide else None
            statistics.add(frames, inside, integers)
            yield from convert(
                frames, self.kind, fill=self.fill, background=background, integers=integers
            )
            done += len(steps)
            progress("decoding", done, len(self.steps), "")

    def _integers(self, volume: Volume, steps: Sequence[float]) -> npt.NDArray[Any]:
        """The frames (t, z, y, x) of some whole steps as the integers that the file holds."""
        if self.lod is None:
            whole = range(int(steps[0]), int(steps[-1]) + 1)
            return volume.values_of_steps(whole, self.region, outside=self.outside)
        return volume.decoded_lod(steps[0], self.lod, self.region)[0][None]

    def _decoded(self, volume: Volume) -> Iterator[tuple[Sequence[float], npt.NDArray[Any]]]:
        """Some steps at a time, and their frames (t, z, y, x)."""
        import numpy as np

        from fhash_codec.indexing import step_blocks

        first = int(self.steps[0])
        neighbours = range(first, first + len(self.steps))
        if self.lod is None and list(neighbours) == self.steps:
            for _, steps in step_blocks(neighbours, self.shape[1:]):
                yield steps, volume.read_steps(steps, self.region, outside=self.outside)
            return
        for step in self.steps:
            frame = (
                volume.read(step, self.region, outside=self.outside)
                if self.lod is None
                else volume.read_lod(step, self.lod, self.region)
            )
            yield [step], np.expand_dims(frame, 0)

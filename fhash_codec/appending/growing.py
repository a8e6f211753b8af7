"""`GrowingFile`: a compact file that gets layer after layer, and is complete after each."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from fhash_codec.appending.figures import Figures
from fhash_codec.appending.layers import CodedLayer, LayerCoder
from fhash_codec.header import write_coordinates
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import StoredArray, describe_coordinates
from fhash_formats.container.coding import transform_codecs
from fhash_formats.container.growing import GrowingArray, GrowingContainer
from fhash_formats.container.header import NOT_STORED, TABLE
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, MAX_SPANS, Coordinate, NotStored

__all__ = ["GrowingFile"]

MAX_STEPS = 1 << 20
"""Steps of a growing file: its header tells the errors of each, and has at most 16 MiB."""


class GrowingFile:
    """A compact file under way; a context manager.

    Attributes:
        path: of the file.
        coder: of its layers.
        figures: errors of its steps.
        steps: number of steps in it.
    """

    def __init__(
        self,
        path: Path,
        coder: LayerCoder,
        header: Mapping[str, Any],
        coords: Mapping[str, Coordinate],
        figures: Figures,
        *,
        force: bool = False,
        continues: os.stat_result | None = None,
    ) -> None:
        """Prepare a file without steps.

        header: what stays the same while it grows, `variable` included. coords: of the axes "z",
        "y" and "x"; and name and attributes of "t". force: replace a file that exists. continues:
        state of the file that this one goes on from and replaces.
        """
        self.path, self.coder, self.figures = path, coder, figures
        self._header, self._coords = dict(header), dict(coords)
        self._times: list[float] = []
        self._layers = self._nonzero = 0
        self._range: ValueRange | None = None
        self._container = GrowingContainer(path, force=force, continues=continues)
        frame = tuple(coords[axis].values.size for axis in ("z", "y", "x"))
        self._name(frame)
        self._array = GrowingArray(
            name=TABLE,
            frame=frame,
            dtype=coder.dtype,
            tile=coder.tile,
            codecs=transform_codecs(coder.settings),
        )

    def __enter__(self) -> GrowingFile:
        self._container.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._container.close()

    @property
    def steps(self) -> int:
        """Number of steps that were added."""
        return len(self._times)

    @property
    def times(self) -> tuple[float, ...]:
        """Time of each step."""
        return tuple(self._times)

    @property
    def shape(self) -> tuple[int, ...]:
        """Vertices (z, y, x) of a frame."""
        return tuple(self._array.frame)

    def add(self, layer: CodedLayer, times: Sequence[float], *, publish: bool = True) -> None:
        """Write a layer; with `publish`, make the file complete with it.

        Raises InputError for a file that takes no more steps, OutputError where it cannot be
        written; it then stays as it was.
        """
        self.keep(layer.streams, times, layer.nonzero, layer.value_range)
        self.figures.steps.extend(layer.errors)
        if publish:
            self.publish()

    def carry(self, name: str, array: StoredArray) -> None:
        """Write an array that does not depend on time, as another file has it."""
        self._container.add_whole(
            name,
            array.read(),
            dimension_names=array.dimension_names,
            attributes=array.attributes,
        )

    def keep(
        self, streams: Sequence[bytes], times: Sequence[float], nonzero: int, values: ValueRange
    ) -> None:
        """Write a layer without making the file complete, nor telling its errors."""
        if len(self._times) + len(times) > MAX_STEPS:
            raise InputError(
                f"{self.path} has {len(self._times)} steps; a file has at most {MAX_STEPS}: "
                "begin another"
            )
        self._container.add_layer(self._array, self._layers, streams)
        self._layers += 1
        self._times.extend(times)
        self._nonzero += nonzero
        known = self._range or values
        self._range = ValueRange(min(known.low, values.low), max(known.high, values.high))

    def publish(self) -> None:
        """Make the file complete, with the layers so far."""
        mark = self._container.mark()
        names = self._name(self._array.frame)
        self._container.describe(self._array, self.steps)
        coords = {**self._coords, "t": self._time()}
        described = describe_coordinates(coords, names)
        write_coordinates(self._container, coords, described)
        self._container.publish(self._full_header(described), mark)

    def _name(self, frame: Sequence[int]) -> list[str]:
        """Name the arrays; the names of the axes, which stay the same for any number of steps."""
        self._container.begin(self._header["variable"])
        coordinates = [self._coords[axis].name for axis in AXES]
        return self._container.name_axes(coordinates, (self.steps, *frame))

    def _time(self) -> Coordinate:
        known = self._coords["t"]
        values = np.array(self._times, dtype=np.float64)
        return Coordinate(name=known.name, values=values, attributes=known.attributes)

    def note(self, never: NotStored | None, count: int) -> None:
        """Keep in the header what nobody wrote of the next `count` steps, and of those before."""
        variable = dict(self._header["variable"])
        before = variable.pop(NOT_STORED, None)
        told = [] if before is None else [(before, 0, self.steps)]
        told += [] if never is None else [(never.to_dict(), self.steps, count)]
        if told:
            share = sum(each["share"] * steps for each, _, steps in told) / (self.steps + count)
            spans = [
                [min(first + low, first + steps), min(first + high, first + steps)]
                for each, first, steps in told
                for low, high in each["steps"]
                if low < steps
            ]
            # of a file that keeps fewer steps than it told of, the share is a bound
            share = min(share, sum(high - low for low, high in spans) / (self.steps + count))
            fills = {each.get("fill") for each, _, _ in told}
            variable[NOT_STORED] = {"share": round(share, 6), "steps": spans[:MAX_SPANS]}
            if len(fills) == 1 and None not in fills:
                variable[NOT_STORED]["fill"] = fills.pop()
        self._header["variable"] = variable

    def _full_header(self, described: Mapping[str, Any]) -> dict[str, Any]:
        """The header of the file as it is now. described: the positions that it tells."""
        assert self._range is not None
        settings = self.coder.settings
        shape = [self.steps, *self._array.frame]
        weights = 0 if settings.head is None else settings.head.size
        return {
            **self._header,
            "required_features": ["transform"],
            "domain": {"shape": shape},
            "value_range": [self._range.low, self._range.high],
            "coordinates": described,
            "model": {
                **self._header["model"],
                "levels": [shape],
                "parameters": self._nonzero + weights,
            },
            "quality": self.figures.header(self._container, self._range.high - self._range.low),
        }

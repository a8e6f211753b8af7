"""Steps and vertices that `--t`, `--time`, `--roi` and `--box` select of an open container."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fhash_cli.options import written
from fhash_formats.errors import RegionError

if TYPE_CHECKING:
    import numpy.typing as npt

    from fhash_codec import Volume
    from fhash_formats.series import Coordinate, SourceMetadata

Span = tuple[int, int]


def steps_of(volume: Volume, chosen: slice | None, option: str = "--t") -> list[float]:
    """Indices of the steps of a slice; all steps for None.

    Raises RegionError for a slice that leaves the series or is empty.
    """
    count = volume.shape[0]
    chosen = chosen if chosen is not None else slice(None)
    low, high = _span(
        option, chosen.start, chosen.stop, count, f"the series has steps 0 to {count - 1}"
    )
    return [float(step) for step in range(low, high, chosen.step or 1)]


def time_of(volume: Volume, text: str | float) -> float:
    """The time of `--time`, a number or a date, in the units of the series.

    Raises InputError for text that is neither, and RegionError for a time outside the series.
    """
    from fhash_codec import times

    return times.time_of(volume.coords["t"], text, str(volume.path))


def steps_at(volume: Volume, times: Sequence[str]) -> list[float]:
    """Indices of the steps at times as `time_of` takes them, fractional between two steps."""
    return [volume.step_of_time(time_of(volume, time)) for time in times]


def dates_of(volume: Volume, steps: Sequence[float]) -> list[str]:
    """The dates of (fractional) steps; none where the times are no dates."""
    from fhash_codec import times

    time = volume.coords["t"]
    if not times.is_dated(time):
        return []
    chosen = coordinates(volume, steps, (range(0),) * 3)["t"].values
    return [times.time_text(time, float(value)) for value in chosen]


def region_of(
    volume: Volume, roi: Sequence[Sequence[int | None]] | None
) -> tuple[Span, Span, Span]:
    """Vertices ((z0, z1), (y0, y1), (x0, x1)) of `--roi`; the whole domain for None.

    Raises RegionError for a region that leaves the domain.
    """
    roi = roi if roi is not None else ((None, None),) * 3
    z, y, x = (
        _span(
            f"--roi along {axis}", low, high, count, f"the domain has {count} vertices along {axis}"
        )
        for axis, (low, high), count in zip("zyx", roi, volume.shape[1:], strict=True)
    )
    return z, y, x


def region_of_box(volume: Volume, box: Sequence[Sequence[float | None]]) -> tuple[Span, Span, Span]:
    """Vertices whose positions lie in `--box`, ends included.

    Raises RegionError for a box that leaves the domain or holds no vertex.
    """
    z, y, x = (_vertices(volume, axis, *ends) for axis, ends in zip("zyx", box, strict=True))
    return z, y, x


def _vertices(volume: Volume, axis: str, low: float | None, high: float | None) -> Span:
    import numpy as np

    positions = volume.coords[axis].values
    degrees = axis == "x" and str(volume.coords[axis].attributes.get("units")).startswith("degree")
    if degrees:
        from fhash_codec.rendering.grid import unwrapped

        positions = unwrapped(positions)
    first, last = float(positions.min()), float(positions.max())
    start, end = first if low is None else low, last if high is None else high
    if degrees and low is not None and not first <= start <= last:
        start, end = (each + 360 * np.ceil((first - start) / 360) for each in (start, end))
    if degrees and end < start:
        end += 360
    if degrees and first <= start <= last < end and first <= end - 360 <= last:
        raise RegionError(
            f"--box along {axis} is {start:.12g}:{end:.12g}, across the seam of the longitudes;"
            f" take two boxes, {start:.12g}:{last:.12g} and {first:.12g}:{end - 360:.12g}"
        )
    if end < start:
        raise RegionError(
            f"--box along {axis} is {start:.12g}:{end:.12g}: it ends before it begins"
        )
    if not first <= start <= last or not first <= end <= last:
        raise RegionError(
            f"--box along {axis} is {start:.12g}:{end:.12g};"
            f" the domain has positions {first:.12g} to {last:.12g}"
        )
    inside = np.flatnonzero((positions >= start) & (positions <= end))
    if not inside.size:
        raise RegionError(
            f"--box along {axis} is {start:.12g}:{end:.12g}, which holds no vertex;"
            f" the {positions.size} vertices lie further apart"
        )
    low_index, high_index = int(inside[0]), int(inside[-1]) + 1
    if high_index - low_index != inside.size:
        raise RegionError(
            f"--box along {axis} is {start:.12g}:{end:.12g}; the positions along {axis} neither"
            f" ascend nor descend, and between vertices {low_index} and {high_index - 1} some lie"
            " outside it; give vertices with --roi"
        )
    return low_index, high_index


def coordinates(
    volume: Volume, steps: Sequence[float], vertices: Sequence[range]
) -> dict[str, Coordinate]:
    """Coordinates of the (fractional) steps and of the vertices along z, y and x."""
    import numpy as np

    from fhash_formats.series import Coordinate

    coords = volume.coords
    times = np.interp(steps, np.arange(volume.shape[0]), coords["t"].values)
    values = {"t": times} | {
        axis: coords[axis].values[list(indices)]
        for axis, indices in zip("zyx", vertices, strict=True)
    }
    return {
        axis: Coordinate(name=coords[axis].name, values=cut, attributes=coords[axis].attributes)
        for axis, cut in values.items()
    }


def count_inside(
    volume: Volume,
    steps: Sequence[float],
    region: tuple[Span, Span, Span],
    frames: npt.NDArray[Any],
    outside: str,
) -> int:
    """Number of vertices of decoded frames (t, z, y, x) that are in the coreset."""
    import numpy as np

    if outside == "nan":
        return frames.size - int(np.isnan(frames).sum())
    return sum(int(volume.occupancy(step, region).sum()) for step in steps)


def metadata(
    volume: Volume, steps: Sequence[float], vertices: Sequence[range]
) -> SourceMetadata | None:
    """All that belongs to the variable in its source, at some (fractional) steps and vertices."""
    if volume.metadata is None:
        return None
    whole = all(float(step).is_integer() for step in steps)
    places = dict(zip("zyx", map(list, vertices), strict=True))
    # between two steps nothing but the values and the time is known
    times = {"t": [int(step) for step in steps] if whole else None}
    return volume.metadata.cut({**times, **places})


def _span(what: str, low: int | None, high: int | None, count: int, allowed: str) -> Span:
    """Ends of low:high among `count` as Python means them, but without its clipping."""
    first = 0 if low is None else low + count if low < 0 else low
    last = count if high is None else high + count if high < 0 else high
    if 0 <= first < last <= count:
        return first, last
    if 0 <= first < count and 0 <= last <= count:
        empty = "nothing" if first == last else "nothing, since it ends before it begins"
        reason = f"which chooses {empty}"
    else:
        reason = "which leaves the series" if what == "--t" else "which is not all inside"
    raise RegionError(f"{what} is {written(low, high)}, {reason}; {allowed}")


def opened(
    run: str, fill: float | None, features: Sequence[str], variable: str | None = None
) -> Volume:
    """An open container, with some of its features alone if any are named; see `only_features`.

    variable: which one, where the container has several.
    """
    import fhash_codec
    from fhash_codec.volume import only_features
    from fhash_codec.volume import open as open_volume

    volume = open_volume(run, variable=variable, fill=fill)
    try:
        return only_features(volume, features) if features else volume
    except fhash_codec.InputError:
        volume.close()
        raise


@contextmanager
def opened_variables(
    run: str,
    fill: float | None,
    features: Sequence[str],
    variables: str | None,
    *,
    several: bool = True,
) -> Iterator[list[Volume]]:
    """The variables of a container with names as `--var` takes them, open; all for None.

    several: whether more than one can be taken. The rest is as for `opened`.
    """
    import fhash_codec
    from fhash_codec.volume import only_features

    if not several:
        with opened(run, fill, features, variables) as volume:
            yield [volume]
        return
    with fhash_codec.open(run, fill=fill) as whole:
        every = list(whole) if isinstance(whole, fhash_codec.Dataset) else whole.container.names
        if variables is None:
            names = every
        elif variables in every:
            names = [variables]
        else:
            names = list(dict.fromkeys(part.strip() for part in variables.split(",")))
        volumes = []
        for name in names:
            whole.container.select(name)
            volume = whole[name] if isinstance(whole, fhash_codec.Dataset) else whole
            volumes.append(only_features(volume, features) if features else volume)
        yield volumes

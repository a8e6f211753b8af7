"""Cases of shapes, times, features and fronts, and the fields and settings that cases share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case, Finding, Run
from fhash_formats.errors import FhashError, RegionError
from fhash_formats.series import AXIS_NAMES, ArraySeries, Coordinate
from fhash_formats.support.values import Double, Values

Shape = tuple[int, int, int, int]

SHAPE: Shape = (4, 9, 10, 11)
"""Shape (t, z, y, x) of most cases: 3,960 values; only the number of steps is a power of two."""


def lattice(shape: Shape = SHAPE) -> tuple[Double, Double, Double, Double]:
    """The indices t, z, y and x of every vertex, each as an array of the given shape."""
    t, z, y, x = np.meshgrid(*(np.arange(float(n)) for n in shape), indexing="ij")
    return t, z, y, x


def waves(shape: Shape = SHAPE) -> Double:
    """A smooth moving field with values in 0..1; 0 and 1 both occur unless the shape has one value
    only."""
    t, z, y, x = (index / max(n - 1, 1) for index, n in zip(lattice(shape), shape, strict=True))
    values = np.sin(5 * x + 3 * t) * np.cos(4 * y) + z
    low, high = values.min(), values.max()
    return np.asarray((values - low) / (high - low if high > low else 1.0))


def noise(shape: Shape = SHAPE, seed: int = 0) -> Double:
    """White noise from a normal distribution with standard deviation 1."""
    return np.random.default_rng(seed).standard_normal(shape)


def spike(background: float, at: Shape, value: float, shape: Shape = SHAPE) -> Callable[[], Values]:
    """A function that makes a field (float32) of one number but for one vertex."""

    def make() -> Values:
        values = np.full(shape, background, dtype=np.float32)
        values[at] = value
        return values

    return make


def series(
    values: npt.NDArray[np.generic],
    *,
    times: Sequence[float] | npt.NDArray[np.float64] | None = None,
    units: str = "1",
    **axes: Double,
) -> ArraySeries:
    """A series in memory.

    Args:
        values: values (t, z, y, x).
        times: times of the steps in hours; without them the series has no times.
        units: unit of the values.
        axes: positions along z, y or x; an axis that is left out has the positions 0, 1, 2, ...
    """
    coords = {
        axis: Coordinate(name=AXIS_NAMES[axis], values=np.asarray(positions, dtype=np.float64))
        for axis, positions in axes.items()
    }
    if times is not None:
        coords["t"] = Coordinate(
            name="time",
            values=np.asarray(times, dtype=np.float64),
            attributes={"units": "hours since 2000-01-01"},
        )
    return ArraySeries(values, name="hard", units=units, coords=coords)


Settings = Mapping[str, EncodeConfig]

COMPACT: Settings = {
    "bound": EncodeConfig(max_error_rel=1e-3, effort=2),
    "psnr": EncodeConfig(psnr=50.0, effort=1),
}
EXACT: Settings = {"exact": EncodeConfig(max_error=0.0, effort=1)}
PUBLISHED: Settings = {
    "published": EncodeConfig(preset="published", tables="float16", width=8, epochs=5)
}
QUICK: Settings = {**COMPACT, **PUBLISHED}
MORE: Settings = {
    **EXACT,
    "head": EncodeConfig(psnr=60.0, effort=5),
    "bound-tight": EncodeConfig(max_error_rel=1e-6, effort=4),
    "tiles": EncodeConfig(max_error_rel=1e-2, effort=1, tile="2x3x4x5"),
    "published-float32": EncodeConfig(
        preset="published", width=16, hidden_layers=2, epochs=20, tables="float32"
    ),
    "published-uint8": EncodeConfig(
        preset="published", width=4, embedding_size=1, epochs=20, tables="uint8"
    ),
    "published-transform": EncodeConfig(preset="published", width=8, epochs=20, tables="transform"),
}
"""Additional settings of the long set."""


def of_all(settings: Settings, **changes: Any) -> dict[str, EncodeConfig]:
    """The same settings with the fields in `changes` replaced in each of them."""
    return {name: replace(config, **changes) for name, config in settings.items()}


ONE_KEY_FRAME: Settings = {
    "published-first": EncodeConfig(
        preset="published", tables="float16", width=8, epochs=5, key_frames="0"
    ),
    "published-middle": EncodeConfig(
        preset="published", tables="float16", width=8, epochs=5, key_frames="2"
    ),
}
ONE_KEY_FRAME_CODED: Settings = {
    f"{name}-transform": config
    for name, config in of_all(ONE_KEY_FRAME, tables="transform").items()
}
TILES: Settings = {
    "tiles": EncodeConfig(max_error_rel=1e-3, effort=1, tile="3x4x5x7"),
    "one-tile": EncodeConfig(psnr=50.0, effort=2, tile="whole"),
}
TILES_OF_ONE: Settings = {"bound": EncodeConfig(max_error_rel=1e-2, effort=1, tile="1x1x1x1")}


def single(make: Callable[[], Values], **coords: Any) -> Callable[[], ArraySeries]:
    """A function that makes a series of values in float32, with coordinates as `series` has them.

    The values may be another type's if it is given as `dtype`.
    """
    dtype = coords.pop("dtype", "float32")
    return lambda: series(make().astype(dtype), **coords)


def _shape_case(
    name: str, about: str, shape: Shape, settings: Settings = QUICK, **rest: Any
) -> Case:
    make = single(partial(waves, shape))
    return Case("shapes", name, about, make, settings, **{"more": MORE, **rest})


def _placed(name: str, about: str, **axes: Any) -> Case:
    """A case of positions in space. Decoding ignores them, rendering does not."""
    return Case("shapes", name, about, single(waves, **axes), QUICK)


Z, Y, X = (np.arange(float(n)) for n in SHAPE[1:])

SHAPE_CASES: tuple[Case, ...] = (
    _shape_case("one-voxel", "a series of one value", (1, 1, 1, 1)),
    _shape_case("one-voxel-in-time", "one vertex at many steps", (97, 1, 1, 1)),
    _shape_case("one-frame", "a single step", (1, 9, 10, 11)),
    _shape_case(
        "one-key-frame",
        "one key frame stands for all steps",
        SHAPE,
        ONE_KEY_FRAME,
        more=ONE_KEY_FRAME_CODED,
    ),
    *(
        _shape_case(f"one-along-{axis}", f"axis {axis} has one vertex", shape)
        for axis, shape in {"z": (4, 1, 10, 11), "y": (4, 9, 1, 11), "x": (4, 9, 10, 1)}.items()
    ),
    _shape_case("line", "one line of vertices", (3, 1, 1, 127)),
    _shape_case("twos", "two vertices along every axis", (2, 2, 2, 2)),
    _shape_case("threes", "three vertices along every axis", (3, 3, 3, 3)),
    _shape_case("primes", "lengths that are primes", (5, 7, 11, 13)),
    _shape_case("larger-primes", "lengths just above powers of two", (3, 17, 5, 37), quick=False),
    *(
        _shape_case(
            f"long-{axis}",
            f"axis {axis} is hundreds of times as long as the others",
            shape,
            quick=axis == "x",
        )
        for axis, shape in {
            "t": (512, 1, 2, 1),
            "z": (2, 2048, 1, 1),
            "y": (1, 2, 2048, 1),
            "x": (2, 1, 2, 2048),
        }.items()
    ),
    _shape_case("odd-tiles", "tiles that do not divide the lengths", SHAPE, TILES, more={}),
    _shape_case(
        "tiles-of-one", "every vertex is a tile of its own", (2, 3, 4, 3), TILES_OF_ONE, more={}
    ),
    _placed(
        "descending-positions",
        "positions that descend along every axis",
        z=-Z,
        y=7 - 0.5 * Y,
        x=1e3 - 2 * X,
    ),
    _placed("tiny-positions", "vertices 1e-12 apart", z=1e-12 * Z, y=1e-12 * Y, x=1e-12 * X),
    _placed(
        "far-positions",
        "positions whose spacing float64 can hardly resolve",
        z=1e9 + 1e-6 * Z,
        y=1e9 + 1e-6 * Y,
        x=1e9 + 1e-6 * X,
    ),
    _placed(
        "flat-positions",
        "spacings that differ by a factor of a million",
        z=1e-3 * Z,
        y=Y,
        x=1e3 * X,
    ),
    _placed("huge-positions", "vertices 1e300 apart", z=1e300 * Z, y=1e300 * Y, x=1e300 * X),
    _placed(
        "uneven-positions", "positions that grow like powers of two", z=2.0**Z, y=2.0**Y, x=2.0**X
    ),
    _placed(
        "equal-positions",
        "positions that are all equal, or NaN",
        z=0 * Z,
        y=np.full(SHAPE[2], np.nan),
        x=X,
    ),
)


STEPS = 6
"""Steps of the series."""
SETTINGS: Settings = {
    "bound": COMPACT["bound"],
    **PUBLISHED,
    "published-keys": EncodeConfig(
        preset="published", tables="float16", width=8, epochs=5, key_frames="0,2,5"
    ),
}
ENDS: Settings = {
    **SETTINGS,
    "published-ends": EncodeConfig(
        preset="published", tables="float16", width=8, epochs=5, key_frames="0,5"
    ),
}
EVEN = np.arange(float(STEPS))


def _time_case(
    name: str, about: str, times: npt.NDArray[np.float64], settings: Settings = SETTINGS
) -> Case:
    make = single(partial(waves, (len(times), *SHAPE[1:])), times=times)
    return Case("times", name, about, make, settings, MORE, (_outside,))


def _outside(run: Run) -> Iterator[Finding]:
    """Steps and times before and after the series are refused by every call that takes them."""
    volume, times = run.volume, run.series.coords["t"].values
    last = volume.shape[0] - 1
    low, high = sorted((float(times[0]), float(times[-1])))
    calls: list[Callable[[], Any]] = [
        partial(volume.read, step) for step in (-1, -1e-9, last + 1e-6, last + 1, np.inf, np.nan)
    ]
    if np.array_equal(volume.key_times.times, times):
        for time in (
            float(np.nextafter(low, -np.inf)),
            float(np.nextafter(high, np.inf)),
            -np.inf,
            np.inf,
            np.nan,
        ):
            calls += [
                partial(volume.step_of_time, time),
                partial(volume.sample, time=time, z=1, y=1, x=1),
            ]
    wrong = 0
    for call in calls:
        try:
            call()
        except RegionError:
            continue
        except FhashError:
            pass
        wrong += 1
    yield Finding("outside is refused", wrong, 0.0, "answers")


TIME_CASES: tuple[Case, ...] = (
    _time_case("uneven", "steps from 1e-3 to 1e3 long", np.cumsum([0, 1e-3, 1, 1e3, 0.5, 30])),
    _time_case("tiny", "steps of 1e-12", 1e-12 * EVEN),
    _time_case("denormal", "steps of the smallest number", 5e-324 * EVEN),
    _time_case("huge", "times from 3.5e5 hours on", 3.5e5 + EVEN),
    _time_case(
        "huge-and-fine",
        "times that are consecutive float64 numbers",
        np.array([3.5e5 + 2.0**-34 * n for n in range(STEPS)]),
    ),
    _time_case("descending", "times that run backwards", 10 - EVEN**2),
    _time_case("negative", "times before the epoch", -1e9 + 3600 * EVEN),
    _time_case(
        "both-ends", "times from -1.7e308 to 1.7e308", 1.7e308 * np.linspace(-1, 1, STEPS), ENDS
    ),
    _time_case(
        "repeated",
        "a repeated time: step numbers replace the times",
        np.array([0.0, 1, 1, 2, 3, 4]),
    ),
    _time_case(
        "not-a-time",
        "times that are NaN or infinite: step numbers replace them",
        np.array([0.0, 1, np.nan, np.inf, 4, 5]),
    ),
    _time_case(
        "one-time",
        "a single step at a time that is not 0",
        np.array([1e5])[:1],
        {"bound": COMPACT["bound"], **PUBLISHED},
    ),
)


INSIDE = "interval:10:30"
"""The interval into which `_lifted` lifts the values of the feature."""


def _feature_case(
    name: str,
    about: str,
    make: Callable[[], Values],
    features: tuple[str, ...] = (INSIDE,),
    dilation: int = 0,
    **rest: Any,
) -> Case:
    settings: Settings = rest.pop("settings", QUICK)
    tried, more = (
        of_all(given, features=features, dilation=dilation)
        for given in (settings, rest.pop("more", MORE))
    )
    return Case("features", name, about, single(make), tried, more, **rest)


def _lifted(where: Callable[..., Values]) -> Callable[[], Values]:
    """Waves in 0..1, lifted to 10..11 at the vertices that `where(t, z, y, x)` selects."""
    return lambda: np.where(where(*lattice()), 10.0, 0.0) + waves()


def _borders(t: Values, z: Values, y: Values, x: Values) -> Values:
    ends = [(index == 0) | (index == n - 1) for index, n in zip((z, y, x), SHAPE[1:], strict=True)]
    return np.asarray(np.logical_or.reduce(ends))


def _corners(t: Values, z: Values, y: Values, x: Values) -> Values:
    low, high = (z <= 1) & (y <= 1) & (x <= 1), (z >= 7) & (y >= 8) & (x >= 9)
    return np.asarray(np.where(t % 2 == 0, low, high) | (low & (t == 3)))


def _vertex(t: Values, z: Values, y: Values, x: Values) -> Values:
    return np.asarray((z == 4) & (y == 5) & (x == 2 + t))


def _ends(t: Values, z: Values, y: Values, x: Values) -> Values:
    """Selects two opposite corners, so that the bounding box is the whole domain."""
    return np.asarray(((z == 0) & (y == 0) & (x == 0)) | ((z == 8) & (y == 9) & (x == 10)))


def _with_holes() -> Values:
    """A feature that touches missing values."""
    values = _lifted(lambda t, z, y, x: x > 4)()
    t, _, y, x = lattice()
    values[(y == 5) | ((t == 2) & (x < 6))] = np.nan
    return values


KEYS = EncodeConfig(preset="published", width=8, epochs=5, key_frames="0,2,3", tables="transform")

FEATURE_CASES: tuple[Case, ...] = (
    _feature_case(
        "at-every-border", "a feature that is the surface of the domain", _lifted(_borders)
    ),
    _feature_case(
        "at-every-border-grown",
        "the surface of the domain, grown beyond the domain",
        _lifted(_borders),
        dilation=64,
    ),
    _feature_case("one-vertex", "a feature of one vertex that moves", _lifted(_vertex)),
    _feature_case(
        "one-vertex-grown", "a feature of one vertex, grown by one", _lifted(_vertex), dilation=1
    ),
    _feature_case("opposite-corners", "a feature in opposite corners in turn", _lifted(_corners)),
    _feature_case("whole-box", "two vertices whose bounding box is the domain", _lifted(_ends)),
    _feature_case("everything", "an interval that holds all values", waves, ("interval:-1:2",)),
    _feature_case(
        "empty-key-frames",
        "a feature that is empty in some key frames",
        _lifted(lambda t, z, y, x: (t == 2) & (x > 3)),
        settings={**QUICK, "published-keys": KEYS},
    ),
    _feature_case(
        "one-key-frame-filled",
        "a feature that exists only at the last step",
        _lifted(lambda t, z, y, x: (t == 3) & (y == 2)),
    ),
    _feature_case(
        "every-second-vertex",
        "a feature of which no two vertices touch",
        _lifted(lambda t, z, y, x: (t + z + y + x) % 2 == 0),
    ),
    _feature_case("beside-missing", "a feature that meets missing values", _with_holes, dilation=1),
    _feature_case("open-interval", "an interval from -inf to inf", waves, ("interval:-inf:inf",)),
    _feature_case(
        "one-value", "an interval of one value", lambda: np.rint(10 * waves()), ("interval:5:5",)
    ),
    _feature_case(
        "surface-on-vertices",
        "an isosurface through vertices",
        lambda: np.rint(10 * waves()),
        ("isosurface:5",),
    ),
    _feature_case(
        "surface-at-the-end", "an isosurface at the largest value", waves, ("isosurface:1",)
    ),
    _feature_case(
        "two-features", "two features that overlap", waves, ("interval:0.2:0.6", "isosurface:0.6")
    ),
    _feature_case(
        "segmented-step",
        "segmentation of values that form two clusters",
        _lifted(lambda t, z, y, x: x > 5),
        ("segmentation",),
        1,
    ),
    _feature_case(
        "nothing-selected",
        "refused: the feature selects no vertex",
        waves,
        ("interval:5:6",),
        more={},
        refused="selects nothing",
    ),
)


def _front_case(
    name: str,
    about: str,
    make: Callable[[], Values],
    settings: Settings = QUICK,
    dtype: str = "float32",
    **rest: Any,
) -> Case:
    return Case("fronts", name, about, single(make, dtype=dtype), settings, MORE, **rest)


def _checkerboard() -> Values:
    t, z, y, x = lattice()
    return np.asarray((t + z + y + x) % 2)


def _spikes() -> Values:
    t, z, y, x = lattice()
    return np.where((z % 4 == 0) & (y % 4 == 1) & (x % 4 == 2) & (t % 2 == 0), 1e6, 0.0) * np.where(
        x > 5, 1, -1
    )


def _step(place: float) -> Callable[[], Values]:
    """A step along x: 0 before `place`, 1 behind it, 0.5 on it."""
    return lambda: np.heaviside(lattice()[3] - place, 0.5)


def _front(speed: float, width: float) -> Callable[[], Values]:
    """A plane front, oblique to all axes, that moves `speed` vertices per step and is `width`
    vertices wide."""

    def make() -> Values:
        t, z, y, x = lattice()
        return np.asarray(np.tanh(((x + 2 * y + 3 * z) / np.sqrt(14) - 7.3 - speed * t) / width))

    return make


def _shell() -> Values:
    t, z, y, x = lattice()
    radius = np.sqrt((z - 4) ** 2 + (y - 4.5) ** 2 + (x - 5) ** 2)
    return np.where(radius < 1.5 + 0.3 * t, 1e3, np.where(radius < 2.5 + 0.3 * t, -1e3, 0.0))


FRONT_CASES: tuple[Case, ...] = (
    _front_case(
        "checkerboard", "0 and 1 alternate along every axis", _checkerboard, {**QUICK, **EXACT}
    ),
    _front_case(
        "checkerboard-uint8",
        "0 and 1 alternate along every axis",
        _checkerboard,
        {**QUICK, **EXACT},
        dtype="uint8",
    ),
    _front_case(
        "flicker",
        "the sign changes with every step",
        lambda: (-1) ** lattice()[0] * (1 + lattice()[3]),
    ),
    _front_case("white-noise", "white noise: no value can be predicted", noise),
    _front_case(
        "white-noise-float64",
        "white noise: no value can be predicted",
        noise,
        dtype="float64",
        quick=False,
    ),
    _front_case(
        "white-noise-int16",
        "white noise: no value can be predicted",
        lambda: 1e4 * noise(),
        {**QUICK, **EXACT},
        dtype="int16",
    ),
    _front_case("spike", "one value of 1e6, all others 0", spike(0.0, (1, 4, 5, 6), 1e6)),
    _front_case("spikes", "values of 1e6 and -1e6, four vertices apart", _spikes),
    _front_case("step-on-vertex", "a step whose middle is on a vertex", _step(5.0)),
    _front_case("step-between", "a step between two vertices", _step(5.5)),
    _front_case(
        "slow-front",
        "a front narrower than a vertex that moves 0.3 vertices a step",
        _front(0.3, 0.05),
    ),
    _front_case(
        "creeping-front",
        "a front that moves 0.001 vertices a step",
        _front(0.001, 0.05),
        quick=False,
    ),
    _front_case(
        "fast-front", "a front that moves 4 vertices a step", _front(4.0, 0.05), quick=False
    ),
    _front_case("thin-shell", "a shell one vertex thick that grows 0.3 vertices a step", _shell),
)

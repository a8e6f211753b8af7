"""A region with labels of every kind, for the tests of the writers that keep labels."""

from __future__ import annotations

from typing import Any

import numpy as np

from fhash_formats.series import Coordinate
from fhash_formats.writers import Region

SHAPE = (3, 4, 5, 6)


HOURS = 347921.000277 + np.array([0.0, 1.0, 3.5])


"""Times that float32 cannot hold."""
COORDS = {
    "t": Coordinate(
        name="time",
        values=HOURS,
        attributes={
            "units": "hours since 1970-01-01",
            "calendar": "gregorian",
            "standard_name": "time",
            "bounds": "time_bnds",
        },
    ),
    "z": Coordinate(
        name="height",
        values=np.array([5.0, 21.666664123535156, 45.0, 75.0]),
        attributes={"units": "m", "positive": "up"},
    ),
    "y": Coordinate(
        name="lat",
        values=np.linspace(1, -1, 5),
        attributes={"units": "degrees_north", "axis": "Y", "scale_factor": 0.5},
    ),
    "x": Coordinate(name="lon", values=np.linspace(0.1, 0.7, 6)),
}


"""Uneven, descending and described coordinates."""
ATTRIBUTES = {
    "standard_name": "air_temperature",
    "scale_factor": 0.5,
    "add_offset": 100.0,
    "_FillValue": 3.0,
    "missing_value": -9.0,
    "valid_range": [0, 1],
    "coordinates": "sigma altitude",
    "grid_mapping": "rotated_pole",
    "flags": [1, 2],
}


"""Attributes of the variable; some of them would change the meaning of physical values."""
DATA = np.random.default_rng(3).normal(size=SHAPE).astype("f4")


"""Frames with a missing value and a value that equals the fill value of the attributes."""
DATA[0, 0, 0, :2] = np.nan, 3.0


def labelled_region(**changes: Any) -> Region:
    """A region of SHAPE with COORDS and ATTRIBUTES, or with other fields."""
    made = {
        "name": "theta",
        "units": "K",
        "dtype": np.dtype("f4"),
        "shape": SHAPE,
        "coords": COORDS,
        "attributes": ATTRIBUTES,
    }
    return Region(**{**made, **changes})

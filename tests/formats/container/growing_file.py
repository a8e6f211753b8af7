"""A growing container in few lines; as a program: one that is killed at every line in turn.

The program forks a process for each line of `growing.py` that runs while further layers are
written. The process ends at that line without any clean-up, as by `kill -9`. What it leaves must
open, with all layers that were published before.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from fhash_formats.container import Container
from fhash_formats.container.array import TRANSFORM
from fhash_formats.container.growing import GrowingArray, GrowingContainer
from fhash_formats.transform.tile import encode_chunk

TILE = (2, 3, 4, 4)
FRAME = (3, 4, 6)
KILLED = 77


def growing_array(frame: tuple[int, int, int] = FRAME) -> GrowingArray:
    return GrowingArray(
        name="table_1",
        frame=frame,
        dtype=np.dtype(np.float32),
        tile=TILE,
        codecs=[{"name": TRANSFORM, "configuration": {}}],
    )


def layer_values(number: int, frame: tuple[int, int, int] = FRAME) -> np.ndarray:
    """Values (t, z, y, x) of a layer, padded to whole tiles."""
    grid = growing_array(frame).layer_grid
    shape = (TILE[0], *(n * length for n, length in zip(grid, TILE[1:], strict=True)))
    return np.random.default_rng(number).standard_normal(shape).astype(np.float32)


def streams_of(values: np.ndarray) -> list[bytes]:
    _, z, y, x = TILE
    return [
        encode_chunk(values[:, k : k + z, j : j + y, i : i + x], max_error=0.0)
        for k in range(0, values.shape[1], z)
        for j in range(0, values.shape[2], y)
        for i in range(0, values.shape[3], x)
    ]


def growing_header(steps: int, frame: tuple[int, int, int] = FRAME) -> dict[str, Any]:
    return {
        "required_features": ["transform"],
        "encoder": {"version": "0"},
        "variable": {"name": "u", "units": "", "dtype": "float32", "attributes": {}},
        "domain": {"shape": [steps, *frame]},
        "value_range": [-9.0, 9.0],
        "background": 0.0,
        "feature_bounding_box": [[0, n] for n in frame],
        "features": ["all"],
        "dilation": 0,
        "coreset_fraction": 1.0,
        "mlp": None,
        "model": {
            "profile": "compact",
            "levels": [[steps, *frame]],
            "embedding_size": 1,
            "tables": "float32",
            "parameters": 0,
        },
        "coordinates": {axis: {} for axis in ("time", "z", "y", "x")},
        "config": {},
        "training": {"seconds": None, "epochs": 0, "device": "none"},
        "quality": {},
        "history": {},
    }


def add_layer(
    growing: GrowingContainer, number: int, frame: tuple[int, int, int] = FRAME, steps: int = 0
) -> None:
    """Add a layer and publish it. steps: of the file; whole layers by default."""
    array, steps = growing_array(frame), steps or TILE[0] * (number + 1)
    growing.add_layer(array, number, streams_of(layer_values(number, frame)))
    mark = growing.mark()
    growing.describe(array, steps)
    growing.publish(growing_header(steps, frame), mark)


def check_layers(path: Path, frame: tuple[int, int, int] = FRAME) -> int:
    """Compare every layer of a file with what was written; their number."""
    with Container.open(path) as container:
        container.verify()
        read = container.arrays["table_1"].read()
    for first in range(0, len(read), TILE[0]):
        z, y, x = frame
        expected = layer_values(first // TILE[0], frame)[:, :z, :y, :x]
        part = read[first : first + TILE[0]]
        np.testing.assert_array_equal(part, expected[: len(part)])
    return -(-len(read) // TILE[0])


def _die_at(line: int, publishing: list[int]) -> None:
    """End this process at so many lines of `growing.py`; say in `publishing` which layer it was."""
    left = line

    def at_line(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal left
        if event == "line":
            left -= 1
            if left < 0:
                os.write(publishing[1], bytes([publishing[0]]))
                os._exit(KILLED)
        return at_line

    def at_call(frame: FrameType, event: str, argument: Any) -> Any:
        return at_line if frame.f_code.co_filename.endswith("growing.py") else None

    sys.settrace(at_call)


def main(folder: Path, layers: int, stride: int) -> None:
    """Kill a writer at every so-manieth line while it writes layers 1, 2, ...; print the last."""
    line = 0
    while True:
        path = folder / "a.fhz"
        path.unlink(missing_ok=True)
        reading, writing = os.pipe()
        process = os.fork()
        if not process:
            publishing = [0, writing]
            with GrowingContainer(path) as growing:
                add_layer(growing, 0)
                _die_at(line, publishing)
                for number in range(1, layers):
                    publishing[0] = number
                    add_layer(growing, number)
                sys.settrace(None)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        os.close(writing)
        said = os.read(reading, 1)
        os.close(reading)
        if status == 0:
            print(line)
            return
        assert status == KILLED, status
        # The layer under way may be there already, all before it must be.
        assert check_layers(path) in (said[0], said[0] + 1), line
        with GrowingContainer(path, force=True) as growing:
            left = [name for name in os.listdir(folder) if name.endswith((".partial", ".old"))]
            assert not left, left
            add_layer(growing, 0)
        line += stride


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))

"""Part `points` of run.py: places in a network by fused kernels and on the host."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


def measured_points(
    device: str, shape: tuple[int, ...], side: int, seconds: float
) -> Iterator[dict[str, Any]]:
    """Measure places in networks, in the order of rays and at random.

    Fused kernels, which CUDA must have, are compared with the host: all values and most slopes,
    since near a ReLU's kink two roundings may take different sides.

    Args:
        device: 'cuda', or 'cpu' for the host alone.
        shape: key frames and vertices (t, z, y, x) of the networks.
        side: places along each axis.
        seconds: seconds of each measurement.
    """
    import torch

    from fhash_codec.paper.engines.fused.engine import start_points
    from fhash_codec.rendering.stream_fields import HostInference
    from fhash_codec.rendering.torch_arrays import TorchArrays

    there = torch.device(device)
    wait = torch.cuda.synchronize if device == "cuda" else (lambda: None)
    # Off the borders of cells, where slopes jump and rounding chooses the side.
    z, y, x = (np.linspace(0.0137, size - 1.0291, side) for size in shape[1:])
    along = np.meshgrid(y, x, z, indexing="ij")
    rays = np.stack([along[axis].ravel() for axis in (1, 0, 2)], axis=1)
    orders = {"rays": rays, "random": np.random.default_rng(1).permutation(rays)}

    def measured(evaluate: Callable[[Any], Any], places: Any) -> float:
        evaluate(places)
        wait()
        begun, calls = time.perf_counter(), 0
        while time.perf_counter() - begun < seconds:
            evaluate(places)
            wait()
            calls += 1
        return calls * len(places) / (time.perf_counter() - begun) / 1e6

    for layers, held in ((1, "dense"), (2, "dense"), (2, "sparse")):
        network = random_network(shape, layers, held == "sparse")
        found = {"host": HostInference(network, 0.5, TorchArrays(there))}
        if fused := start_points(network, 0.5, there):
            found["fused"] = fused
        elif device == "cuda":
            raise AssertionError("the fused kernels cannot be had; a warning says why")
        for order, array in orders.items():
            places = torch.from_numpy(array).to(there)
            result = {"model": f"64x{layers}", "tables": held, "order": order}
            for kind in ("values", "slopes"):
                given = {}
                for name, inference in found.items():
                    evaluate = getattr(inference, kind)
                    given[name] = evaluate(places).cpu().numpy()
                    result[f"{name}_{kind}_mpoints_s"] = measured(evaluate, places)
                if "fused" in given:
                    apart = np.abs(given["fused"] - given["host"]) / np.abs(given["host"]).max()
                    result[f"{kind}_median"] = float(np.median(apart))
                    result[f"{kind}_beyond_1e-4"] = float((apart > 1e-4).mean())
            if (
                result.get("values_beyond_1e-4", 0.0) > 0
                or result.get("slopes_beyond_1e-4", 0) > 0.01
            ):
                result["failed"] = "fused kernels differ from the host"
            yield result


def random_network(shape: tuple[int, ...], layers: int, sparse: bool) -> Any:
    """Return a network of random numbers, 64 wide; a sparse one holds a tenth of its vertices."""
    from fhash_codec.paper.network import Architecture, ArrayTable, Network, SparseFrame

    class Held(ArrayTable):
        def frame(self, node: int) -> SparseFrame:
            held = self.values[node].any(axis=-1)
            return SparseFrame.of(held, self.values[node][held])

    random = np.random.default_rng(0)
    architecture = Architecture.for_box(shape[1:], shape[0], hidden_layers=layers)
    tables = []
    for level in architecture.levels:
        values = random.standard_normal((*level, 2), np.float32)
        if sparse:
            # One ball at all times, about a tenth of the box.
            at = np.meshgrid(*(np.linspace(-1, 1, n) for n in level[1:]), indexing="ij")
            values *= (sum(axis**2 for axis in at) < 0.33)[..., None]
        tables.append((Held if sparse else ArrayTable)(values))
    return Network(
        levels=architecture.levels,
        embedding_size=2,
        tables=tables,
        layers=tuple(
            (
                random.standard_normal((outputs, inputs), np.float32) / np.float32(inputs) ** 0.5,
                random.standard_normal(outputs, np.float32),
            )
            for outputs, inputs in architecture.layer_shapes
        ),
        box_size=architecture.box_size,
        key_frames=architecture.key_frames,
    )

"""The picture of `fhash bench train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fhash_codec.bench.train.plot import plot

pytest.importorskip("matplotlib")


def run(engine: str, path: str | None) -> dict[str, Any]:
    points = [
        {"seconds": 2.0 * n, "cpu_seconds": float(n), "epochs": 1.0, "psnr": psnr}
        for n, psnr in ((1, 30.0), (2, None), (3, 41.0))
    ]
    return {"engine": engine, "path": path, "threads": 1, "curve": points}


def test_each_entry_has_a_row_of_two_panels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import matplotlib.figure

    figures = []
    original = matplotlib.figure.Figure.savefig

    def savefig(self: Any, *given: Any, **more: Any) -> None:
        figures.append(self)
        original(self, *given, **more)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", savefig)
    entry = {
        "series": "a b", "features": ["all"], "batch_bricks": 64.0, "float16_bytes": 2_000_000,
        "engines": [run("native", "baseline"), run("native", "x86-64-v3"), run("slab", None)],
    }  # fmt: skip
    plot({"series": [entry, entry]}, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    (figure,) = figures
    cpu, wall, *_ = figure.axes
    assert len(figure.axes) == 4
    assert cpu.lines[0].get_xydata().tolist() == [[1, 30], [3, 41]]
    assert wall.lines[0].get_xydata().tolist() == [[2, 30], [6, 41]]
    labels = [line.get_label() for line in cpu.lines][:3]
    assert labels == ["native baseline x1", "native x86-64-v3 x1", "slab x1"]

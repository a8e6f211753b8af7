"""Curves of convergence as pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from made_cells import cell, cells

from fhash_codec.bench.paper import plot
from fhash_codec.bench.paper.plot import plot_convergence
from fhash_formats.errors import MissingDependencyError

PNG = b"\x89PNG"


def test_a_picture_for_each_data_set_and_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(
        plot, "_draw", lambda title, encodings, path: drawn.append((title, list(encodings)))
    )
    made = [*cells()[:2], cell(seed=1), cell(data_set="my data", feature="interval:0:1")]
    assert [path.name for path in plot_convergence(made, tmp_path)] == [
        "convergence-bubble-segmentation-published.png",
        "convergence-bubble-segmentation-equal.png",
        "convergence-my_data-interval_0_1-equal.png",
    ]
    assert drawn[0] == (
        "Argon Bubble (bubble), segmentation, protocol published",
        ["dense", "dense-multi"],
    )


def test_curves_of_seeds_replace_an_older_picture(tmp_path: Path) -> None:
    made = [cell(), cell(seed=1, rise=3.0)]
    made = [replace(each, curve=each.curve[:4]) for each in made]
    old = tmp_path / "convergence-bubble-segmentation-equal.png"
    old.write_bytes(b"old")
    assert plot_convergence(made, tmp_path) == [old]
    assert old.read_bytes().startswith(PNG)


def test_curves_without_figures_are_left_out(tmp_path: Path) -> None:
    made = cell()
    bare = replace(
        made,
        curve=tuple(
            replace(point, picture_psnr=None, coreset_psnr=None) for point in made.curve[:3]
        ),
    )
    (path,) = plot_convergence([bare], tmp_path)
    assert path.read_bytes().startswith(PNG)


def test_without_matplotlib_one_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise MissingDependencyError("a plot needs matplotlib")

    monkeypatch.setattr(plot, "require_matplotlib", refuse)
    with pytest.raises(MissingDependencyError, match="matplotlib"):
        plot_convergence([cell()], tmp_path)

"""The axes of `fhash bench ablate`: settings that are varied, one axis at a time, from a base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fhash_formats.errors import InputError, suggestion

__all__ = ["AXES", "Axis", "axes_named"]


@dataclass(frozen=True, kw_only=True)
class Axis:
    """Settings that vary together.

    Attributes:
        name: name on the command line.
        profile: profile of the base.
        varied: settings of each model; the names are fields of `EncodeConfig`, and what is not
            named has its default.
        reference: number of the one in `varied` that the others are compared with: the default.
        common: settings of all models of the axis.
        why: what the axis is to show, one line.
    """

    name: str
    profile: str
    varied: tuple[dict[str, Any], ...]
    why: str
    reference: int = 0
    common: tuple[tuple[str, Any], ...] = ()


def _one(field: str, *values: Any) -> tuple[dict[str, Any], ...]:
    """Settings of one field."""
    return tuple({field: value} for value in values)


def _grid(first: str, ones: Sequence[Any], second: str, others: Sequence[Any]) -> Any:
    """Settings of two fields, each value of one with each of the other."""
    return tuple({first: one, second: other} for one in ones for other in others)


AXES = (
    Axis(
        name="encoding",
        profile="paper",
        varied=_grid("fold", (2, 4, 6), "embedding_size", (1, 2, 4, 8)),
        reference=1,
        why="ratio of resolution between levels, and numbers at a grid corner (paper, Table 1)",
    ),
    Axis(
        name="network",
        profile="paper",
        varied=_grid("hidden_layers", (1, 2, 3, 4), "width", (16, 32, 64, 128)),
        reference=6,
        why="layers and neurons of the MLP (paper, Ablation Study)",
    ),
    Axis(
        name="key-frames",
        profile="paper",
        varied=_one("key_frames", "all", "every:2", "every:4", "auto:10"),
        why="steps that are trained; quality is measured on all steps",
    ),
    Axis(
        name="dilation",
        profile="paper",
        varied=_one("dilation", 0, 1, 2, 4),
        reference=1,
        why="vertices by which the feature grows",
    ),
    Axis(
        name="fringe",
        profile="paper",
        varied=_one("fringe", "trained", "untrained"),
        common=(("key_frames", "every:4"),),
        why="vertices that one of two neighbouring key frames alone selects, with every 4th step",
    ),
    Axis(
        name="brick",
        profile="paper",
        varied=_one("brick", "auto", "4x4x4", "4x4x8", "4x8x8", "8x8x8", "8x8x16", "16x16x16"),
        why="vertices that are trained together",
    ),
    Axis(
        name="batch",
        profile="paper",
        varied=_one("batch", 0, 1 << 12, 1 << 14, 1 << 16, 1 << 18, 1 << 21),
        why="samples of a training step; 0 is the product's own choice, 2^21 the paper's",
    ),
    Axis(
        name="schedule",
        profile="paper",
        varied=_one("schedule", "cosine", "constant"),
        why="course of the learning rate; constant is the paper's",
    ),
    Axis(
        name="tables",
        profile="paper",
        varied=(
            *_one("tables", "float32", "float16", "uint8", "sparse", "dense"),
            {"tables": "transform", "fold": 2, "embedding_size": 2, "width": 64},
            {"tables": "transform"},
        ),
        reference=1,
        why="storage of the tables, sparse of needed vertices alone; transform alone has a"
        " smaller model, made for coding",
    ),
    Axis(
        name="effort",
        profile="compact",
        varied=_one("effort", 1, 2, 3, 4, 5, 7, 9),
        reference=4,
        why="trials and training of the profile compact",
    ),
    Axis(
        name="tile",
        profile="compact",
        varied=_one("tile", "auto", "whole", "4x16x16x16", "4x32x32x32", "16x16x16x16"),
        why="vertices that are decoded together",
    ),
    Axis(
        name="stages",
        profile="compact",
        varied=_one("without", (), ("tiles",), ("transform",), ("head",)),
        why="stages of the encoding, each left out",
    ),
    Axis(
        name="stages-of-bound",
        profile="compact",
        varied=_one("without", (), ("tiles",), ("transform",), ("head",), ("predictor",)),
        why="the same for a strict bound of 1 % of the range, whatever is promised otherwise",
        common=(("psnr", None), ("max_error", None), ("max_error_rel", 0.01)),
    ),
)
"""All axes, in the order in which they are measured."""


def axes_named(names: Sequence[str]) -> tuple[Axis, ...]:
    """Return the axes of some names, in the order of AXES; all of them for no names.

    Raises InputError for an unknown name.
    """
    known = [axis.name for axis in AXES]
    for name in names:
        if name not in known:
            raise InputError(f"unknown axis '{name}'; {suggestion(name, known)}")
    return tuple(axis for axis in AXES if not names or axis.name in names)

"""Types of the options that describe a scene: numbers, sizes, opacities and planes."""

from __future__ import annotations

from typing import Any

import click

__all__ = ["NumbersType", "OpacityType", "PlaneType", "SizeType"]

NUMBERS = {2: "A,B", 3: "X,Y,Z"}
"""Placeholders of options that take so many numbers."""


class NumbersType(click.ParamType[tuple[float, ...]]):
    """A fixed count of numbers with commas between them."""

    def __init__(self, count: int) -> None:
        self.count, self.name = count, NUMBERS[count]

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The numbers; the scene checks later whether their values are allowed."""
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count:
            self.fail(
                f"'{value}' is not {self.count} numbers with commas between them,"
                f" such as {','.join('123'[: self.count])}",
                param,
                ctx,
            )
        return numbers


class SizeType(click.ParamType[tuple[int, int]]):
    """Pixels across and down, WxH, or one number for both."""

    name = "WxH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """The two numbers."""
        try:
            across, _, down = str(value).lower().partition("x")
            return int(across), int(down or across)
        except ValueError:
            self.fail(f"'{value}' is not a size in pixels such as 800x600", param, ctx)


class OpacityType(click.ParamType[Any]):
    """Points VALUE:OPACITY with commas between them, or the name of an opacity preset.

    named: whether it may be a name.
    """

    def __init__(self, *, named: bool = True) -> None:
        self.named, self.name = named, "NAME|V:O,..." if named else "G:F,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The name, or a list of points."""
        if self.named and ":" not in str(value):
            return value
        try:
            return [[float(end) for end in part.split(":")] for part in str(value).split(",")]
        except ValueError:
            what = "neither the name of an opacity nor" if self.named else "not"
            self.fail(f"'{value}' is {what} points such as 0:0,0.5:0.2,2:1", param, ctx)


class PlaneType(click.ParamType[dict[str, Any]]):
    """A clip plane: its normal and an offset, or a point of it and its normal."""

    name = "NX,NY,NZ,D"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, Any]:
        """The settings of a ClipPlane."""
        try:
            numbers = [float(part) for part in str(value).split(",")]
        except ValueError:
            numbers = []
        if len(numbers) == 4:
            return {"normal": numbers[:3], "offset": numbers[3]}
        if len(numbers) == 6:
            return {"point": numbers[:3], "normal": numbers[3:]}
        self.fail(
            f"'{value}' is neither a normal and an offset, NX,NY,NZ,D, nor a point and a normal,"
            " X,Y,Z,NX,NY,NZ, such as 0,0,1,0.5",
            param,
            ctx,
        )

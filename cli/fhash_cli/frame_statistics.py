"""Figures of decoded frames, for people who ask what a region holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy.typing as npt


class Statistics:
    """Smallest, largest and mean value, and share inside the coreset, of frames added one by one.

    NaN is left out.
    """

    def __init__(self) -> None:
        from fhash_codec.measure.value_range import Mean

        self.low, self.high, self.mean = float("inf"), float("-inf"), Mean()
        self.inside = self.all = 0

    def add(
        self, frame: npt.NDArray[Any], inside: int, integers: npt.NDArray[Any] | None = None
    ) -> None:
        """Add values of any shape.

        inside: number of their vertices in the coreset. integers: the values as integers, where
        floats have not all of them.
        """
        import numpy as np

        from fhash_codec.measure.value_range import pieces
        from fhash_formats.support.number_types import exact_number

        gaps = np.isnan(frame)
        frame = frame if integers is None else integers
        values = frame[~gaps] if gaps.any() else frame.reshape(-1)
        self.all, self.inside = self.all + frame.size, self.inside + inside
        if values.size:
            self.low, self.high = (
                min(self.low, exact_number(values.min().item())),
                max(self.high, exact_number(values.max().item())),
            )
        for piece in pieces(values):
            self.mean.add(piece)

    def result(self) -> dict[str, float | None]:
        """JSON values; None where no vertex has a value."""
        defined = self.mean.count > 0
        return {
            "min": self.low if defined else None,
            "max": self.high if defined else None,
            "mean": self.mean.value() if defined else None,
            "inside_fraction": self.inside / self.all,
        }

"""Figures that the F-Hash paper prints, and tables that hold them beside measured ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated, Any, TypedDict

NOT_REACHED_TEXT = "NR"
"""Text of a quality that was not reached."""
QUOTED = "quoted"
"""Mark of a figure that the paper prints and nobody measured here."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A figure over seeds; infinite where a seed did not reach what was asked.

    Attributes:
        median, low, high: over the seeds.
        seeds: number of seeds.
        digits: significant digits as text.
    """

    median: float
    low: float
    high: float
    seeds: int
    digits: int = 3

    @classmethod
    def of(cls, figures: Sequence[float | None], digits: int = 3) -> Spread | None:
        """The spread of the figures of some seeds, None for not reached; None without a seed."""
        numbers = sorted(math.inf if figure is None else float(figure) for figure in figures)
        if not numbers:
            return None
        return cls(
            median=median(numbers),
            low=numbers[0],
            high=numbers[-1],
            seeds=len(numbers),
            digits=digits,
        )

    def __str__(self) -> str:
        """The median; with several seeds the smallest and the largest in brackets as well."""
        middle = _number(self.median, self.digits)
        if self.seeds == 1 or self.low == self.high:
            return middle
        return f"{middle} ({_number(self.low, self.digits)}-{_number(self.high, self.digits)})"

    def to_dict(self) -> dict[str, Any]:
        """JSON values; a figure that is not reached is "NR"."""
        figures = {"median": self.median, "low": self.low, "high": self.high}
        return {
            **{name: x if math.isfinite(x) else NOT_REACHED_TEXT for name, x in figures.items()},
            "seeds": self.seeds,
        }


Value = Spread | float | int | str | None
"""A cell of a table; None where nothing was measured."""


class TableReport(TypedDict):
    """A table of results beside the paper's, as JSON values."""

    name: Annotated[str, "such as `table-3-equal`"]
    title: Annotated[str, "one line"]
    rows: Annotated[
        list[dict[str, Any]],
        'by heading; `{median, low, high, seeds}` over seeds; `"NR"` where not reached',
    ]
    notes: Annotated[list[str], "what to know about the table"]


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A table of results beside the paper's.

    Attributes:
        name: for files and JSON, such as "table-3-equal".
        title: one line.
        columns: headings; those of quoted figures say so.
        rows: values.
        notes: lines under the table.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    notes: tuple[str, ...] = ()

    def lines(self) -> list[list[str]]:
        """The heading and the rows as text, all of equal length."""
        return [list(self.columns), *([shown(value) for value in row] for row in self.rows)]

    def markdown(self) -> str:
        """The table as Markdown, with its title and its notes."""
        heading, *rows = ([cell.replace("|", "\\|") for cell in line] for line in self.lines())
        lines = [f"### {self.title}", "", _line(heading), _line(["---"] * len(heading))]
        lines += [_line(row) for row in rows]
        lines += ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join(lines) + "\n"

    def to_dict(self) -> TableReport:
        """JSON values: each row by its headings."""
        return {
            "name": self.name,
            "title": self.title,
            "rows": [
                {
                    column: value.to_dict() if isinstance(value, Spread) else value
                    for column, value in zip(self.columns, row, strict=True)
                }
                for row in self.rows
            ],
            "notes": list(self.notes),
        }


def shown(value: Value) -> str:
    """A value as text: a dash where nothing was measured, numbers with at most four digits."""
    if value is None:
        return "-"
    if isinstance(value, str | Spread):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else _number(value, 4, least=1)


def _number(value: float, digits: int, least: int = 0) -> str:
    """A number with some significant digits, no exponent and no idle zeros; NR if infinite.

    least: decimals that are kept of large numbers too.
    """
    if not math.isfinite(value):
        return NOT_REACHED_TEXT
    if value == 0:
        return "0"
    decimals = max(digits - 1 - math.floor(math.log10(abs(value))), least)
    text = f"{value:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


ENCODINGS: Mapping[str, str] = {
    "hash": "MHE",
    "tcnn": "MHE (tiny-cuda-nn)",
    "dense": "Dense Grid single-resolution",
    "dense-multi": "Dense Grid multi-resolution",
    "fhash": "F-Hash",
}
"""Encodings of the paper's evaluation: our names, and the paper's."""
SETS: Mapping[str, str] = {"flame": "Combustion", "bubble": "Argon Bubble", "shell": "Supernova"}
"""Our analogues, and the paper's data sets."""
FEATURES = ("interval", "isosurface", "segmentation")
"""Kinds of features, in the order of the paper's Int / Iso / Seg."""
DECIBELS = (20, 30, 40)
"""PSNR of pictures in dB at which Table 3 gives times."""

Three = tuple[float | None, float | None, float | None]
"""Figures of the three features; None is NR, not reached within 60 epochs."""


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """A row of Table 2.

    Attributes:
        shape: vertices along x, y, z.
        steps: time steps.
        gigabytes: printed size in GB, which are GiB.
        key_frames: number of key frames.
        box: vertices along x, y, z of the feature bounding box of the segmentation.
        box_share: box / frame.
    """

    shape: tuple[int, int, int]
    steps: int
    gigabytes: float
    key_frames: int
    box: tuple[int, int, int]
    box_share: float

    @property
    def raw_bytes(self) -> int:
        """Bytes of all steps as float32."""
        x, y, z = self.shape
        return 4 * x * y * z * self.steps


@dataclass(frozen=True)
class Accuracy:
    """A cell of Table 4: mean picture PSNR in dB, SSIM and minutes after 30 epochs."""

    psnr: float
    ssim: float
    minutes: float


@dataclass(frozen=True)
class Latency:
    """A cell of Table 6: milliseconds of a picture by sample streaming, and with ARM."""

    stream: float
    arm: float

    @property
    def gain(self) -> float:
        """Streaming / ARM."""
        return self.stream / self.arm


@dataclass(frozen=True)
class Note:
    """A contradiction among printed figures: the tables concerned, and one line."""

    tables: tuple[int, ...]
    text: str


TABLE_1: Mapping[tuple[int, int], float] = {
    (2, 1): 8.4, (2, 2): 16.8, (2, 4): 33.7, (2, 8): 67.3,
    (4, 1): 7.9, (4, 2): 15.7, (4, 4): 31.4, (4, 8): 62.9,
    (6, 1): 7.8, (6, 2): 15.6, (6, 4): 31.3, (6, 8): 62.6,
}  # fmt: skip
"""Minutes of training on Argon Bubble by (fold, embedding size)."""

TABLE_2: Mapping[str, DataSet] = {
    "flame": DataSet(
        shape=(200, 172, 54), steps=136, gigabytes=0.94, key_frames=10, box=(200, 110, 54),
        box_share=0.6395,
    ),
    "bubble": DataSet(
        shape=(128, 128, 256), steps=241, gigabytes=3.77, key_frames=9, box=(80, 83, 204),
        box_share=0.3230,
    ),
    "shell": DataSet(
        shape=(216, 216, 216), steps=136, gigabytes=5.11, key_frames=10, box=(156, 183, 185),
        box_share=0.5241,
    ),
}  # fmt: skip
"""The data sets of the paper."""

NR: Three = (None, None, None)
"""Not reached with any feature."""

TABLE_3: Mapping[str, Mapping[int, Mapping[str, Three]]] = {
    "flame": {
        20: {"hash": (33.2, 51.9, 31.7), "tcnn": (24.3, 54.7, 45.6), "dense": (37.4, 46.3, 35.9),
             "dense-multi": (29.0, 39.7, 25.9), "fhash": (1.0, 2.2, 1.2)},
        30: {"hash": NR, "tcnn": (83.6, None, 86.6), "dense": (None, None, 67.2),
             "dense-multi": (83.9, None, 58.0), "fhash": (4.2, 5.0, 2.0)},
        40: {"hash": NR, "tcnn": NR, "dense": NR, "dense-multi": NR, "fhash": (None, 7.4, 2.9)},
    },
    "bubble": {
        20: {"hash": (22.6, 30.2, 30.2), "tcnn": (21.2, 23.2, 23.1), "dense": (37.5, 44.4, 46.1),
             "dense-multi": (16.6, 14.5, 14.5), "fhash": (2.2, 1.1, 1.1)},
        30: {"hash": NR, "tcnn": (28.9, 32.8, 26.9), "dense": (61.4, 59.7, 59.7),
             "dense-multi": (29.0, 29.0, 27.0), "fhash": (3.4, 3.1, 2.2)},
        40: {"hash": NR, "tcnn": (48.2, 73.2, 36.6), "dense": (80.2, 63.1, 68.3),
             "dense-multi": (43.6, 49.8, 35.3), "fhash": (4.8, 5.9, 3.4)},
    },
    "shell": {
        20: {"hash": (163.7, 147.3, 135.1), "tcnn": (52.6, 68.7, 40.4),
             "dense": (190.4, 190.3, 186.4), "dense-multi": (134.3, 134.3, 126.2),
             "fhash": (2.1, 2.1, 1.6)},
        30: {"hash": (None, None, 237.4), "tcnn": (None, None, 137.5), "dense": NR,
             "dense-multi": (None, None, 179.1), "fhash": (7.4, 10.0, 2.6)},
        40: {"hash": NR, "tcnn": NR, "dense": NR, "dense-multi": NR, "fhash": (None, None, 5.8)},
    },
}  # fmt: skip
"""Minutes to a mean PSNR of the pictures: data set, dB, encoding, features."""

TABLE_3_SETTINGS: Mapping[str, Mapping[str, str]] = {
    "flame": {"hash": "T=2^20, 6 levels", "tcnn": "T=2^20, 6 levels", "dense": "",
              "dense-multi": "", "fhash": "fold 2, 6 / 6 / 6 levels"},
    "bubble": {"hash": "T=2^21, 7 levels", "tcnn": "T=2^21, 7 levels", "dense": "",
               "dense-multi": "", "fhash": "fold 2, 6 / 7 / 7 levels"},
    "shell": {"hash": "T=2^23, 7 levels", "tcnn": "T=2^23, 7 levels", "dense": "",
              "dense-multi": "", "fhash": "fold 2, 8 / 8 / 8 levels"},
}  # fmt: skip
"""Settings of each encoding; the dense grids' are not printed."""

PARAMETERS: Mapping[str, Mapping[str, tuple[float, float, float]]] = {
    "flame": {"hash": (120.0,) * 3, "tcnn": (45.8,) * 3, "dense": (45.0,) * 3,
              "dense-multi": (51.5,) * 3, "fhash": (16.1, 17.4, 24.2)},
    "bubble": {"hash": (252.0,) * 3, "tcnn": (77.2,) * 3, "dense": (72.0,) * 3,
               "dense-multi": (82.3,) * 3, "fhash": (16.7, 19.5, 19.7)},
    "shell": {"hash": (1120.0,) * 3, "tcnn": (205.8,) * 3, "dense": (135.0,) * 3,
              "dense-multi": (154.3,) * 3, "fhash": (108.2, 86.9, 107.7)},
}  # fmt: skip
"""Parameters of the encodings in M (2^20), of the three features; one number where all share it."""

TABLE_4: Mapping[str, Mapping[str, Accuracy]] = {
    "flame": {"hash": Accuracy(18.9, 0.818, 43.4), "tcnn": Accuracy(23.7, 0.906, 45.7),
              "dense": Accuracy(20.2, 0.829, 44.8), "dense-multi": Accuracy(20.5, 0.850, 45.9),
              "fhash": Accuracy(47.1, 0.994, 7.4)},
    "bubble": {"hash": Accuracy(22.3, 0.862, 56.5), "tcnn": Accuracy(28.3, 0.987, 57.9),
               "dense": Accuracy(23.9, 0.908, 51.1), "dense-multi": Accuracy(35.6, 0.987, 62.3),
               "fhash": Accuracy(64.6, 0.999, 8.5)},
    "shell": {"hash": Accuracy(26.7, 0.870, 122.7), "tcnn": Accuracy(26.6, 0.861, 121.4),
              "dense": Accuracy(24.5, 0.899, 122.2), "dense-multi": Accuracy(31.7, 0.941, 118.8),
              "fhash": Accuracy(38.7, 0.986, 15.7)},
}  # fmt: skip
"""Accuracy of pictures of the segmentation after 30 epochs."""

TABLE_5: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "flame": {"hash": (1.9,), "tcnn": (3.5,), "dense": (5.1,), "dense-multi": (4.5,),
              "fhash": (14.3, 13.2, 9.5), "NeurComp": (1407.3,), "SZ3": (51.4,),
              "TTHRESH": (1023.3,)},
    "bubble": {"hash": (3.7,), "tcnn": (6.2,), "dense": (12.8,), "dense-multi": (11.2,),
               "fhash": (55.2, 47.1, 46.8), "NeurComp": (1223.8,), "SZ3": (54.6,),
               "TTHRESH": (1107.4,)},
    "shell": {"hash": (1.1,), "tcnn": (2.4,), "dense": (9.2,), "dense-multi": (8.1,),
              "fhash": (11.5, 14.3, 11.6), "NeurComp": (1371.2,), "SZ3": (61.7,),
              "TTHRESH": (1240.3,)},
}  # fmt: skip
"""Compression ratios: one, or those of the three features. Codecs are at 45 dB or more."""

TABLE_6: Mapping[str, Mapping[str, Latency]] = {
    "flame": {"hash": Latency(385.4, 253.5), "tcnn": Latency(211.1, 136.6),
              "dense": Latency(144.5, 97.1), "dense-multi": Latency(165.2, 110.9),
              "fhash": Latency(77.6, 53.8)},
    "bubble": {"hash": Latency(898.5, 592.4), "tcnn": Latency(531.5, 351.9),
               "dense": Latency(256.9, 168.8), "dense-multi": Latency(293.6, 192.4),
               "fhash": Latency(63.01, 43.4)},
    "shell": {"hash": Latency(3592.5, 2367.5), "tcnn": Latency(1686.1, 1112.6),
              "dense": Latency(432.8, 284.6), "dense-multi": Latency(494.8, 326.6),
              "fhash": Latency(345.3, 228.1)},
}  # fmt: skip
"""Milliseconds of a picture of a key frame; picture size, step and transfer function are not
printed."""

NOTES: tuple[Note, ...] = (
    Note((1,), "the text says that every MLP of the ablation took about 39 min; Table 1 has"
         " 16.8 min for the same default"),
    Note((2,), "the caption swaps the bounding boxes of Combustion and Argon Bubble; sizes in GB"
         " are GiB"),
    Note((3,), "the dense grids of Combustion (192 x 192 x 64) and Supernova (192^3) are not the"
         " volumes' 200 x 172 x 54 and 216^3"),
    Note((3,), "tiny-cuda-nn's parameters come out in all three sets only with two hidden layers of"
         " 64 counted"),
    Note((3,), "F-Hash on Argon Bubble, segmentation: 19.7 M printed; its box with 9 key frames"
         " gives 25.0 M, and level 1 alone 23.3 M"),
    Note((3,), "F-Hash's levels are printed as 6, 7, 8; fold 2 gives 8 in all three sets, and"
         " Table 1 prints 8 for Argon Bubble"),
    Note((3, 4), "minutes an epoch are the same for all four other encodings of a data set (0.20 to"
         " 0.42 M samples/s), tiny-cuda-nn included: the clock counted samples, not the encoding"),
    Note((3, 4), "six cells contradict each other: Argon Bubble with multi-resolution grids is"
         " at 40 dB after epoch 17 in Table 3, and at 35.6 dB after epoch 30 in Table 4"),
    Note((3, 4), "with batch 2^21 and one model a key frame the other encodings make 1, 2 and 5"
         " Adam steps an epoch, F-Hash about 2, 4 and 10"),
    Note((5,), "18 of the 21 ratios of encodings are raw MiB over parameter MB: 4.6 % too low"),
    Note((5,), "tiny-cuda-nn's ratios follow from 65.7, 149.1 and 525.7 M parameters, not from"
         " those of Table 3"),
    Note((5,), "F-Hash's ratio sets float32 tables of 10, 9 and 10 key frames against all steps"),
    Note((6,), "F-Hash alone has an occupancy; its latency mixes that, its size and ARM"),
)  # fmt: skip
"""Contradictions among the printed figures, each recomputed from them."""


def notes_of(table: int) -> tuple[str, ...]:
    """The notes about a table, 1 to 6."""
    return tuple(note.text for note in NOTES if table in note.tables)

"""Settings of an encoding: one frozen record whose fields carry their own help and limits.

The command line takes names, defaults and help of its options from these fields, so that there is
one place to read and to change.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

from fhash_codec.records import Record, limits
from fhash_formats.errors import InputError, suggestion

TABLES = ("auto", "float32", "float16", "uint8", "sparse", "dense", "transform")
"""Storage of the published network's tables: the codec, a number type, float16 of some vertices."""

PUBLISHED = "published"
"""Preset of the published network."""
ACCESS = {"default": "balanced", "small": "small", "fast": "fast", PUBLISHED: "balanced"}
"""Wishes for access to regions, by the presets."""
PRESETS = tuple(ACCESS)
"""Every preset, the default first."""

SAMPLES = ("all", "keys", "published")
"""Samples that the published network trains on."""

PROMISES = ("psnr", "psnr_bulk", "max_error", "max_error_rel", "ratio")
"""Settings that promise a quality or a size; at most one of them is given, or PAIR."""

OPTIONAL_STAGES = ("tiles", "transform", "filling", "predictor", "ssim")
"""Stages of an encoding that `without` may name."""

STAGES_OF_PUBLISHED = ("ssim",)
"""Those of them that the published network has."""

PAIR = ("psnr", "psnr_bulk")
"""Promises that may be given together."""

TRAIN_ON_SECONDS = 3600
"""Seconds that a training may go on for a promise: as long as a person may wait for one file."""
DEFAULT_PSNR = 50.0
"""PSNR in dB that is promised where nothing is asked for."""
DEFAULT_PSNR_BULK = 40.0
"""PSNR in dB that is promised of a wide bulk where nothing is asked for."""


TIME_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}
"""Seconds in the units of time that `train` may have."""
MOST_TRAINING_SECONDS = 86400.0
"""Longest training that may be asked for."""


@dataclass(frozen=True, kw_only=True)
class EncodeConfig(Record):
    """Settings of `encode`; raises InputError for a value that is not allowed."""

    preset: str = limits(
        "default",
        "what reading may cost: 'default' is a region of 16^3 within 30 ms and 100 MB/s where "
        "small tiles or the fast coder give that for up to 1.1 times the bytes; 'small' is the "
        "fewest bytes; 'fast' is 3 ms, the fast coder and up to 1.5 times the bytes; or "
        "'published', the network of the paper, trained from a random start",
        choices=PRESETS,
    )
    features: tuple[str, ...] = limits(
        ("all",),
        "what to keep: interval:LO:HI, isosurface:V, segmentation[:T], mask:FILE or all; change:D "
        "and onset:V, where values change by more than D or rise above V; repeat to merge several",
        option="feature",
    )
    dilation: int = limits(1, "vertices by which features grow in every direction", low=0, high=64)
    key_frames: str = limits(
        "all",
        "published: steps to train on, as all, every:K, auto:N (N chosen by interpolation error) "
        "or a list such as 0,4,9",
        published=True,
    )
    samples: str = limits(
        "all",
        "published: train on 'all' steps from the first key frame to the last, each at its place "
        "in time, or on the 'keys' alone; with either, on the vertices that only a neighbouring "
        "key frame selects, too, or without them on the keys, as 'published'",
        choices=SAMPLES,
        published=True,
    )
    fold: int = limits(
        0,
        "published: ratio of resolution from one level to the next, 2 to 64; 0 for 2, the paper's, "
        "or 8 where tables are coded, of which more levels cost bytes",
        low=0,
        high=64,
        published=True,
    )
    embedding_size: int = limits(
        0,
        "published: numbers trained at each grid corner; 0 for 2, the published size, or 1 where "
        "tables are coded",
        low=0,
        high=16,
        published=True,
    )
    hidden_layers: int = limits(
        2, "published: hidden layers of the network", low=0, high=2, published=True
    )
    width: int = limits(
        0,
        "published: neurons of each hidden layer; 0 for 64, the published width, or 16 where "
        "tables are coded",
        low=0,
        high=128,
        published=True,
    )
    epochs: int = limits(
        0,
        "published: passes over the coreset, no fewer and no more; 0 for 20 or as many as make "
        "1000 training steps, and then more until the promise is kept",
        low=0,
        high=100_000,
        published=True,
    )
    train_on_seconds: int = limits(
        TRAIN_ON_SECONDS,
        "published: seconds of wall time that training may take beyond its first epochs where "
        "coded tables would miss the promise; --epochs leaves none",
        low=0,
        high=10**9,
        published=True,
    )
    learning_rate: float = limits(
        0.01, "published: Adam's learning rate at the start", low=1e-8, high=1.0, published=True
    )
    schedule: str = limits(
        "cosine",
        "published: course of the learning rate over the training",
        choices=("cosine", "constant"),
        published=True,
    )
    batch: int = limits(
        0,
        "published: samples per training step, of the coreset alone; 0 for a size that suits the "
        "data",
        low=0,
        high=2**31,
        published=True,
    )
    brick: str = limits(
        "auto",
        "published: vertices that are trained together, as ZxYxX such as 8x8x16; 'auto' for about "
        "1024",
        published=True,
    )
    psnr: float | None = limits(
        None,
        "promise of quality in dB over the coreset of all steps "
        f"({DEFAULT_PSNR:g} if nothing is promised); a file that misses it is RUN.missed.fhz, and "
        "the exit code 3",
        low=0.0,
        high=400.0,
    )
    psnr_bulk: float | None = limits(
        None,
        "promise of quality in dB within the bulk, the range of the middle 98 % of the values "
        f"({DEFAULT_PSNR_BULK:g} if nothing is promised); alone or beside psnr",
        low=0.0,
        high=400.0,
    )
    max_error: float | None = limits(
        None,
        "strict bound of the error of each value, in data units",
        low=0.0,
        high=1.7e308,
    )
    max_error_rel: float | None = limits(
        None,
        "strict bound of the error of each value, as a fraction of the range of the series",
        low=0.0,
        high=1.0,
    )
    ratio: float | None = limits(
        None,
        "make the file this many times smaller than the raw data",
        low=1.0,
        high=1e9,
        published=False,
    )
    effort: int = limits(
        5,
        "1 prices few candidates and codes in one pass, 2 to 4 price more and weigh bits, "
        "from 5 on an MLP is trained, the longer the higher",
        low=1,
        high=9,
        published=False,
    )
    train: str = limits(
        "auto",
        "how long the MLP behind the table is trained: 'auto' where it should pay and as "
        "long as the effort says, 'none', or a time such as 30s or 5m of one core, which becomes a "
        "number of updates",
        published=False,
    )
    tile: str = limits(
        "auto",
        "vertices that are decoded together, as TxZxYxX such as 4x32x32x32; "
        "'auto', or 'whole' for one tile",
        published=False,
    )
    without: tuple[str, ...] = limits(
        (),
        "stages to leave out, which then take no time: tiles, transform, filling, predictor "
        "(trials for fewer bytes) and ssim; repeat, or join by commas",
    )
    tables: str = limits(
        "auto",
        "published: 'auto' codes the tables as other presets do, down to the promise; 'transform' "
        "too, for at most 0.1 dB where none is given; others are plain numbers of a type, which "
        "have only the vertices that the coreset needs where it is below half of its box; 'sparse' "
        "(always so) and 'dense' (never) are float16; only 'auto' has a promise where none is "
        "given",
        choices=TABLES,
        published=True,
    )
    device: str = limits(
        "auto",
        "where to train; 'auto' takes CUDA where --preset published has long to train, and else "
        "the CPU; the MLP of other presets has the same bits on both",
        choices=("auto", "cpu", "cuda"),
    )
    deterministic: bool = limits(
        False, "published: the same bits in every run on CUDA, too; slower there", published=True
    )
    seed: int = limits(0, "seed of every random choice", low=0, high=2**63 - 1)
    timings: bool = limits(
        False,
        "keep the date, seconds and the course of a training in the file; "
        "without, the same input and number of threads give the same bytes",
    )

    def __post_init__(self) -> None:
        self._accept_python_values()
        super().__post_init__()
        if not self.features:
            raise InputError("feature is empty; name at least one, such as 'all'")
        if self.fold == 1:
            raise InputError(
                "--fold is 1; allowed: 2 to 64, or 0 for a ratio that suits the tables"
            )
        self._check_preset()
        self._check_without()
        if self.epochs and self.train_on_seconds not in (0, TRAIN_ON_SECONDS):
            raise InputError(
                "epochs and train-on-seconds are given; --epochs trains no more than that: "
                "give one of them"
            )
        if self.preset in ("small", "fast") and self.tile != "auto":
            raise InputError(
                f"preset '{self.preset}' and tile '{self.tile}' are given; a tile that is named "
                "leaves nothing to choose: give one of them"
            )
        self._check_promises()
        _ = self.training_seconds  # InputError for what is no time

    @staticmethod
    def label(setting: dataclasses.Field[Any]) -> str:
        """The name of a setting on the command line, without its leading dashes."""
        name: str = setting.metadata.get("option", setting.name)
        return name.replace("_", "-")

    @property
    def published(self) -> bool:
        """Whether the published network is trained."""
        return self.preset == PUBLISHED

    @property
    def access(self) -> str:
        """The wish for access to regions: 'fast', 'balanced' or 'small'."""
        return ACCESS[self.preset]

    @property
    def coded(self) -> bool:
        """Whether the published network's tables are coded, and no plain numbers."""
        return self.tables in ("auto", "transform")

    @property
    def training_seconds(self) -> float | None:
        """Seconds of a training that `train` names; None for 'auto', 0 for 'none'."""
        if self.train in ("auto", "none"):
            return None if self.train == "auto" else 0.0
        number, unit = self.train.rstrip("smh"), self.train.lstrip("0123456789.")
        try:
            seconds = float(number) * TIME_UNITS[unit]
        except (KeyError, ValueError):
            seconds = -1.0
        if not 0 < seconds <= MOST_TRAINING_SECONDS:
            raise InputError(
                f"train is '{self.train:.40}'; allowed: auto, none, or a time up to a day as in "
                "30s, 5m or 1h"
            )
        return seconds

    @property
    def bounded(self) -> bool:
        """Whether a bound of each error is promised."""
        return self.max_error is not None or self.max_error_rel is not None

    @property
    def model_fold(self) -> int:
        """The published network's ratio of resolution of levels: `fold`, or what 0 stands for.

        Coded tables of more levels take more bytes at the same PSNR: the finest table describes the
        values alone, and the coarser ones repeat what it could say.
        """
        return self.fold or (8 if self.coded else 2)

    @property
    def model_embedding_size(self) -> int:
        """The published network's numbers at a corner: `embedding_size`, or what 0 stands for.

        Of several numbers, coded tables use one: the coding turns the others into a constant.
        """
        return self.embedding_size or (1 if self.coded else 2)

    @property
    def model_width(self) -> int:
        """Neurons of the published network's hidden layers: `width`, or what its 0 stands for.

        A function of a few numbers needs few. Beside coded tables, 64 would take up to a quarter of
        the file.
        """
        return self.width or (16 if self.coded else 64)

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, `deterministic` where it is on; `from_dict` takes them."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in vars(self).items()
            if name != "deterministic" or value
        }

    def settings(self) -> dict[str, Any]:
        """The settings that the preset has, as `to_dict` gives them: `config` of a header."""
        values = self.to_dict()
        of_preset = (None, self.published)
        has = {f.name for f in dataclasses.fields(self) if f.metadata.get("published") in of_preset}
        return {name: value for name, value in values.items() if name in has}

    def _accept_python_values(self) -> None:
        """Turn a single feature into a tuple, and key frames given as numbers into text."""
        features, key_frames = cast(Any, self.features), cast(Any, self.key_frames)
        without = cast(Any, self.without)
        texts = (without,) if isinstance(without, str) else tuple(map(str, without))
        names = {name.strip() for text in texts for name in text.split(",") if name.strip()}
        unknown = sorted(names - set(OPTIONAL_STAGES))
        if unknown:
            raise InputError(
                f"without names '{unknown[0]}'; {suggestion(unknown[0], OPTIONAL_STAGES)}"
            )
        # One order, so that the same stages give the same bytes however they are named.
        in_order = tuple(name for name in OPTIONAL_STAGES if name in names)
        object.__setattr__(self, "without", in_order)
        if isinstance(features, str):
            object.__setattr__(self, "features", (features,))
        elif not all(isinstance(feature, str) for feature in features):
            raise InputError("feature is not text; a mask in memory goes to encode(..., mask=...)")
        if not isinstance(key_frames, str):
            object.__setattr__(self, "key_frames", ",".join(str(int(step)) for step in key_frames))

    def _check_preset(self) -> None:
        """Raise InputError for a setting that belongs to other presets."""
        for field in dataclasses.fields(self):
            published, value = field.metadata.get("published"), getattr(self, field.name)
            if published in (None, self.published) or value == field.default:
                continue
            belongs = f"belongs to --preset {PUBLISHED}; the preset is {self.preset}"
            others = f"is not for --preset {PUBLISHED}"
            raise InputError(f"{self.label(field)} {belongs if published else others}")

    def _check_without(self) -> None:
        """Raise InputError for a stage to leave out that the preset does not have."""
        others = [name for name in self.without if name not in STAGES_OF_PUBLISHED]
        if self.published and others:
            raise InputError(
                f"without names '{others[0]}', which --preset {PUBLISHED} does not have; it has "
                f"{', '.join(STAGES_OF_PUBLISHED)}"
            )

    def _check_promises(self) -> None:
        """Raise InputError if more than one promise is given, except the two of PAIR."""
        promised = [
            field
            for field in dataclasses.fields(self)
            if field.name in PROMISES and getattr(self, field.name) is not None
        ]
        if len(promised) > 1 and not {field.name for field in promised} <= set(PAIR):
            names = " and ".join(map(self.label, promised))
            raise InputError(f"{names} are given; promise one of them")
        if self.published and self.bounded:
            raise InputError(
                f"{self.label(promised[0])} is not for --preset {PUBLISHED}, whose float32 numbers "
                "differ from machine to machine; leave --preset out for a bound (the published "
                "network takes one again once its weights are integers), or promise --psnr"
            )


def options_beyond(
    values: Mapping[str, Any], defaults: Mapping[str, Any]
) -> Iterator[tuple[str, Any]]:
    """Options of the command line, each with its value, for settings other than the defaults.

    A list is one option for each of its values; one that is on or off has the value None.
    """
    for setting in dataclasses.fields(EncodeConfig):
        flag, value = EncodeConfig.label(setting), values.get(setting.name)
        if value is None or value == defaults.get(setting.name):
            continue
        if isinstance(value, bool):
            yield f"--{flag}" if value else f"--no-{flag}", None
            continue
        for each in value if isinstance(value, list | tuple) else [value]:
            yield f"--{flag}", each

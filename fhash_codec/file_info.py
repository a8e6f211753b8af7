"""Information on a file as JSON values: header, card, and variables of data to be encoded.

Modules know these types to mypy alone, so that a file opens fast: Python takes milliseconds to make
them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired, TypedDict

from fhash_codec.measure.errors import StepErrors
from fhash_codec.measure.metrics import BetweenQuality
from fhash_formats.container.reader import Split
from fhash_formats.readers.listing import ListedVariable
from fhash_formats.series import NotStoredValues


class HistoryPoint(TypedDict):
    """A point of the course of a training."""

    epoch: Annotated[float, "epoch, or update of the head"]
    seconds: Annotated[float | None, "since its beginning; null without `--timings`"]
    psnr: Annotated[float | None, "dB on samples"]


class Gain(TypedDict):
    """A part of the search of an encoding, and what came of it."""

    what: Annotated[str, "the part"]
    bytes: Annotated[int, "size of the file after it, estimated but for the last"]
    seconds: Annotated[float, "since the search began"]


class BulkFigures(TypedDict):
    """Figures of the bulk of the values in a file."""

    psnr: NotRequired[Annotated[float | None, "dB, relative to that range"]]
    range: Annotated[list[float], "first and last value of the range"]


class FileQuality(TypedDict, total=False):
    """Figures of the quality in a file, rounded to the worse side; some writers know but a few."""

    psnr: Annotated[float | None, "dB over the coreset"]
    bulk: Annotated[BulkFigures | None, "of the middle 98 % of the values; null without such"]
    rmse: Annotated[float | None, "over the coreset, in data units"]
    max_abs_error: Annotated[float | None, "over the coreset, in data units"]
    ssim: Annotated[float | None, "over the coreset"]
    ssim_window: Annotated[dict[str, Any], "how the similarity was measured"]
    psnr_domain: Annotated[float | None, "dB over every finite vertex"]
    rmse_domain: Annotated[float | None, "over every finite vertex"]
    max_abs_error_domain: Annotated[float | None, "over every finite vertex"]
    between: Annotated[dict[str, float | None], BetweenQuality, "at key frames and between them"]
    per_step: Annotated[list[StepErrors], "of each step, or of some neighbours together"]


class Variable(TypedDict):
    """The variable of a file."""

    name: Annotated[str, "name in the source"]
    units: Annotated[str, "units, may be empty"]
    dtype: Annotated[str, "number type of the source"]
    attributes: Annotated[dict[str, Any], "attributes of the source"]
    fill: NotRequired[Annotated[float, "what stood in the source for a missing value, if any did"]]
    not_stored: NotRequired[Annotated[NotStoredValues, "values that nobody wrote"]]


class Domain(TypedDict):
    """The lattice of a file."""

    shape: Annotated[list[int], "(t, z, y, x)"]


class ArrayOfFile(TypedDict):
    """An array of a file."""

    shape: Annotated[list[int], "lengths of the axes"]
    dtype: Annotated[str, "number type"]
    bytes: Annotated[int, "bytes that it takes in the file"]


class FileInfo(TypedDict):
    """The header of a file, and what follows from it."""

    path: Annotated[str, "the file"]
    name: NotRequired[Annotated[str, "of a variable among several"]]
    bytes: Annotated[int, "its size"]
    split: Annotated[dict[str, int], Split, "`bytes` by what they hold; they add up to it"]
    overhead_bytes: Annotated[int, "bytes of it that are no values"]
    raw_bytes: Annotated[int, "size of the array in the source's number type"]
    ratio: Annotated[float, "`raw_bytes / bytes`"]
    format: Annotated[Literal["fhash"], "name of the format"]
    format_version: Annotated[list[int], "major and minor"]
    required_features: Annotated[list[str], "what a reader must know"]
    encoder: Annotated[
        dict[str, Any], "version and seed; what was predicted; of `fhash pack`, the codec"
    ]
    variable: Annotated[Variable, "what the values are"]
    source: NotRequired[Annotated[dict[str, Any], "what belongs to the variable"]]
    domain: Annotated[Domain, "the lattice"]
    coordinates: Annotated[dict[str, Any], "positions along the axes, as rules or values"]
    value_range: Annotated[list[float], "smallest and largest value"]
    background: Annotated[float, "value outside the coreset on request"]
    features: Annotated[list[str], "as `--feature` names them"]
    dilation: Annotated[int, "vertices by which they grew"]
    feature_bounding_box: Annotated[list[list[int]], "[first, end) along z, y and x"]
    coreset_fraction: Annotated[float, "share of the domain that is kept, 0 to 1"]
    key_frames: Annotated[list[int], "steps that were encoded"]
    model: Annotated[
        dict[str, Any], "the model, see FORMAT.md, The model; `between` is always there"
    ]
    config: Annotated[dict[str, Any], "every setting that the file was made with"]
    mlp: NotRequired[Annotated[dict[str, Any] | None, "MLP of the default model; null for none"]]
    training: Annotated[dict[str, Any], "seconds, epochs, device and more"]
    history: Annotated[list[HistoryPoint], "course of the training"]
    quality: Annotated[FileQuality, "figures of the quality"]
    group: NotRequired[Annotated[str, "group of its arrays, of a variable among several"]]
    shares: NotRequired[Annotated[dict[str, Any], "arrays that are those of another variable"]]
    part: NotRequired[Annotated[dict[str, Any], "of a series that is encoded in parts"]]
    arrays: Annotated[dict[str, ArrayOfFile], "arrays of the file by path"]


class Stored(TypedDict):
    """The place of a part of a model in its file."""

    path: Annotated[str, "its array, group or document; empty where it has none"]
    coding: Annotated[str, "codec, or what stands in its place"]
    bytes: Annotated[int, "bytes that it takes in the file"]


class CardSettings(Stored):
    """The settings of a model."""

    settings: Annotated[int, "how many there are"]


class CardTable(Stored):
    """A level of a model."""

    level: Annotated[int, "number of the level, from 1"]
    shape: Annotated[list[int], "key frames, z, y, x, numbers at a vertex"]
    dtype: Annotated[str, "number type as read"]


class CardLayer(Stored):
    """A layer of a model."""

    layer: Annotated[int, "number of the layer, from 1"]
    shape: Annotated[list[int], "outputs and inputs"]
    activation: Annotated[str, "`relu`, `leaky` or `linear`"]


class CardOccupancy(Stored):
    """The bits of the coreset."""

    shape: Annotated[list[int], "key frames and bytes of each"]
    apart: Annotated[list[str], "features that have bits of their own; empty where merged, or one"]


class ModelCard(TypedDict):
    """The parts of a model and where they lie in the file."""

    config: Annotated[CardSettings, "the settings"]
    tables: Annotated[list[CardTable], "levels, finest first"]
    mlp: Annotated[list[CardLayer], "layers; empty where there is no network"]
    occupancy: Annotated[CardOccupancy, "bits of the coreset"]


class VolumeInfo(FileInfo):
    """The header of a file, what follows from it, and its card."""

    card: Annotated[ModelCard, "parts of the model and where they lie in the file"]


class CoordinateDetails(TypedDict):
    """An axis of a series."""

    axis: Annotated[str, "`t`, `z`, `y` or `x`"]
    name: Annotated[str, "name of the axis"]
    first: Annotated[float | None, "first position"]
    last: Annotated[float | None, "last position"]
    units: Annotated[str, "may be empty"]
    dates: Annotated[list[str], "first and last time as dates; empty where they are none"]


class SeriesDetails(TypedDict):
    """An open series."""

    name: Annotated[str, "as a container has it"]
    shape: Annotated[list[int], "(t, z, y, x)"]
    dtype: Annotated[str, "number type of the values"]
    units: Annotated[str, "may be empty"]
    fill: Annotated[float | None, "what stands for a missing value"]
    not_stored: Annotated[NotStoredValues | None, "values that nobody wrote"]
    coordinates: Annotated[list[CoordinateDetails], "of t, z, y and x"]
    attributes: Annotated[dict[str, Any], "attributes of the variable"]


class DataInfo(TypedDict):
    """Data that can be encoded, instead of a container."""

    path: Annotated[str, "as given"]
    files: Annotated[int, "files of a pattern; 1 without one"]
    variables: Annotated[list[ListedVariable], "what can be encoded and what cannot"]
    series: NotRequired[Annotated[SeriesDetails, "the series that `--var`, `--t` choose"]]


class DatasetInfo(TypedDict):
    """A container of several variables."""

    path: Annotated[str, "the file"]
    format_version: Annotated[list[int], "major and minor"]
    bytes: Annotated[int, "its size"]
    split: Annotated[dict[str, int], Split, "`bytes` by what they hold; they add up to it"]
    raw_bytes: Annotated[int, "size of the values in the number types of their sources"]
    ratio: Annotated[float, "`raw_bytes / bytes`"]
    variables: Annotated[dict[str, FileInfo], "header of each by name, and what follows from it"]

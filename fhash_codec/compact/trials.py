"""Plan of a series: what prices tell, and what is measured on a few coded parts.

These tell the coder, the error that a trellis and a bulk leave, the step of a bound or of a size,
and whether vertices that do not count are filled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from math import prod
from typing import NamedTuple

from fhash_codec.compact.attempt import (
    FAST_BYTES,
    Attempt,
    PlanTask,
    Tiling,
    decoding_ns,
    sub_tile,
)
from fhash_codec.compact.goal import (
    EXCHANGE,
    SLOPE,
    Goal,
    find_step,
    step_after,
    with_step,
)
from fhash_codec.compact.head import choose_head, expected_share, least_gain, training_pairs
from fhash_codec.compact.head_training import foretold_gain
from fhash_codec.compact.planner import Priced, by_prices, in_part, part_costs
from fhash_codec.compact.predictor import choose_predictor
from fhash_codec.compact.sample import Sample, mask_levels
from fhash_codec.compact.tiles import (
    Blocks,
    Coding,
    Outcome,
    coding_of,
    off_trellis,
    on_trellis,
    return_memory,
)
from fhash_codec.compact.transform import (
    NONE,
    Magnitudes,
    in_plane,
    magnitudes_of,
    magnitudes_of_all,
    moved_transform,
    refit,
    scale_of,
    squared_error,
    wavelet,
    weighted,
)
from fhash_codec.progress import skip, stage, tell
from fhash_formats.transform.spec import TransformSpec
from fhash_formats.transform.tile_format import TileSettings

CODED_PART = 1 << 18
"""Vertices of a part that is coded."""
CODED_VERTICES = 1 << 19
"""Vertices of all parts that are coded: a single one foretold a wrong coder."""
LOOKS = 3
"""Times that parts are coded for the step at most."""
FARTHEST = 3.0
"""Factor by which the step changes at most from one look to the next."""
NEAR = 0.35
"""Change of the logarithm of the step, 2 dB, up to which no further look is needed."""
ROUNDING_ERROR = 12**-0.5
"""Root of the mean squared error of rounding to integers, in data units."""


def is_nearly_exact(task: PlanTask) -> bool:
    """Whether a PSNR leaves integers less error than rounding, so that exact ones may be smaller.

    Below the error of that rounding, hardly any step of the quantiser gives the PSNR: a little
    finer, and all values are exact.
    """
    return (
        task.goal.psnr is not None
        and task.blocks.dtype.kind in "iu"
        and task.goal.expected_error < ROUNDING_ERROR
    )


MIN_EFFORT = 2
"""Least effort that uses the trellis."""


def allows_trellis(settings: TileSettings, goal: Goal, effort: int) -> bool:
    """Whether the trellis may be used.

    Values that are exact after all have no use for it. Steps so fine that they need float64 come
    near the finest step there is, with which the plain quantiser errs less.
    """
    exact = goal.error == 0 or goal.data_range <= 0
    return effort >= MIN_EFFORT and not exact and not settings.double


def plan_by_prices(task: PlanTask, settings: TileSettings) -> Attempt:
    """Return the plan of a series, with the step that should keep the promise.

    Vertices that do not count keep the values that are there, or are filled, whichever takes the
    fewer bytes. Where no file tells them, their values mean nothing, and are filled.

    settings: with a first guess of the step.
    """
    task.parts.begin("tiles and transform")
    view, masked = in_part(task.blocks), task.blocks.masked
    density = 0 if task.blocks.complete or masked else task.density
    tiled, settings, found = _priced(task, view, settings, density)
    if task.blocks.complete or not task.asks("filling"):
        return _with_step(task, found, _coded_parts(task, tiled, settings, density))
    task.parts.begin("fill values")
    each = COMPARED_VERTICES // (1 if prod(tiled.shape) <= COMPARED_VERTICES else 2)
    parts = _parts_of(task, tiled, settings, each, COMPARED_VERTICES)
    if not masked:
        return _with_step(task, found, _deepened(task, tiled, parts, settings))
    there, filled = (
        _at_step(task, CodedParts.of(task, tiled, parts, settings, each))
        for each in (0, task.density)
    )
    share = filled.size(task) / there.size(task)
    tell("filling", f"filled parts take {share:.2f} times the bytes")
    found = replace(found, size=min(share, 1.0) * found.size)
    if share >= MISLED:
        return _with_step(task, found, filled if share < 1 else there)
    tiled, settings, found = _priced(task, view, settings, task.density)
    return _with_step(task, found, _coded_parts(task, tiled, settings, task.density))


def _priced(
    task: PlanTask, view: Blocks, settings: TileSettings, density: int
) -> tuple[Blocks, TileSettings, Priced]:
    """Return the tiles, the settings and the plan by prices.

    view: the series, or parts of it.
    settings: with a guess of the step.
    density: thoroughness of filling vertices that do not count; 0 keeps what is there.
    """
    with stage("plan", "tiles, transform and step, by prices of some parts"):
        found = by_prices(task, view, settings, density)
    return_memory()
    return found


def _with_step(task: PlanTask, found: Priced, coded: CodedParts) -> Attempt:
    """Return a plan by prices with its coder and its step, by coded parts."""
    config = task.config
    tiling = None
    if task.fixed_tile is None and config.effort > 1:
        tiling = Tiling(tile=found.tile, price=found.price, tried=found.tried)
        tell("plan", f"--preset {config.preset}: {tiling.describe()}")
    with stage("step", "coder and step, by coding some parts"):
        attempt = _coded(task, coded, found.size)
    task.gains.note("transform by trial", attempt.outcome)
    return replace(attempt, tiling=tiling)


MISLED = 0.4
"""Share of the bytes that filled vertices leave below which prices of the values that were there
chose other tiles: 7 % of the bytes where it is a third."""
DEEP = 4
"""Levels of a deep wavelet along y and x."""
COMPARED_VERTICES = 5 << 18
"""Vertices of the parts of tiles on which fillings are compared: half as many misled."""


@dataclass(frozen=True, kw_only=True)
class CodedParts:
    """Some parts of tiles, as they are coded with the settings of these."""

    tiled: Blocks
    """The series in its tiles."""
    settings: TileSettings
    """Settings of the tiles."""
    coding: Coding
    """Options of the encoder, without the bound."""
    parts: Sample
    """Parts of the tiles, filled where the coding says so."""
    moved: TileSettings
    """Settings of the parts."""

    @classmethod
    def of(
        cls, task: PlanTask, tiled: Blocks, parts: Sample, settings: TileSettings, density: int
    ) -> CodedParts:
        """Return parts, filled with the density; with 0 they keep the values that are there.

        settings: of the plain quantiser.
        """
        goal, config = task.goal, task.config
        coding = coding_of(
            config.effort,
            filled=density == 0,
            density=density,
            bulk=goal.bulk,
            fast=task.takes_fast_coder,
        )
        settings = with_mask(task, parts, settings, goal.expected_error)
        if allows_trellis(settings, goal, config.effort):
            settings, coding = on_trellis(settings, coding)
        moved = moved_transform(parts, settings)
        parts = parts.filled(moved, density)
        return cls(tiled=tiled, settings=settings, coding=coding, parts=parts, moved=moved)

    def run(self, task: PlanTask) -> Outcome:
        """Return the outcome of the parts."""
        return self.parts.run(self.moved, task.goal.bounded(with_fill(self.coding)))

    def size(self, task: PlanTask) -> float:
        """Return the bytes of the parts where they keep the promise, with their mask."""
        return max(_at_promise(self.run(task), task.goal), 1.0)

    def with_step(self, step: float, goal: Goal) -> CodedParts:
        """Return the same parts with another step, and bases as precise as it needs."""
        settings = with_step(self.settings, step, goal)
        moved = replace(self.moved, step=settings.step, double=settings.double)
        return replace(self, settings=settings, moved=moved_transform(self.parts, moved))


def _coded_parts(task: PlanTask, tiled: Blocks, settings: TileSettings, density: int) -> CodedParts:
    """Return the parts that tell coder and step. Arguments as those of `CodedParts.of`."""
    parts = _parts_of(task, tiled, settings, CODED_PART, CODED_VERTICES)
    return CodedParts.of(task, tiled, parts, settings, density)


def _parts_of(
    task: PlanTask, tiled: Blocks, settings: TileSettings, each: int, together: int
) -> Sample:
    """Return parts of tiles, or tiles where none is larger, chosen by their costs.

    each, together: vertices of a part, and of all, at most.
    """
    blocks = tiled.retile(sub_tile(tiled.tile, each))
    return Sample(
        blocks, together, task.workers, part_costs(task, blocks, settings), task.parts.tick
    )


def _at_step(task: PlanTask, coded: CodedParts, psnr: float | None = None) -> CodedParts:
    """Return parts at a step that is nearer to a PSNR in dB, by default the promise, if any."""
    goal = task.goal
    if goal.psnr is None or goal.data_range <= 0:
        return coded
    wanted = goal if psnr is None else replace(goal, psnr=psnr)
    return coded.with_step(step_after(coded.moved, coded.run(task), wanted), goal)


def _deepened(task: PlanTask, tiled: Blocks, parts: Sample, settings: TileSettings) -> CodedParts:
    """Return filled parts with deep wavelets where they take fewer bytes by them.

    No price tells it: they leave hardly anything of a filling that was made for them. Where a file
    tells the values that are there, parts foretold it badly (20 % more bytes on one series).
    """
    tile = parts.blocks.tile
    t, z, y, x = settings.transform.axes
    plane = in_plane("9/7", DEEP, tile)
    along = (wavelet("9/7", 3, tile[0]), wavelet("9/7", 3, tile[1]))
    trials = [
        settings.transform.axes,
        (NONE, z, y, x),
        (t, z, plane[2], plane[3]),
        (*along, plane[2], plane[3]),
    ]
    tried = []
    for axes in dict.fromkeys(trials):
        of_axes = replace(settings, transform=TransformSpec(axes=axes))
        tried.append(_at_step(task, CodedParts.of(task, tiled, parts, of_axes, task.density)))
    return min(tried, key=lambda each: each.size(task))


def with_fill(coding: Coding) -> Coding:
    """Return the coding of tiles that are filled already."""
    return replace(coding, filled=True, density=0)


def with_mask(task: PlanTask, sample: Sample, settings: TileSettings, error: float) -> TileSettings:
    """Return settings with scores for the mask of the vertices that count, if there is one.

    error: root of the mean squared error of the decoded values, in data units.
    """
    if not task.blocks.masked:
        return settings
    levels = mask_levels(task.features, task.config.dilation, error, sample.tiles)
    return replace(settings, mask=levels)


def _coded(task: PlanTask, coded: CodedParts, size: float) -> Attempt:
    """Return the plan with the better coder, at the step that should keep the promise.

    size: bytes of all tiles by price.
    """
    goal, parts, tiled, predicted = task.goal, coded.parts, coded.tiled, PredictedError()
    if task.config.effort > 1 and task.is_slow(tiled.tile, size):
        coded = _with_coder(task, coded, size)
    settings, moved, coding = coded.settings, coded.moved, coded.coding
    outcome = coded.run(task)
    if goal.data_range <= 0:
        pass  # any step gives the one value that there is
    elif goal.psnr is not None:
        settings, moved, outcome, predicted = _promised_step(task, coded, outcome)
        if tiled.complete and may_aim(task, settings, coding):
            coding = replace(coding, aim=predicted.ratio)
    else:
        moved, outcome = find_step(parts, moved, with_fill(coding), goal, tries=3)
        settings = replace(moved, transform=settings.transform)
        if outcome.count:
            error = math.sqrt(outcome.squares / outcome.count)
            settings = with_mask(task, parts, settings, error)
    sample = Sample(tiled, 1, task.workers)
    if parts.blocks.tile == tiled.tile:  # what was measured is what is coded
        settings = replace(settings, transform=moved.transform)
    else:
        settings = refit(sample, settings)
    return Attempt(
        sample=sample,
        settings=settings,
        outcome=outcome,
        coding=coding,
        parts=parts,
        moved=moved,
        magnitudes=predicted.magnitudes,
        ratio=predicted.ratio,
    )


def may_aim(task: PlanTask, settings: TileSettings, coding: Coding) -> bool:
    """Whether tiles can aim at their share of a promised error: integers are rounded besides."""
    return settings.trellis and not coding.fast and task.blocks.dtype.kind == "f"


def of_filled_tiles(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return a plan with the step by the coefficients of all tiles, which are filled now."""
    goal, settings = task.goal, attempt.settings
    if goal.psnr is None or not attempt.ratio or settings.head is not None:
        return attempt
    scale, sample = scale_of(settings), attempt.sample
    tiles = sample.map(lambda tile: magnitudes_of(tile.values, settings))
    series = weighted(tiles, sample.weights)
    error = squared_error(sample.counted, goal.aim(task.config.effort), goal.data_range) * scale**2
    settings = with_step(settings, series.step_of(error / attempt.ratio, settings), goal)
    coding = attempt.coding
    if may_aim(task, settings, coding):
        coding = replace(coding, aim=series.ratio(error, settings))
    return replace(attempt, settings=settings, coding=coding, magnitudes=series)


def _with_coder(task: PlanTask, coded: CodedParts, size: float) -> CodedParts:
    """Return the parts by the fast coder where it takes few enough bytes.

    coded: by the other coder.
    size: bytes of all tiles, approximately.
    """
    reached = coded.run(task).psnr(task.goal.data_range)
    fast = _at_step(task, replace(coded, coding=replace(coded.coding, fast=True)), reached)
    ratio = fast.size(task) / coded.size(task)
    most = most_by_fast_coder(8 * size / prod(task.blocks.shape), task.config.access)
    tell("step", f"the fast coder takes {ratio:.3f} times the bytes, {most:.3f} are allowed")
    return fast if ratio <= most else coded


class PredictedError(NamedTuple):
    """Error of some tiles by their coefficients."""

    magnitudes: Magnitudes | None = None
    """Coefficients of all tiles, or of parts."""
    ratio: float = 0.0
    """Promised error as a multiple of what they predict; 0 where they do not."""


def _promised_step(
    task: PlanTask, coded: CodedParts, outcome: Outcome
) -> tuple[TileSettings, TileSettings, Outcome, PredictedError]:
    """Return settings of a step that should give the promised PSNR, of tiles and of parts.

    The outcome is what is expected of all tiles.

    outcome: of the parts.
    """
    goal, parts = task.goal, coded.parts
    assert goal.psnr is not None
    for look in range(LOOKS + 1):
        settings, moved = coded.settings, coded.moved
        step, predicted = _step(task, settings, moved, coded.tiled, parts, outcome)
        change = min(max(step / settings.step, 1 / FARTHEST), FARTHEST)
        if look == LOOKS or abs(math.log(change)) < NEAR:
            break
        # So far from where it was measured, coefficients foretell the error badly.
        coded = coded.with_step(change * settings.step, goal)
        outcome = coded.run(task)
    octaves = SLOPE * math.log(step / settings.step) / EXCHANGE
    expected = Outcome(
        size=round(outcome.size * 2**-octaves),
        squares=squared_error(parts.counted, goal.psnr, goal.data_range),
        count=parts.counted,
        max_error=outcome.max_error,
    )
    return with_step(settings, step, goal), moved, expected, predicted


def _at_promise(outcome: Outcome, goal: Goal) -> float:
    """Return the bytes at a promised PSNR, by the usual exchange rate of dB for bytes."""
    missing = 0.0 if goal.psnr is None else goal.psnr - outcome.psnr(goal.data_range)
    return outcome.size * 2 ** (missing / EXCHANGE) if math.isfinite(missing) else outcome.size


PEER_NS = (44.0, 58.0)
"""Nanoseconds in which a vertex may be decoded, and more for each of its bits: twice SPERR's."""


def most_by_fast_coder(bits: float, access: str) -> float:
    """Return the bytes that the fast coder may take, as a multiple of those of the other one.

    They grow from 1 on with the time by which the other one is slower than is wished for.

    bits: of a vertex.
    """
    most = FAST_BYTES[access]
    if most < 1 or access != "balanced":
        return most
    late = decoding_ns(bits, "mixing") / (PEER_NS[0] + PEER_NS[1] * bits)
    return min(max(1 + 2 * (most - 1) * (late - 1), 1.0), most)


def _step(
    task: PlanTask,
    settings: TileSettings,
    moved: TileSettings,
    tiled: Blocks,
    parts: Sample,
    outcome: Outcome,
) -> tuple[float, PredictedError]:
    """Return the step at which all tiles should have the promised error, by their coefficients.

    What coefficients foretell is corrected by the true error of coded parts. Where vertices do not
    count, and tiles may be filled, the parts stand for all tiles.

    moved: settings of these parts.
    outcome: of the parts.
    """
    goal = task.goal
    assert goal.psnr is not None
    few = weighted([magnitudes_of(tile.values, moved) for tile in parts.tiles], parts.weights)
    scale = scale_of(settings)
    predicted = few.error(settings.step * scale)
    series, count = few, parts.counted
    if tiled.complete:
        series = magnitudes_of_all(tiled, settings, task.workers)
        count = sum(tiled.weights) * prod(tiled.shape)
        # Parts that reach beyond the border have coefficients of vertices that do not count.
        predicted *= parts.counted / (sum(parts.weights) * prod(parts.blocks.tile))
    if not (predicted > 0 and outcome.squares > 0):
        even = squared_error(count, goal.even_psnr or goal.psnr, goal.data_range * scale)
        return series.step_of(even, settings), PredictedError(magnitudes=series)
    error = squared_error(count, goal.aim(task.config.effort), goal.data_range)
    step = series.step_of(error * (predicted / outcome.squares), settings)
    if outcome.bulk_squares > 0:
        share = outcome.bulk_count / max(outcome.count, 1)
        of_bulk = series.step_of(error * share * (predicted / outcome.bulk_squares), settings)
        if of_bulk < step:
            return of_bulk, PredictedError(magnitudes=series)
    ratio = series.ratio(error * scale**2, replace(settings, step=step))
    return step, PredictedError(magnitudes=series, ratio=ratio)


SEARCHED = 12 << 20
"""Vertices up to which all tiles of a series are coded to compare what few parts do not tell."""
SAMPLED = 6 << 20
"""Vertices of the tiles of a larger series that stand for all."""


def on_all_tiles(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return a plan whose outcome is that of all tiles, or of many where a series is large."""
    if attempt.coded:
        return attempt
    sample, coding = tiles_of(task, attempt), attempt.coding
    outcome = sample.run(attempt.settings, task.goal.bounded(with_fill(coding)))
    return replace(attempt, sample=sample, outcome=outcome, coded=True)


def tiles_of(task: PlanTask, attempt: Attempt) -> Sample:
    """Return all tiles of a plan, or many where a series is large, filled as they are coded."""
    blocks = task.blocks.retile(attempt.sample.blocks.tile)
    most = SEARCHED if prod(blocks.shape) <= SEARCHED else SAMPLED
    return _filled_sample(task, blocks, attempt, most)


def _filled_sample(task: PlanTask, blocks: Blocks, attempt: Attempt, most: int) -> Sample:
    """Return tiles of at most so many vertices together, filled as they are coded."""
    parts = attempt.parts
    if parts is not None and parts.complete and parts.filling and parts.blocks.tile == blocks.tile:
        return parts
    costs = part_costs(task, blocks, attempt.settings)
    sample = Sample(blocks, most, task.workers, costs, task.parts.tick)
    return sample.filled(attempt.settings, attempt.coding.density)


MIN_HEAD_EFFORT = 5
"""Least effort that trains a head."""


def with_head(task: PlanTask, attempt: Attempt, most: float = math.inf) -> Attempt:
    """Return the plan with an MLP where coded parts say that one pays.

    most: bytes that the tiles take in another way, which it has to save as well.
    """
    if reason := _without_head(task, attempt):
        skip("head", reason)
        return attempt
    assert attempt.parts is not None
    assert attempt.moved is not None
    with stage("head trial", "gain of least squares on some parts"):
        coding = task.goal.bounded(replace(with_fill(attempt.coding), aim=0.0))
        pairs = training_pairs(attempt.parts, attempt.moved, coding)
        low, high = attempt.settings.low, attempt.settings.high
        gain = foretold_gain(pairs, low, high, task.config.seed)
    if gain < least_gain(task):
        skip("head", f"least squares gain {gain:.2f} dB on some parts: none would save enough")
        return attempt
    if expected_share(gain) * attempt.outcome.size > most:
        skip("head", "predicted values take fewer bytes than it would leave")
        return attempt
    task.parts.begin("head")
    learned = _filled_sample(task, attempt.sample.blocks, attempt, LEARNED)
    filled = replace(attempt, coding=with_fill(attempt.coding))
    found = choose_head(task, filled, learned, gain)
    return_memory()
    if found is None or found.settings.head is None:
        task.gains.note("head (left out)", attempt.outcome)
        return attempt if found is None else replace(attempt, history=found.history)
    task.gains.note("head", found.outcome)
    if learned.complete:  # it is filled: no plan fills it again
        attempt = replace(attempt, sample=learned)
    return replace(
        attempt,
        settings=found.settings,
        coding=found.coding,
        plain=replace(attempt, history=found.history),
        saved=1 - found.outcome.size / max(attempt.outcome.size, 1),
        outcome=found.outcome,
        history=found.history,
        coded=False,
    )


def _without_head(task: PlanTask, attempt: Attempt) -> str:
    """Return why no head is to be trained; "" where one is."""
    goal, effort, train = task.goal, task.config.effort, task.config.train
    if train == "none":
        return "--train none"
    if train == "auto" and effort < MIN_HEAD_EFFORT:
        return f"effort {effort} trains none; from {MIN_HEAD_EFFORT} on"
    if goal.size is not None:
        return "a promised ratio: the step changes once the whole file is known"
    if goal.error == 0 or goal.data_range <= 0:
        return "exact values leave nothing to correct"
    if attempt.settings.double:
        return "the step is too fine for float32, in which heads compute"
    return ""


LEARNED = 12 << 20
"""Vertices of the tiles that are learned from, unless a single one has more."""


def predicted_or_corrected(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return the plan with a head, or with a predictor under a strict bound, if that is smaller."""
    settings = _predictor_of(task, attempt)
    if settings is None:
        return with_head(task, attempt)
    attempt = on_all_tiles(task, attempt)
    coding = task.goal.bounded(with_fill(attempt.coding))
    outcome = attempt.sample.run(settings, coding)
    predicted, size = replace(attempt, settings=settings, outcome=outcome), outcome.size
    attempt = with_head(task, attempt, size)
    # What is predicted is read slowly: no reason to give up the fast coder for little.
    share = FAST_BYTES[task.config.access] if attempt.coding.fast else 1.0
    kept = size * share < attempt.outcome.size
    task.gains.note("prediction" if kept else "prediction (left out)", outcome)
    return predicted if kept else attempt


def _predictor_of(task: PlanTask, attempt: Attempt) -> TileSettings | None:
    """Return settings with a predictor where some parts take fewer bytes by it."""
    goal, effort = task.goal, task.config.effort
    if not goal.error or goal.data_range <= 0:
        skip("predictor", "only a bound on each error has use for it")
        return None
    if effort == 1 or not task.asks("predictor"):
        return None
    assert attempt.parts is not None
    with stage("predictor", "trials beside the transform, for the bound on each error"):
        settings = choose_predictor(
            attempt.sample,
            attempt.parts,
            attempt.settings,
            attempt.outcome.size,
            error=goal.error,
            effort=effort,
        )
    if settings is not None and settings.trellis:
        settings, _ = off_trellis(settings, attempt.coding)  # no tile has coefficients now
    return settings

"""Promises held against the figures of a written file, and what a user should know beside them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from fhash_codec.compact.choices.search import EXCHANGE
from fhash_codec.compact.goal import DEFAULT_PSNR, DEFAULT_PSNR_BULK, RATIO_SLACK
from fhash_codec.config import PROMISES, EncodeConfig

__all__ = ["decided_by_bulk", "missed_promise", "remarks"]

FAR_BELOW = 15.0
"""dB by which the PSNR of the bulk may be below that of the whole range without a remark."""

DECIDED = 0.3
"""dB by which a PSNR must exceed its promise, and the other one may, where that one decided."""


def missed_promise(config: EncodeConfig, figures: Mapping[str, Any]) -> str | None:
    """Text on a promise that a file misses; None if it keeps what the settings promise.

    figures: of the file, as in `report`; `promised` has what its header says was promised.
    """
    promised = figures["promised"]
    return (
        _missed_bound(config, figures)
        or _missed_psnr(promised.get("psnr"), figures["psnr"], figures["rmse"], "the coreset")
        or _missed_bulk(promised.get("psnr_bulk"), figures)
        or _missed_ratio(config, figures)
    )


def remarks(config: EncodeConfig, figures: Mapping[str, Any]) -> Iterator[str]:
    """Remarks on a file that keeps its promise, for the user, one line each.

    figures: of the file, as in `report`.
    """
    bulk = figures["quality"]["bulk"]
    psnr, psnr_bulk = figures["psnr"], figures["psnr_bulk"]
    trained = config.profile == "paper" and config.psnr is None
    if config.psnr_bulk is None and not trained and None not in (psnr, psnr_bulk):
        enough = min(DEFAULT_PSNR_BULK, psnr - FAR_BELOW)
        if psnr_bulk < enough:
            low, high = bulk["range"]
            yield (
                f"98 % of the values lie from {low:g} to {high:g}, and have {psnr_bulk:.1f} dB "
                f"within that range, beside {psnr:.1f} dB within the whole; "
                f"{_mending(config)} keeps them"
            )
    if config.ratio is not None and figures["ratio"] > config.ratio * RATIO_SLACK:
        why = (
            "its values are exact already"
            if figures["rmse"] == 0
            else "no step of the quantiser comes nearer"
        )
        yield (
            f"the file is {figures['ratio']:.4g} times smaller than the data, "
            f"{config.ratio:g} times were asked for: {why}"
        )


def decided_by_bulk(config: EncodeConfig, figures: Mapping[str, Any]) -> str | None:
    """Text on a file that is larger for its bulk's sake; None where that did not decide.

    figures: of the file, as in `report`.
    """
    given = [name for name in PROMISES if getattr(config, name) is not None]
    psnr, psnr_bulk = figures["psnr"], figures["psnr_bulk"]
    if config.profile != "compact" or None in (psnr, psnr_bulk):
        return None
    if given not in ([], ["psnr", "psnr_bulk"]):
        return None
    whole = DEFAULT_PSNR if config.psnr is None else config.psnr
    bulk = DEFAULT_PSNR_BULK if config.psnr_bulk is None else config.psnr_bulk
    if psnr < whole + DECIDED or psnr_bulk > bulk + DECIDED:
        return None
    low, high = figures["quality"]["bulk"]["range"]
    share = 1 - 2 ** (-(psnr - whole) / EXCHANGE)
    return (
        f"the bulk decided: {bulk:g} dB within it, from {low:g} to {high:g}, took {psnr:.1f} dB "
        f"over all values, where {whole:g} are promised; that is about {share:.0%} of the file, "
        f"and --psnr {whole:g} alone leaves it out"
    )


def _mending(config: EncodeConfig) -> str:
    """The option that keeps the bulk, beside the promise or in its place."""
    option = f"--psnr-bulk {DEFAULT_PSNR_BULK:g}"
    given = [name for name in PROMISES if getattr(config, name) is not None]
    if not given:
        return option
    name = given[0]
    relation = "beside" if name == "psnr" else "instead of"
    return f"{option} {relation} --{name.replace('_', '-')}"


def _missed_bound(config: EncodeConfig, figures: Mapping[str, Any]) -> str | None:
    """Text on an error beyond the promised bound; None if there is no such promise or it holds."""
    bound = math.inf
    if config.max_error is not None:
        bound = config.max_error
    elif config.max_error_rel is not None:
        bound = config.max_error_rel * figures["data_range"]
    largest = figures["max_abs_error"]
    if largest is not None and largest > bound:
        return f"a largest error of {largest:g}, at most {bound:g} was asked for"
    return None


def _missed_psnr(
    promised: float | None, psnr: float | None, rmse: float | None, where: str
) -> str | None:
    """Text on a PSNR below the promised one; None if there is no such promise or it holds."""
    if promised is None or rmse == 0:
        return None
    if psnr is None:
        return f"an unknown PSNR over {where}, {promised:g} dB were asked for"
    if psnr < promised:
        return f"{psnr:.2f} dB over {where}, {promised:g} dB were asked for"
    return None


def _missed_bulk(promised: float | None, figures: Mapping[str, Any]) -> str | None:
    """Text on a PSNR of the bulk below the promised one; None if there is none or it holds."""
    bulk = figures["quality"]["bulk"]
    if promised is None or figures["rmse"] == 0:
        return None
    if bulk is None:
        return (
            "the middle 98 % of the values are all the same, and have no PSNR, "
            f"{promised:g} dB were asked for"
        )
    return _missed_psnr(promised, bulk["psnr"], bulk["rmse"], "the bulk")


def _missed_ratio(config: EncodeConfig, figures: Mapping[str, Any]) -> str | None:
    """Text on a file that is too large for the promised ratio; None if it is not."""
    if config.ratio is None or figures["ratio"] >= config.ratio:
        return None
    return f"{figures['ratio']:.4g} times smaller than the data, {config.ratio:g} were asked for"

"""An easy case, a run of it, and runs whose decoded values are spoiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.selftest.case import Case, Check, Finding, Run
from fhash_codec.selftest.field_cases import series, waves

CASE = Case(
    name="easy",
    group="values",
    about="nothing is hard",
    make=lambda: series(waves().astype(np.float32)),
    settings={"bound": EncodeConfig(max_error_rel=0.01, effort=1, timings=False)},
)
PAPER = EncodeConfig(preset="published", tables="float16", width=4, epochs=2, timings=False)


@pytest.fixture(scope="session")
def easy() -> Case:
    """A case that holds, with one settings."""
    return CASE


@pytest.fixture(scope="session")
def compact_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """The easy case, encoded with the default preset."""
    yield from _run("default", tmp_path_factory)


@pytest.fixture(scope="session")
def paper_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """The easy case, encoded with the preset published."""
    yield from _run("published", tmp_path_factory)


@pytest.fixture(scope="session", params=["compact", "paper"])
def run(request: pytest.FixtureRequest) -> Run:
    """The easy case, encoded with either preset."""
    chosen: Run = request.getfixturevalue(f"{request.param}_run")
    return chosen


def _run(preset: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp(preset)
    config = CASE.settings["bound"] if preset == "default" else PAPER
    source = CASE.make()
    encode(source, folder / "case.fhz", config)
    with fhash_codec.open(folder / "case.fhz") as volume:
        yield Run(
            case=CASE,
            series=source,
            values=np.stack(list(source.frames())),
            under=preset,
            config=config,
            folder=folder,
            path=folder / "case.fhz",
            volume=volume,
        )


@pytest.fixture(scope="session")
def spoiled() -> Callable[..., Run]:
    """A function of a run and of decoded values: the run as if its file decoded to these."""

    def make(run: Run, decoded: np.ndarray) -> Run:
        other = replace(run)
        other.__dict__["decoded"] = decoded
        return other

    return make


@pytest.fixture(scope="session")
def broken() -> Callable[[Run, Check], set[str]]:
    """A function of a run and a check: the names of the properties that do not hold."""

    def names(run: Run, check: Check) -> set[str]:
        return {finding.name for finding in check(run) if not finding.holds}

    return names


@pytest.fixture(scope="session")
def figure() -> Callable[[float], Check]:
    """A function of a figure: a check that finds it for the property 'planted', at most 1."""

    def make(worst: float) -> Check:
        def check(run: Run) -> list[Finding]:
            return [Finding("planted", worst, 1.0, "a|b")]

        return check

    return make

"""Figures of fhash on kinds of data, beside another checkout, SPERR and SZ3: `fhash bench kinds`.

Each fhash encodes in a process of its own with one thread, and the processes take turns.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import geometric_mean, median
from typing import Annotated, Any, TypedDict

import numpy as np

from fhash_bench.rate.kinds import EVERY_GOAL, KINDS, Kind, Settings
from fhash_bench.rate.measuring import random_regions
from fhash_bench.rate.mine import decibels, gradient, range_of, rms, seams, spectrum_error
from fhash_bench.rate.peers import PeerFiles, all_filters, spent, there_and_back
from fhash_bench.rate.rate import bench_of
from fhash_codec.config import DEFAULT_PSNR, DEFAULT_PSNR_BULK
from fhash_codec.cost.peers import Variant
from fhash_codec.devices import machine
from fhash_codec.measure.errors import MIN_SHARE
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import FhashError, InputError, suggestion
from fhash_formats.series import ArraySeries
from fhash_formats.support.threads import at_most, usable_threads
from fhash_formats.support.values import Mask, Values

FILTERS = ("SPERR", "SZ3")
"""Peers."""
OWN, BESIDE, THREADS = "fhash", "beside", "threads"
"""Names of this fhash, of the other one and of this one on all processors among the coders."""
MEASURES = ("bytes", "encode_seconds", "decode_seconds")
"""Figures that ratios are taken of."""
BULK_SLACK = 0.1
"""dB that the PSNR of the bulk may miss: the encoder rounds the ends of the bulk."""
DECODINGS = 3
"""Decodings after each encoding, of which the best counts; most take a few ms."""
NOTES = (
    "seconds are those of the processor on one thread, with the array in memory; decoding opens the"
    " file, and the best of 3 counts; region: up to 16 x 16 x 16 vertices of one step of a file"
    " that was just opened, the median of 8 places",
    "threads: this fhash on all processors, whose seconds are those of the clock; ratios to it are"
    " how much faster it is, and the worst is the smallest",
    "kept: whether NumPy finds the promise kept on the decoded array, and values at the right"
    " vertices",
    "bytes of a peer are those of its chunks, one for each frame, at the PSNR that fhash reached or"
    " at the same bound; SZ3 is measured for bounds, and no peer for features and exact values",
    "gradient: PSNR of central differences in space, relative to their range",
    "spectrum: largest relative error of a bin in the middle step, after a Hann window; bins are"
    " whole wave numbers, and those that hold 99 % of the energy count",
    "seams: RMS error in the two planes at each border of tiles over that of all other planes",
)


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Quality of a decoded array, over the vertices that the promise is about."""

    kept: Annotated[bool, "whether the promise is kept"]
    psnr: Annotated[float | None, "dB; null where exact"]
    max_error: Annotated[float, "share of the range"]
    gradient_psnr: Annotated[float | None, "dB, of central differences in space; null where exact"]
    spectrum_error: Annotated[float, "largest relative error of the power in a bin"]
    seams: Annotated[float | None, "RMS error at borders of tiles over that elsewhere"]


@dataclass(frozen=True, kw_only=True)
class Figures(Judged):
    """Figures of one coder."""

    coder: Annotated[str, "`fhash`, `beside`, `threads` or a peer"]
    bytes: Annotated[int, "of the file, or of a peer's chunks"]
    encode_seconds: Annotated[float, "of the processor"]
    decode_seconds: Annotated[float, "likewise"]
    region_ms: Annotated[float, "of the processor, for a region"]


@dataclass(frozen=True, kw_only=True)
class KindCase:
    """A kind of data at one goal."""

    kind: Annotated[str, "its name"]
    chosen: Annotated[bool, "whether the encoder is decided on this kind"]
    goal: Annotated[str, "the promise in words"]
    settings: Annotated[dict[str, Any], "of the encoding"]
    shape: Annotated[tuple[int, ...], "(t, z, y, x)"]
    dtype: Annotated[str, "number type"]
    raw_bytes: Annotated[int, "size of the array"]
    figures: Annotated[tuple[Figures, ...], "of each coder, this fhash first"]

    def of(self, coder: str) -> Figures | None:
        """Figures of a coder; None where it was not measured."""
        return next((each for each in self.figures if each.coder == coder), None)


class Ratio(TypedDict):
    """Ratios of a figure of this fhash to that of another coder; below 1, this one is better.

    Those to more threads of this one are how much faster they are.
    """

    chosen: Annotated[bool, "over kinds that the encoder is decided on, or over the others"]
    coder: Annotated[str, "the other coder"]
    measure: Annotated[str, "`bytes`, `encode_seconds` or `decode_seconds`"]
    mean: Annotated[float, "geometric mean over kinds and goals"]
    worst: Annotated[float, "the largest; of `threads` the smallest"]
    case: Annotated[str, "kind and goal of the worst"]


@dataclass(frozen=True, kw_only=True)
class KindsBench:
    """Figures of every kind and goal."""

    cases: Annotated[tuple[KindCase, ...], "kinds that the encoder is not decided on come first"]
    commits: Annotated[dict[str, str | None], "of each fhash; null outside of a checkout"]
    refused: Annotated[dict[str, str], "reasons by case and peer that was not measured"]
    machine: Annotated[dict[str, Any], "this machine"]
    notes: Annotated[tuple[str, ...], "how the figures were taken"] = NOTES

    def ratios(self) -> list[Ratio]:
        """Ratios to each other coder, those over kinds that are only reported first."""
        rows: list[Ratio] = []
        for chosen in (False, True):
            for coder in (BESIDE, THREADS, *FILTERS):
                worst: Any = min if coder == THREADS else max
                for measure in MEASURES[1:] if coder == THREADS else MEASURES:
                    found = {
                        f"{case.kind}, {case.goal}": getattr(own, measure) / getattr(other, measure)
                        for case in self.cases
                        if case.chosen is chosen
                        and (own := case.of(OWN))
                        and (other := case.of(coder))
                    }
                    if found:
                        rows.append(
                            Ratio(
                                chosen=chosen,
                                coder=coder,
                                measure=measure,
                                mean=geometric_mean(found.values()),
                                worst=worst(found.values()),
                                case=worst(found, key=found.__getitem__),
                            )
                        )
        return rows

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**asdict(self), "ratios": self.ratios()}


def bench_kinds(
    kinds: Sequence[str] = (),
    *,
    beside: str | Path | None = None,
    names: Sequence[str] = FILTERS,
    repeat: int = 1,
    scale: float = 1.0,
    effort: int | None = None,
    progress: Progress = silent,
) -> KindsBench:
    """Encodes and decodes kinds of data with this fhash, another one and peers.

    Args:
        kinds: names of KINDS; all that are not large if there are none.
        beside: folder with the package of another fhash, such as a checkout that is built in place.
        names: peers, of FILTERS, and THREADS.
        repeat: runs of which the fastest counts.
        scale: factor of the lengths of the arrays.
        effort: of all encodings; the default if None.

    Raises InputError for an unknown kind or a folder without fhash, FhashError where an encode
    fails, and MissingDependencyError without hdf5plugin.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise InputError(f"'{kind}' is no kind; {suggestion(kind, KINDS)}")
    wanted = [name for name, kind in KINDS.items() if (name in kinds if kinds else not kind.large)]
    found = [name for name in names if name in FILTERS]
    filters, threads = all_filters() if found else {}, usable_threads()
    peers = [variant for name in found for variant in filters[name] if variant.layout == "frame"]
    with ExitStack() as stack:
        stack.enter_context(at_most(1))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fhash-bench-")))
        coders = [stack.enter_context(Coder(OWN, None, folder))]
        if beside is not None:
            coders.append(stack.enter_context(Coder(BESIDE, Path(beside).resolve(), folder)))
        if THREADS in names:
            coders.append(stack.enter_context(Coder(THREADS, None, folder, threads)))
        run, cases = _Run(coders, peers, repeat, folder), []
        run.warm_up()
        for number, name in enumerate(wanted):
            values, settings = KINDS[name].series(name, scale)
            for goal in (settings, *(EVERY_GOAL if KINDS[name].every_goal else ())):
                progress("measuring", number, len(wanted), f"{name}, {goal_name(goal)}")
                at_effort = goal if effort is None else {**goal, "effort": effort}
                cases.append(run.case(name, KINDS[name], values, at_effort))
        progress("measuring", len(wanted), len(wanted), "")
        return KindsBench(
            cases=tuple(cases),
            commits={coder.name: commit_of(coder.package) for coder in coders},
            refused=run.refused,
            machine=machine(),
        )


def goal_name(settings: Mapping[str, Any]) -> str:
    """The promise of settings in words."""
    if "psnr" in settings:
        return f"{settings['psnr']:g} dB"
    if "max_error_rel" in settings:
        return f"within {100 * settings['max_error_rel']:g} %"
    return "exact" if "max_error" in settings else "default"


def coding_process() -> None:
    """Reads jobs as lines of JSON from stdin, and prints the figures of each as a line of JSON.

    The text of this function runs in a process, maybe with an older fhash. It therefore imports all
    modules itself, and uses only `encode`, `open` and the settings of fhash.
    """
    import json
    import os
    import statistics
    import sys
    import time
    import warnings

    import numpy as np

    import fhash_codec
    from fhash_codec.config import EncodeConfig

    opened: Any = fhash_codec.open
    alone = os.environ["FHASH_THREADS"] == "1"
    clock = time.process_time if alone else time.perf_counter

    def seconds(work: Any, *inputs: Any) -> tuple[float, Any]:
        begun = clock()
        result = work(*inputs)
        return max(1e-6, clock() - begun), result

    def encode(values: Any, path: str, settings: Any) -> None:
        try:
            config = EncodeConfig.from_dict({**settings, "timings": False})
            fhash_codec.encode(values, path, config, force=True)
        except Exception as error:
            if not hasattr(error, "figures"):
                raise
            os.replace(error.figures["path"], path)  # a file that misses its promise is judged

    def decode(path: str) -> tuple[Any, Any]:
        with opened(path) as volume:
            tiles = [[n, *span] for n, span in zip(volume.chunks[1:], volume.box, strict=True)]
            return volume[...], tiles

    def answer(array: str, path: str, decoded: str, settings: Any, regions: Any, runs: int) -> Any:
        encoding, _ = seconds(encode, np.load(array), path, settings)
        decodings = [seconds(decode, path) for _ in range(runs)]
        values, tiles = decodings[0][1]
        np.save(decoded, values)
        reading = []
        for step, spans in regions:
            with opened(path) as volume:
                place = (step, *(slice(*span) for span in spans))
                reading.append(seconds(volume.__getitem__, place)[0])
        figures = {
            "bytes": os.path.getsize(path),
            "encode_seconds": encoding,
            "decode_seconds": min(run[0] for run in decodings),
            "region_ms": 1000 * statistics.median(reading[1:]),
        }
        return figures, tiles

    warnings.simplefilter("ignore")
    print(json.dumps(os.path.dirname(fhash_codec.__file__)), flush=True)
    for line in sys.stdin:
        print(json.dumps(answer(*json.loads(line))), flush=True)


class Coder:
    """A process in which one fhash encodes and decodes, as a context manager.

    Attributes:
        name: of the coder.
        package: folder of the package that it imports.
    """

    def __init__(self, name: str, root: Path | None, folder: Path, threads: int = 1) -> None:
        """Starts the process.

        root: folder with the package of another fhash, None for this one. folder: of its files.
        threads: with which it codes; the seconds of several are those of the clock.
        Raises InputError where the root has no fhash that can be imported.
        """
        self.name, self._folder = name, folder
        paths = [*([] if root is None else [str(root), str(root / "formats")]), *sys.path]
        names = "FHASH_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"
        lines = "from __future__ import annotations", inspect.getsource(coding_process)
        program = "\n".join([*lines, f"{coding_process.__name__}()"])
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                **dict.fromkeys(names, str(threads)),
                "PYTHONPATH": os.pathsep.join(paths),
            },
            text=True,
        )
        try:
            self.package = Path(self._answer()).resolve()
            if root is not None and self.package.parent != root:
                raise InputError(f"'{root}' has no package fhash_codec that is built in place")
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> Coder:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def code(self, array: Path, settings: Settings, shape: Sequence[int]) -> tuple[Any, Any, Any]:
        """Figures of the file of an array, its tiles as for `judge`, and the decoded values."""
        regions = list(random_regions(shape))
        paths = (array, self._folder / f"{self.name}.fhz", self._folder / f"{self.name}.npy")
        job = json.dumps([*map(str, paths), settings, regions, DECODINGS])
        print(job, file=self._process.stdin, flush=True)
        figures, tiles = self._answer()
        return figures, tiles, np.load(paths[2])

    def _answer(self) -> Any:
        """The next line that the process prints; raises FhashError where it ended."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise FhashError(f"the process of {self.name} ended; its last words are above")
        return json.loads(line)


def commit_of(package: Path) -> str | None:
    """Commit of the checkout that holds a package, with "-dirty" after changes; None without."""
    for words in ("ls-files --error-unmatch __init__.py", "describe --always --dirty"):
        git = ["git", "-C", str(package), *words.split()]
        try:
            done = subprocess.run(git, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
    return done.stdout.strip()


def judge(
    values: Values, decoded: Values, settings: Settings, tiles: Sequence[Sequence[int]] = ()
) -> Judged:
    """Quality of a decoded array (t, z, y, x), which NumPy alone computes.

    tiles: see `near_borders`.
    """
    counted = counted_vertices(values, settings)
    frames = np.where(counted, values.astype(np.float64), np.nan)
    errors = decoded - frames
    steep = [(np.fmin.reduce(each), np.fmax.reduce(each)) for each in map(gradient, frames)]
    width, middle = range_of(values), len(values) // 2
    return Judged(
        kept=promise_kept(values, decoded, settings, counted),
        psnr=decibels(width, rms(errors)),
        max_error=float(np.fmax.reduce(np.abs(errors), axis=None)) / width,
        gradient_psnr=decibels(np.nanmax(steep) - np.nanmin(steep), rms(map(gradient, errors))),
        spectrum_error=spectrum_error(frames[middle], frames[middle] + errors[middle]),
        seams=seams(errors, tiles),
    )


def counted_vertices(values: Values, settings: Settings) -> Mask:
    """The vertices that a promise is about: finite ones, or those of the feature, grown by one."""
    counted = np.isfinite(values)
    for feature in settings.get("features", ()):
        low, high = map(values.dtype.type, feature.split(":")[1:])
        chosen = np.pad(counted & (values >= low) & (values <= high), [(0, 0), *[(1, 1)] * 3])
        around = np.lib.stride_tricks.sliding_window_view(chosen, (3, 3, 3), axis=(1, 2, 3))
        counted &= around.any(axis=(4, 5, 6))
    return counted


def promise_kept(values: Values, decoded: Values, settings: Settings, counted: Mask) -> bool:
    """Whether a decoded array keeps the promise of settings, with values where they are counted."""
    if not np.array_equal(np.isfinite(decoded), counted):
        return False
    width, promised = range_of(values), values[counted].astype(np.float64)
    errors = np.abs(decoded[counted] - promised)
    bound = settings.get("max_error", settings.get("max_error_rel", math.inf) * width)
    if bound < math.inf:
        return bool(errors.max() <= bound * (1 + 1e-12))  # the product is rounded
    low, high = np.percentile(promised, [1, 99])
    needed = [(width, errors, settings.get("psnr", DEFAULT_PSNR))]
    if "psnr" not in settings and high - low >= MIN_SHARE * width:
        bulk = errors[(promised >= low) & (promised <= high)]
        needed.append((high - low, bulk, DEFAULT_PSNR_BULK - BULK_SLACK))
    return all((decibels(span, rms([part])) or math.inf) >= psnr for span, part, psnr in needed)


class _Run:
    """Coders and peers that are measured in a folder, and why peers were left out."""

    def __init__(
        self, coders: Sequence[Coder], peers: Sequence[Variant], repeat: int, folder: Path
    ) -> None:
        self._coders, self._peers, self._repeat, self._folder = coders, peers, repeat, folder
        self._array = folder / "array.npy"
        self.refused: dict[str, str] = {}

    def warm_up(self) -> None:
        """Makes each coder load its modules before anything is measured."""
        values, _ = KINDS["single"].series("single", 0.5)
        np.save(self._array, values)
        feature: Settings = {"features": ["interval:0:9"]}
        for coder in self._coders:
            for settings in ({}, {"max_error_rel": 0.01}, feature):
                coder.code(self._array, settings, values.shape)

    def case(self, name: str, kind: Kind, values: Values, settings: Settings) -> KindCase:
        """Figures of all coders and peers at one goal."""
        np.save(self._array, values)
        best: dict[str, dict[str, Any]] = {}
        judged: dict[str, Judged] = {}
        for _ in range(self._repeat):
            for coder in self._coders:
                new, tiles, decoded = coder.code(self._array, settings, values.shape)
                old = best.get(coder.name, new)
                best[coder.name] = {key: min(value, old[key]) for key, value in new.items()}
                if coder.name not in judged:
                    judged[coder.name] = judge(values, decoded, settings, tiles)
        own = [Figures(coder=coder, **best[coder], **asdict(judged[coder])) for coder in best]
        case = KindCase(
            kind=name,
            chosen=kind.chosen,
            goal=goal_name(settings),
            settings=settings,
            shape=values.shape,
            dtype=values.dtype.name,
            raw_bytes=values.nbytes,
            figures=tuple(own),
        )
        exact = "max_error" in settings or "features" in settings
        mode = "tolerance" if "max_error_rel" in settings else "PSNR"
        for variant in self._peers:
            if variant.mode == mode and not exact:
                try:
                    found = self._peer(variant, values, settings, judged[OWN].psnr or math.inf)
                except InputError as error:
                    self.refused[f"{name}, {case.goal}, {variant.peer}"] = str(error)
                else:
                    case = replace(case, figures=(*case.figures, found))
        return case

    def _peer(self, variant: Variant, values: Values, settings: Settings, psnr: float) -> Figures:
        """Figures of a peer at the bound of the settings, or else at a PSNR in dB.

        Raises InputError where the peer refuses the array, or does not reach the quality.
        """
        bound = settings.get("max_error_rel")
        goal = ("psnr", psnr) if bound is None else ("bound", float(bound))
        bench = bench_of(ArraySeries(values, name="kind"), self._folder, [goal], silent)
        bench.search(variant)
        best = bench.best[goal].get(variant.peer)
        if best is None or not best.reached:
            raise InputError(bench.refused.get(variant.name, f"{variant.name} does not reach it"))
        coded = (bench.filled, variant, bench.range, best.trial.level, self._folder)
        files = PeerFiles(*coded)
        decoded = np.where(np.isfinite(values), there_and_back(*coded)[0], np.nan)
        encoding = min(spent(files.encode).core for _ in range(self._repeat))
        reading = [files.read_region(*place)[1].core for place in random_regions(values.shape)]
        return Figures(
            coder=variant.peer,
            bytes=best.trial.bytes,
            encode_seconds=encoding,
            decode_seconds=min(spent(files.decode).core for _ in range(DECODINGS * self._repeat)),
            region_ms=1000 * median(reading[1:]),
            **asdict(judge(values, decoded, settings)),
        )

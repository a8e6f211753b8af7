"""Settings: the round trip, and a clear error for each value that is not allowed."""

from __future__ import annotations

import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import MISSING, FrozenInstanceError, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forked import ended_well, forked, needs_fork

from fhash_codec import devices
from fhash_codec import progress as stage_clock
from fhash_codec.config import EncodeConfig
from fhash_codec.devices import (
    CUDA_PAYS,
    VERTICES_A_THREAD,
    choose_device,
    computing_threads,
    enough_memory,
    has_torch,
    leave_threads_of_parent,
    machine,
    need_torch,
    same_bits,
    threads_for,
    training_device,
)
from fhash_codec.native.network import machine_paths
from fhash_codec.paper.engines.native import cpu_seconds
from fhash_codec.paper.network import Architecture
from fhash_codec.progress import OTHER, Parts, attribute, recording, skip, stage
from fhash_codec.records import Record, limits
from fhash_codec.rendering.scenes import Scene
from fhash_formats.errors import FhashWarning, InputError, MissingDependencyError, MissingInputError
from fhash_formats.support.threads import usable_threads


@pytest.mark.parametrize(
    "config",
    [
        EncodeConfig(),
        EncodeConfig(
            features=("interval:0:1", "isosurface:3"), max_error=0.5, effort=3, tile="4x8x8x8"
        ),
        EncodeConfig(
            preset="published", key_frames="0,4,9", psnr=45.0, epochs=0, learning_rate=1e-3
        ),
    ],
    ids=["default", "changed", "paper"],
)
def test_from_dict_of_to_dict_is_the_same_even_through_json(config) -> None:
    assert EncodeConfig.from_dict(config.to_dict()) == config
    assert EncodeConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_an_unknown_name_is_refused_and_the_nearest_is_offered() -> None:
    with pytest.raises(InputError, match=r"'learning_rat'.*'learning_rate'"):
        EncodeConfig.from_dict({"learning_rat": 0.1})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"device": "warp"}, "device is 'warp'; allowed: auto, cpu, cuda"),
        (
            {"preset": "published", "ratio": 9.0},
            "ratio is not for --preset published",
        ),
        ({"preset": "published", "effort": 1}, "effort is not for --preset published"),
        (
            {"preset": "published", "max_error": 1.0},
            "max-error is not for --preset published, whose",
        ),
        (
            {"preset": "published", "max_error_rel": 0.1},
            "max-error-rel is not .* leave --preset out",
        ),
        ({"preset": "published", "epochs": 5, "train_on_seconds": 9}, "give one of them"),
        ({"preset": "published", "tile": "whole"}, "tile is not for --preset published"),
        ({"key_frames": [0, 2]}, "key-frames belongs to --preset published; the preset is default"),
        *(
            ({name: value}, f"{name.replace('_', '-')} belongs to --preset published")
            for name, value in {
                "fold": 3,
                "embedding_size": 1,
                "hidden_layers": 1,
                "width": 8,
                "epochs": 1,
                "learning_rate": 0.1,
                "schedule": "constant",
                "batch": 64,
                "tables": "uint8",
            }.items()
        ),
        (
            {"psnr": 40.0, "max_error": 1.0, "ratio": 3.0},
            "psnr and max-error and ratio are given; promise one of them",
        ),
        ({"psnr_bulk": 40.0, "max_error": 1.0}, "psnr-bulk and max-error are given; promise one"),
        ({"preset": "fast", "tile": "whole"}, "preset 'fast' and tile 'whole' are given"),
        ({"preset": "compact"}, "preset is 'compact'; allowed: default, small, fast, published"),
        ({"profile": "paper"}, "unknown setting 'profile'"),
        ({"psnr_bulk": 401.0}, "psnr-bulk is 401"),
        ({"effort": 2.5}, "effort is 2.5; a whole number"),
        ({"fold": 1}, "fold is 1; allowed: 2 to 64"),
        ({"fold": 2.5}, "fold is 2.5; a whole number"),
        ({"epochs": True}, "epochs is True"),
        ({"epochs": "many"}, "epochs is 'many'"),
        ({"learning_rate": float("nan")}, "learning-rate is nan"),
        ({"psnr": -1.0}, "psnr is -1"),
        ({"features": ()}, "feature is empty"),
        ({"dilation": -1}, "dilation is -1"),
        ({"without": ("tile",)}, "without names 'tile'; did you mean 'tiles'"),
        (
            {"preset": "published", "without": "tiles"},
            "without names 'tiles', which --preset published does not have; it has ssim",
        ),
    ],
)
def test_a_value_that_is_not_allowed_is_named_with_what_is(values, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        EncodeConfig.from_dict(values)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("preset", "access", "published"),
    [
        ("default", "balanced", False),
        ("small", "small", False),
        ("fast", "fast", False),
        ("published", "balanced", True),
    ],
)
def test_a_preset_says_what_reading_may_cost_and_which_model(
    preset: str, access: str, published: bool
) -> None:
    config = EncodeConfig(preset=preset)
    assert (config.access, config.published) == (access, published)
    assert config.to_dict()["preset"] == preset


def test_settings_may_be_given_as_python_values() -> None:
    assert EncodeConfig(features="all").features == ("all",)
    assert EncodeConfig(preset="published", key_frames=[0, 3]).key_frames == "0,3"
    with pytest.raises(InputError, match="mask="):
        EncodeConfig(features=(np.ones(3, bool),))


@pytest.mark.torch
def test_a_device_that_is_not_there_is_refused(monkeypatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no CUDA device"):
        choose_device("cuda")
    assert choose_device("cpu") == choose_device("auto") == torch.device("cpu")


def test_without_torch_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    assert not has_torch()
    with pytest.raises(MissingDependencyError, match=r"a test needs torch: .*fhash\[torch"):
        need_torch("a test")
    for name in ("auto", "cpu", "cuda"):
        with pytest.raises(MissingDependencyError, match=f"device '{name}' needs torch"):
            choose_device(name)


@pytest.mark.torch
def test_a_training_takes_the_device_where_that_pays_and_fits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from pretended_cuda import pretended_cuda

    with pretended_cuda() as pretended:
        pretended.free = 2**30
        for name, seconds, needed, found in (
            ("cpu", 1e9, 0, "on the CPU, as --device says"),
            ("auto", CUDA_PAYS - 0.1, 0, "on the CPU, as the CPU takes about 3.9 s, and CUDA pays"),
            ("auto", CUDA_PAYS, 2**30, "on CUDA, as the CPU takes about 4.0 s, and CUDA pays"),
            ("cuda", 0.1, 2**30, "on CUDA, as --device says"),
        ):
            device, why = training_device(name, seconds, needed)
            assert why.startswith(found)
            assert device == ("cuda" if "on CUDA" in found else "cpu")
        with pytest.raises(InputError, match=r"3\.0 GiB .* 1\.0 GiB are free; use --device cpu"):
            training_device("cuda", 1, 3 * 2**30)
        with pytest.warns(FhashWarning, match="takes the CPU"):
            assert training_device("auto", CUDA_PAYS, 3 * 2**30)[0] == "cpu"
    monkeypatch.setattr(devices, "may_have_cuda", lambda: False)
    assert training_device("auto", 1e9, 0)[1].startswith("on the CPU, as there is no CUDA device")


def test_more_threads_and_smaller_models_take_fewer_seconds() -> None:
    taken = []
    for width, threads in ((64, 1), (64, 2), (16, 2)):
        with computing_threads(threads):
            taken.append(cpu_seconds(Architecture.for_box((9, 9, 9), 2, width=width), 10**7))
    assert taken[0] == 2 * taken[1]
    assert 0.1 < taken[2] < taken[1] / 4


@pytest.mark.torch
def test_memory_that_runs_out_is_one_line_with_advice() -> None:
    import torch

    with (
        pytest.raises(InputError, match=r"ran out .*\(out\); use --device cpu") as told,
        enough_memory("cuda"),
    ):
        raise torch.OutOfMemoryError("out\nof 5 GiB ...")
    assert "\n" not in str(told.value)
    with pytest.raises(RuntimeError, match="CUDA error"), enough_memory("cuda"):
        raise RuntimeError("CUDA error: an illegal memory access was encountered")


@pytest.mark.torch
def test_the_record_of_a_measurement_is_json(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setenv("FHASH_THREADS", "3")
    monkeypatch.setattr(sys, "argv", ["/bin/fhash", "bench", "rate", "my data.h5"])
    record = machine()
    assert json.loads(json.dumps(record)) == record
    assert record["command"] == "fhash bench rate 'my data.h5'"
    assert (record["device"], record["cores"], record["threads"]) == ("cpu", os.cpu_count(), 3)
    assert record["processor"]
    assert record["vectors"] in (*machine_paths(), "baseline")
    assert (record["numpy"], record["torch"]) == (np.__version__, torch.__version__)
    assert date.fromisoformat(record["date"])


@pytest.mark.torch
@pytest.mark.parametrize("before", [False, True])
def test_the_same_bits_are_asked_of_torch_on_a_device_alone(before: bool) -> None:
    import torch

    usual = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(before)
    try:
        for device, wanted, asked in (
            ("cuda", True, True),
            ("cuda", False, before),
            ("cpu", True, before),
        ):
            with same_bits(device, wanted):
                assert torch.are_deterministic_algorithms_enabled() is asked
            assert torch.are_deterministic_algorithms_enabled() is before
    finally:
        torch.use_deterministic_algorithms(usual)


@pytest.mark.torch
@pytest.mark.parametrize(("vertices", "threads"), [(0, 1), (VERTICES_A_THREAD * 2, 2), (10**9, 3)])
def test_threads_are_those_that_pay_and_come_back_after_an_error(
    monkeypatch: pytest.MonkeyPatch, vertices: int, threads: int
) -> None:
    import torch

    monkeypatch.setenv("FHASH_THREADS", "3")
    usual = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with suppress(ZeroDivisionError), threads_for(vertices) as used:
            assert used == usable_threads() == torch.get_num_threads() == threads
            raise ZeroDivisionError
        assert usable_threads() == torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(usual)


@pytest.mark.torch
@needs_fork
def test_a_forked_process_does_not_wait_for_the_threads_of_its_parent() -> None:
    import torch

    def computes() -> bool:
        leave_threads_of_parent()
        return bool((torch.arange(3_000_000.0) % 7).max() == 6)

    usual = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        leave_threads_of_parent()
        assert torch.get_num_threads() == 3
        (torch.arange(3_000_000.0) % 7).sum()  # begins the threads
        assert ended_well(forked(computes))
    finally:
        torch.set_num_threads(usual)


Call = tuple[str, int, int, str]


@pytest.fixture
def calls() -> list[Call]:
    return []


@pytest.fixture
def parts(calls: list[Call]) -> Parts:
    return Parts("planning", 3, lambda *call: calls.append(call))


def test_parts_are_counted_when_the_next_one_begins(parts: Parts, calls: list[Call]) -> None:
    parts.begin("tiles")
    parts.tick()
    parts.tick()
    parts.begin("step")
    parts.end()
    assert calls == [
        ("planning", 0, 3, "tiles"),
        ("planning", 0, 3, "tiles, 1 tiles tried"),
        ("planning", 0, 3, "tiles, 2 tiles tried"),
        ("planning", 1, 3, "step"),
        ("planning", 3, 3, ""),
    ]


def test_other_threads_count_and_do_not_call(parts: Parts, calls: list[Call]) -> None:
    parts.begin("head")

    def work() -> None:
        parts.tick()
        parts.report("training", 0.9)

    with ThreadPoolExecutor(1) as workers:
        workers.submit(work).result()
    parts.report("training", 0.5)
    parts.tick()
    assert calls == [
        ("planning", 0, 3, "head"),
        ("training", 50, 100, ""),
        ("planning", 0, 3, "head, 2 tiles tried"),
    ]


class _Hands:
    """A clock that moves when it is told."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def perf_counter(self) -> float:
        return self.seconds


@pytest.fixture
def hands(monkeypatch: pytest.MonkeyPatch) -> _Hands:
    """The clock that stages read."""
    hands = _Hands()
    monkeypatch.setattr(stage_clock, "time", hands)
    return hands


def test_a_stage_inside_another_takes_its_seconds_from_that_one(hands: _Hands) -> None:
    with recording() as clock:
        hands.seconds += 1
        with stage("outer", "first"):
            hands.seconds += 2
            with stage("inner", "twice"):
                hands.seconds += 4
            with stage("inner", "again"):
                hands.seconds += 8
        hands.seconds += 16
    stages = {entry.stage: entry for entry in clock.stages()}
    assert {name: entry.seconds for name, entry in stages.items()} == {
        "outer": 2,
        "inner": 12,
        OTHER: 17,
    }
    assert (stages["inner"].times, stages["inner"].why) == (2, "twice")


def test_what_is_left_out_was_never_entered_and_says_why() -> None:
    with recording() as clock:
        skip("head", "--train none")
        skip("tiles", "at first")
        with stage("tiles", "after all"):
            skip("tiles", "once more")
    head, tiles, _ = clock.to_list()
    assert head == {"stage": "head", "seconds": 0.0, "times": 0, "why": "--train none"}
    assert (tiles["times"], tiles["why"]) == (1, "after all")


def test_seconds_between_those_of_a_stage_are_given_to_another(hands: _Hands) -> None:
    with recording() as clock, stage("measuring", "errors"):
        hands.seconds += 5
        attribute("ssim", "likeness", 3.0)
    assert [entry.seconds for entry in clock.stages()] == [2, 3, 0]


@dataclass(frozen=True, kw_only=True)
class Lens(Record):
    """A record within another one."""

    kind: str = limits("wide", "kind of lens", choices=("wide", "long"))
    length: float = limits(35.0, "millimetres", low=1, high=1000)


@dataclass(frozen=True, kw_only=True)
class Shot(Record):
    """A record of every type of field."""

    count: int = limits(MISSING, "number of shots", low=1, high=9)
    blur: bool = limits(False, "whether it is blurred")
    note: str | None = limits(None, "any text")
    place: tuple[float, float] | None = limits(None, "x and y", low=-1, high=1)
    tags: tuple[str, ...] = limits((), "words", choices=("near", "far"))
    name: str | tuple[tuple[float, str], ...] = limits("auto", "a name or points")
    lens: Lens | None = None


def test_fields_take_what_loses_nothing() -> None:
    shot = Shot.from_dict(
        {"count": 2, "place": [1, 0.5], "tags": ["far"], "lens": True, "name": [[1, "red"]]}
    )
    assert shot.place == (1.0, 0.5)
    assert isinstance(shot.place[0], float)
    assert shot.tags == ("far",)
    assert shot.lens == Lens()
    assert shot.name == ((1.0, "red"),)
    assert Shot.from_dict({"count": 2, "lens": False}).lens is None
    assert Shot.from_dict({"count": 2, "lens": {"length": 50}}).lens == Lens(length=50.0)


@pytest.mark.parametrize(
    "values",
    [
        {"count": 1},
        {"count": 9, "blur": True, "note": "", "place": [0, -1], "tags": ["near", "near"]},
        {"count": 3, "lens": {"kind": "long"}, "name": [[0.5, "a"], [2, "b"]]},
        {"count": 3, "lens": {}},
    ],
)
def test_a_record_comes_back_from_its_json(values: dict[str, Any]) -> None:
    shot = Shot.from_dict(values)
    assert Shot.from_dict(json.loads(json.dumps(shot.to_dict()))) == shot


def test_defaults_are_left_out() -> None:
    assert Shot(count=1, blur=False, tags=()).to_dict() == {"count": 1}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "count is missing; a whole number from 1 to 9 is needed: number of shots"),
        ({"count": 0}, "count is 0; allowed: 1 to 9"),
        ({"count": 1.0}, "^count is 1.0; a whole number from 1 to 9 is needed: number of shots$"),
        ({"count": True}, "count is True"),
        ({"count": 1, "blur": 1}, "blur is 1"),
        ({"count": 1, "place": [0]}, "place is"),
        ({"count": 1, "place": [0, 2]}, "place is 2; allowed: -1 to 1"),
        ({"count": 1, "place": [0, float("nan")]}, "place is"),
        ({"count": 1, "place": [0, 10**400]}, "place is"),
        ({"count": 1, "tags": "far"}, "tags is 'far'"),
        ({"count": 1, "tags": ["fra"]}, "allowed: near, far; did you mean 'far'"),
        ({"count": 1, "lens": 3}, "lens is 3"),
        ({"count": 1, "lens": {"lenght": 3}}, "of lens; did you mean 'length'"),
        (
            {"count": 1, "lens": {"length": "x"}},
            r"^lens\.length is 'x'; a number from 1 to 1000 is needed",
        ),
        ({"count": 1, "lens": {"length": 0}}, r"^lens\.length is 0; allowed: 1 to 1000"),
        ({"count": 1, "bulr": True}, "unknown setting 'bulr' of shot; did you mean 'blur'"),
        ({"count": 1, "\n": True}, r"unknown setting '\\n' of shot"),
        ([], "shot is .*; a table of settings is needed"),
    ],
)
def test_what_a_field_may_not_be_is_refused_in_one_line(values: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Shot.from_dict(values)
    assert "\n" not in str(caught.value)


def test_records_are_checked_when_they_are_made_and_do_not_change() -> None:
    with pytest.raises(InputError, match="allowed"):
        Lens(length=0.0)
    with pytest.raises(FrozenInstanceError):
        Lens().length = 3.0  # type: ignore[misc]


def test_files_are_toml_or_json(tmp_path: Path) -> None:
    toml, other = tmp_path / "a.TOML", tmp_path / "a.txt"
    toml.write_text('count = 2\n[lens]\nkind = "long"\n')
    other.write_text('{"count": 2, "lens": {"kind": "long"}}')
    assert Shot.read(toml, "a shot", "no shot") == Shot.read(other, "a shot", "no shot")
    with pytest.raises(MissingInputError, match=r"none\.toml: no shot"):
        Shot.read(tmp_path / "none.toml", "a shot", "no shot")
    other.write_text("{")
    with pytest.raises(InputError, match=r"a\.txt: not a shot"):
        Shot.read(other, "a shot", "no shot")
    other.write_text('{"count": 0}')
    with pytest.raises(InputError, match=r"a\.txt: count is 0"):
        Shot.read(other, "a shot", "no shot")


def test_bytes_are_no_record(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(InputError, match=r"a.h5: not a scene: it holds no text") as caught:
        Scene.load(tmp_path / "a.h5")
    assert "codec" not in str(caught.value)

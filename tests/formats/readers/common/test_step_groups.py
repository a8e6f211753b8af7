"""One group a step: which arrays are joined, in which order, and the times of the steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from fhash_formats.readers.common.step_groups import group_time, join, reading, times
from fhash_formats.readers.common.variables import Variable


def variables(*names: str, shape: tuple[int, ...] = (2, 3, 4)) -> list[Variable]:
    return [Variable(name=name, shape=shape, dtype=np.dtype("f4")) for name in names]


def joined(*names: str, **groups: Mapping[str, Any]) -> dict[str, list[str]]:
    found = join(variables(*names), lambda path: groups.get(path.replace("/", "__"), {}))
    return {
        variable.name: [member.name for member in variable.members]
        for variable in found
        if variable.members
    }


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("Step#{}/rho", "Step#*/rho"),
        ("{}/rho", "*/rho"),
        ("data/{}/fields/E/x", "data/*/fields/E/x"),
        ("timestep_{:04}/rho", "timestep_*/rho"),
        ("plt{:05}/level_0/rho", "plt*/level_0/rho"),
        ("run/Iteration {}/rho", "run/Iteration */rho"),
        ("t={}.5/rho", "t=*/rho"),
    ],
)
def test_steps_are_in_the_order_of_their_numbers(form: str, name: str) -> None:
    names = [form.format(number) for number in (10, 9, 100)]
    assert joined(*names) == {name: [names[1], names[0], names[2]]}


@pytest.mark.parametrize(
    "names",
    [
        ("level_0/rho", "level_1/rho"),
        ("member1/rho", "member2/rho"),
        ("run_1/rho", "run_2/rho"),
        ("rho_1", "rho_2"),
        ("step_1/rho", "step_01/rho"),
        ("0/rho",),
    ],
)
def test_other_numbers_are_no_steps(names: tuple[str, ...]) -> None:
    assert joined(*names) == {}


def test_a_single_group_is_a_step_by_its_name_or_its_time() -> None:
    assert joined("step_7/rho") == {"step_*/rho": ["step_7/rho"]}
    assert joined("data/7/rho", data__7={"time": 0.5}) == {"data/*/rho": ["data/7/rho"]}


def test_groups_of_other_shapes_stay_apart() -> None:
    found = join(
        [*variables("step_1/rho"), *variables("step_2/rho", shape=(2, 3, 5))], lambda path: {}
    )
    assert not any(variable.members or variable.auxiliary for variable in found)


def test_members_are_read_only_by_name() -> None:
    found = join(variables("step_1/rho", "step_2/rho", "mask"), lambda path: {})
    assert {variable.name: (variable.shape, variable.auxiliary) for variable in found} == {
        "step_*/rho": ((2, 2, 3, 4), False),
        "step_1/rho": ((2, 3, 4), True),
        "step_2/rho": ((2, 3, 4), True),
        "mask": ((2, 3, 4), False),
    }


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({"time": 2.0}, (2.0, "")),
        ({"Time": np.array([2.0])}, (2.0, "")),
        ({"TimeValue": 3, "time_units": "ms"}, (3.0, "ms")),
        ({"time": 2.0, "timeUnitSI": 1e-15}, (2e-15, "s")),
        ({"time": "noon"}, None),
        ({"timeUnitSI": 1.0}, None),
        ({}, None),
    ],
)
def test_times_of_groups(attributes: Mapping[str, Any], expected: tuple[float, str] | None) -> None:
    assert group_time(attributes) == expected


def test_times_come_from_groups_or_from_numbers_beside() -> None:
    members = variables("data/0/fields/E", "data/5/fields/E")
    given = {"data/0": {"time": 0.0}, "data/5": {"time": 0.25}}
    coordinate = times(members, lambda path: given.get(path, {}), lambda path: None)
    assert (coordinate.name, coordinate.values.tolist()) == ("time", [0, 0.25])
    beside = {"data/0/time": (1.0, "s"), "data/5/fields/time": (2.0, "s")}
    coordinate = times(members, lambda path: {}, beside.get)
    assert (coordinate.values.tolist(), coordinate.attributes) == ([1, 2], {"units": "s"})
    coordinate = times(members, lambda path: {}, {"data/0/time": (1.0, "s")}.get)
    assert (coordinate.name, coordinate.values.tolist()) == ("step", [0, 5])


def test_only_the_steps_that_are_asked_for_are_read() -> None:
    frames = [np.full((2, 3), step) for step in range(5)]
    calls: list[int] = []

    def reader(step: int) -> Any:
        def read(ranges: tuple[slice, ...]) -> np.ndarray:
            calls.append(step)
            return frames[step][ranges]

        return read

    read = reading([reader(step) for step in range(5)])
    got = read((slice(1, 3), slice(0, 2), slice(1, 3)))
    np.testing.assert_array_equal(got, np.stack(frames[1:3])[:, :, 1:])
    assert calls == [1, 2]

"""Cases of a parametrised test that `make every` runs, and `make test` does not."""

from __future__ import annotations

from typing import Any

import pytest


def rarely(*values: Any) -> list[Any]:
    """Values of one parameter with the mark `every`, to stand behind those that always run."""
    return [pytest.param(value, marks=pytest.mark.every) for value in values]

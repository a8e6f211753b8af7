"""Names of containers: those of data files are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_codec import InputError
from fhash_codec.container_name import check_name


@pytest.mark.parametrize("name", ["run.fhz", "run", "run.zip", "run.h5.fhz"])
def test_other_names_are_allowed(name) -> None:
    check_name(Path(name))


@pytest.mark.parametrize("name", ["run.h5", "RUN.NC", "a.b.vti", "run.zarr"])
def test_names_of_data_are_refused(name) -> None:
    with pytest.raises(InputError, match=r"give it a name that ends in \.fhz"):
        check_name(Path(name))

"""Goldens on other machines, whose vector units and BLAS kernels give other last bits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from rarely import rarely

HERE = Path(__file__).parent
UNITS = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
"""Vector units of this machine that numpy has loops for, beyond those of every machine."""


@pytest.mark.parametrize("kernel", ["Katmai", *rarely("Nehalem", "Haswell")])
def test_goldens_decode_on_other_vector_units(kernel: str) -> None:
    """Runs the quick tests of this room: numpy without vector units, BLAS of another processor."""
    if kernel == "Haswell" and not __cpu_features__.get("AVX2"):
        pytest.skip("this processor has no AVX2")
    machine = {"NPY_DISABLE_CPU_FEATURES": " ".join(UNITS), "OPENBLAS_CORETYPE": kernel}
    quick = "their_values"
    words = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-k", quick, "test_golden.py"]
    environment = {**os.environ, **machine}
    done = subprocess.run(words, cwd=HERE, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout

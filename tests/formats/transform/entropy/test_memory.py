"""Where there is no memory the native library says so: a hostile size must not end the process."""

from __future__ import annotations

import subprocess
import sys

import pytest

from fhash_formats import native

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or native.library() is None,
    reason="needs the native library and limits on memory as Linux has them",
)

SCRIPT = """
import resource, sys
import numpy as np
from fhash_formats.transform import coder, mask, predict
from fhash_formats.transform.bands import single_band
from fhash_formats.transform.predictor import Predictor, passes_of

shape = (1, 1, 1 << 12, 1 << 12)  # 16 Mi vertices
taps = sum(len(part.taps) for part in passes_of((0, 0, 1, 1), (0, 1, 2, 3), 0))
predictor = Predictor(step=1.0, origin=0.0, levels=(0, 0, 1, 1), order=(0, 1, 2, 3), reach=0, weights=(0,) * taps)
nothing = (np.zeros(shape, np.uint8),) * 2
wholes = np.arange(1 << 24, dtype=np.int32).reshape(shape)
bits = nothing[0].view(bool)
WORK = {
    "decode_integers": lambda: coder.decode_integers(b"", shape, single_band(shape)),
    "encode_integers": lambda: coder.encode_integers(wholes, single_band(shape)),
    "decode_mask": lambda: mask.decode_mask(bytes([255]) * 99, nothing),
    "encode_mask": lambda: mask.encode_mask(bits, nothing),
    "decode_predicted": lambda: predict.decode_predicted(b"", shape, predictor),
    "encode_predicted": lambda: predict.encode_predicted(wholes, None, predictor),
}
for state in (coder.prior_state, mask.mask_prior_state, predict._blank):
    state()
with open("/proc/self/status") as status:
    used = next(int(line.split()[1]) for line in status if line.startswith("VmData")) << 10
# Enough for the result, an int32 or a byte for each vertex, and what a coder learns, but not for what it keeps of each vertex.
result = {"decode_integers": 64, "decode_mask": 16, "decode_predicted": 64, "encode_integers": 8, "encode_mask": 16, "encode_predicted": 80}
limit = used + (result[sys.argv[1]] + 10 << 20)
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
try:
    WORK[sys.argv[1]]()
except MemoryError as error:
    print(error)
"""


@pytest.mark.parametrize(
    "name",
    [
        "decode_integers",
        "encode_integers",
        "decode_mask",
        "encode_mask",
        "decode_predicted",
        "encode_predicted",
    ],
)
def test_coders_say_where_memory_runs_out(name):
    done = subprocess.run([sys.executable, "-c", SCRIPT, name], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "no memory" in done.stdout

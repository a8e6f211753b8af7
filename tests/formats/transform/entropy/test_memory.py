"""The native coders raise MemoryError where memory runs out: no hostile size ends the process."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the memory limits of Linux")

SCRIPT = """
import resource, sys
import numpy as np
from fhash_formats.transform import coder, predict
from fhash_formats.transform.predict import Predictor, passes_of
from fhash_formats.transform.coder import single_band

shape = (1, 1, 1 << 12, 1 << 12)  # 16 Mi vertices
levels, order = (0, 0, 1, 1), (0, 1, 2, 3)
taps = sum(len(a_pass.taps) for a_pass in passes_of(levels, order, 0))
predictor = Predictor(
    step=1.0, origin=0.0, levels=levels, order=order, reach=0, weights=(0,) * taps
)
nothing = (np.zeros(shape, np.uint8),) * 2
integers = np.arange(1 << 24, dtype=np.int32).reshape(shape)
bits = nothing[0].view(bool)
# Each call, and the MiB of its result (an int32 or a byte for each vertex) and its copies.
WORK = {
    "decode_integers": (64, lambda: coder.decode_integers(b"", shape, single_band(shape))),
    "encode_integers": (8, lambda: coder.encode_integers(integers, single_band(shape))),
    "decode_mask": (16, lambda: coder.decode_mask(bytes([255]) * 99, nothing)),
    "encode_mask": (16, lambda: coder.encode_mask(bits, nothing)),
    "decode_predicted": (64, lambda: predict.decode_predicted(b"", shape, predictor)),
    "encode_predicted": (80, lambda: predict.encode_predicted(integers, None, predictor)),
}
coder.prior_state(False), coder.mask_prior_state(), predict.blank_state()
with open("/proc/self/status") as status:
    used = next(int(line.split()[1]) for line in status if line.startswith("VmData")) << 10
# The limit leaves room for the result and the coder's state, but not for its notes on each vertex.
result, call = WORK[sys.argv[1]]
limit = used + (result + 10 << 20)
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
try:
    call()
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
def test_coders_say_where_memory_runs_out(name: str) -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT, name], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "no memory" in done.stdout

"""What all tests share."""

import os

# The tests' models are tiny: a second thread costs more than it brings, above all where several test runs share a machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

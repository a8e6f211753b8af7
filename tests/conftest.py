"""What all tests share."""

import os
import signal

# The tests' models are tiny: a second thread costs more than it brings, above all where several test runs share a machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A shell starts a job in the background with Ctrl-C ignored, and some tests press it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

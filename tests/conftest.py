"""Settings of the process that all tests share."""

import os
import signal

# The tests' models are tiny: a second thread costs more than it brings, above all where several
# test runs share a machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A shell starts a background job with Ctrl-C ignored, and nohup starts one with SIGHUP ignored;
# some tests send both signals.
for _name, _usual in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    _number = getattr(signal, _name, None)
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)

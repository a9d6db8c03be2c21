"""What all tests share: one thread a process. Fixtures that need torch are in ``networks.py``."""

import os
import signal

# A shell's background jobs ignore Ctrl-C, and so does what they start: tests that interrupt programs would wait for it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Unless the caller says otherwise, and in the processes that tests start as well: a second thread gains nothing on
# inputs this small, and costs many times as long where other work has the cores (OpenMP's threads spin). NumPy and
# torch read this when they are first imported.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

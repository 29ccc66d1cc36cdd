# SPDX-License-Identifier: MIT
"""Measurements of accuracy, coverage and speed; each module says what it shows and how it is called."""

import os

# As the program does, before anything imports numpy: threads that spin for each other beside other processes took 87 %
# of a commissioning's processor time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

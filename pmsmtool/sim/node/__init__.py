# SPDX-License-Identifier: MIT
"""The simulated drive's communication half: object dictionary, SDO server, state machines, memory."""

# SPDX-License-Identifier: MIT
"""Proof on the machine: the response a design promises is predicted and committed, then measured and compared."""

# SPDX-License-Identifier: MIT
"""Simulated drives of other makers, from their EDS or DCF; their unit decoding is their own."""

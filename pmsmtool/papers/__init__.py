# SPDX-License-Identifier: MIT
"""The figures and tables of the papers, recomputed: numbers beside the plot, each printed number checked."""

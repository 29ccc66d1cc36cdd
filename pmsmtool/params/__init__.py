# SPDX-License-Identifier: MIT
"""Parameters of the drive: the catalogue, sets of values, differences between sets."""

# SPDX-License-Identifier: MIT
"""Speed and position loops of an axis with its load, and the reference they follow."""

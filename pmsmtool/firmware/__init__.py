# SPDX-License-Identifier: MIT
"""What goes into the drive: the control core in C, the packed image, drive maps and exported files."""

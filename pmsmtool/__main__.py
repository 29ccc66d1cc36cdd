# SPDX-License-Identifier: MIT
"""``python -m pmsmtool``."""

from pmsmtool.cli.main import main

main()

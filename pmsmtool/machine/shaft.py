# SPDX-License-Identifier: MIT
"""What hangs on a shaft and what may happen to it, in the words of a request."""

from __future__ import annotations

from typing import Literal

Shaft = Literal["free", "locked", "coupled"]
Load = Literal["none", "gravity"]
Brake = Literal["open", "drive", "none"]

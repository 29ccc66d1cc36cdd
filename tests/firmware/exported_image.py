# SPDX-License-Identifier: MIT
"""The parameter image that an exported ``_cfg.json`` describes."""

from __future__ import annotations

import json

from pmsmtool.firmware.image import pack_image


def image_of_json(text: str) -> bytes:
    content = json.loads(text)
    return pack_image(content["values"], bytes.fromhex(content["lut_words"]))

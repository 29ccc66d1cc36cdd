# SPDX-License-Identifier: MIT
"""Objects of the data recorder in maxon EPOS2 drives: up to four variables, a ring of words for each.

RIVeR-Lab/EposLib@8be4584 (maxon's command library: GatewayDrive2ToEpos2.cpp, DcsCanOpenCommunicationDef.h) says what is
written to start, trigger and stop it and which bits switch its own triggers on; maxon's application notes rel3956,
12-183 to 12-185, say how the buffer is divided: the rings stand one behind the other, each as long as the largest
number of samples, 512 words in all. No CRC. In no source read: what one count of the period is worth (the map must say
it), and in which order two words make a number (only variables of one word are taken).
"""

from __future__ import annotations

from pmsmtool.drive_maps.recorder_map import Address

VARIABLES = 4
BUFFER_WORDS = 512
WORD_BYTES = 2
CONTROL: Address = (0x2010, 0, "H")
CONFIGURATION: Address = (0x2011, 0, "H")
"""Triggers of its own: bits 0 to 3, start and end of a movement, an error, a digital input."""
PERIOD: Address = (0x2012, 0, "H")
PRECEDING: Address = (0x2013, 0, "H")
"""Samples kept from before the trigger."""
USED: Address = (0x2014, 0, "H")
"""Number of variables."""
FIRST_INDEX: Address = (0x2015, 1, "H")
FIRST_SUB: Address = (0x2016, 1, "H")
STATUS: Address = (0x2017, 0, "H")
LARGEST: Address = (0x2018, 0, "H")
"""Samples of a ring with the variables chosen."""
RECORDED: Address = (0x2019, 0, "H")
FIRST: Address = (0x201A, 0, "H")
"""Place of the oldest sample in a ring."""
BUFFER = 0x201B

START, FORCE_TRIGGER, STOP = 0x0001, 0x0002, 0xFFFE
"""Values of CONTROL."""
RUNNING_BIT, TRIGGERED_BIT = 1 << 0, 1 << 1

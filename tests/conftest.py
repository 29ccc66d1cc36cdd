"""What holds for every test."""

from __future__ import annotations

import signal

# A background job of a shell without job control ignores SIGINT and hands that on to its children; tests of Ctrl-C
# would wait for ever. A handler of ours is back to the default in children.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# SPDX-License-Identifier: MIT
"""The SDO channel: one client for one node that cannot report a refused write as success.

What the stock clients get wrong and this one does not (numbers of ``docs/canopen.md``, 2): every answer is matched by
index and sub-index (B1); lost answers are retried by a policy per transfer kind (B2, B3); aborts carry the
multiplexor of the transfer (B4); block transfers survive gaps and losses at their ends (B5 to B8, ``sdo_block``); a
block upload may be answered by a normal one (B9); announced and expected sizes are compared (B10); one lock per
channel (B11); calls from a bus callback are refused instead of waiting for themselves (B12).

Protocol: CiA 301, section 7.2.4.3.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pmsmtool.bus import sdo_block, sdo_segmented
from pmsmtool.bus.abort_codes import TRANSPORT_CODES, AbortCode, abort_advice, abort_text
from pmsmtool.bus.connection import Connection
from pmsmtool.bus.sdo_transfer import (
    LARGEST_UNKNOWN,
    MULTIPLEXOR,
    OBJECT_LIMIT_S,
    SLOWEST_S_PER_BYTE,
    Attempt,
    BlockRefused,
    GivenAnswers,
    Mode,
    Retry,
    Transfer,
    TransferLost,
    named,
)
from pmsmtool.errors import BusError, DriveTimeout, PmsmtoolError, SdoAbort

__all__ = ["Mode", "Retry", "SdoChannel", "Transfer"]

RESPONSE_TIMEOUT_S = 0.3
"""Time an answer may take unless the object says otherwise; drives answer within a few ms."""
QUIET_S = 0.05
"""Silence on the answer's COB-ID after which nothing late is expected soon."""
DRAIN_LIMIT_S = 1.0
"""A node that never falls silent does not keep the channel longer than this."""
TRIES = 3
"""Attempts per object, the first included (docs/canopen.md, 6)."""
CHECK_INTERVAL_S = 0.1
"""While an answer is awaited, the node's supervision is asked this often."""
BLOCK_THRESHOLD = 28
"""Bytes from which a block transfer has fewer frames than a segmented one."""
LATE_S = 0.5
"""Segments name no object: after a lost segmented upload this long is waited for late ones, before the barrier."""
BARRIER = ((0x1000, 0), (0x1018, 1), (0x1018, 2), (0x1018, 0))
"""Objects every node answers for, read in turn: what arrives before the answer belongs to the past."""
SLOWEST_ANSWER_S = 1.0
"""The time-out grows to this with a node that answers late."""
WRONG_ANSWERS = "the drive's SDO server answers wrongly, or two nodes share this node id"
GIVEN_UP = "the node is busy, or frames get lost on the bus"
"""Causes of a transfer that timed out although the node sends."""


class OutOfTime(DriveTimeout):
    """The time that a command has for its transfers is over."""


class SdoChannel:
    """Client side of one SDO channel.

    Parameters
    ----------
    connection : Connection
        The bus.
    node : int
        Node id; the default channel 0x600 + id, 0x580 + id is used.
    check : callable, optional
        Raises when waiting on has become pointless (node reset, heartbeat lost, second master).

    Attributes
    ----------
    slow_objects : dict of (int, int) to float
        Time-outs (s) of objects that need longer than ``timeout_s``.
    usual_lengths : dict of (int, int) to int
        Bytes of objects in whose answers the node may leave the length out (CiA 301, 7.2.4.3.6, bit s = 0).
    block_supported : bool or None
        None until a block transfer was tried.
    retries, discarded : int
        Sums over the life of the channel.
    active_s : float
        When (s, bus clock) the caller's thread last was at work in a transfer.
    """

    def __init__(
        self,
        connection: Connection,
        node: int,
        *,
        timeout_s: float = RESPONSE_TIMEOUT_S,
        check: Callable[[], None] | None = None,
    ) -> None:
        self.connection = connection
        self.node = node
        self.timeout_s = timeout_s
        self.slow_objects: dict[tuple[int, int], float] = {}
        self.usual_lengths: dict[tuple[int, int], int] = {}
        self.block_supported: bool | None = None
        self.retries = 0
        self.discarded = 0
        self._answers = GivenAnswers()
        self._check = check
        self.active_s = -math.inf
        self._over_s = math.inf
        self._silence_s = math.inf
        self._unanswered_s: float | None = None
        self._unsettled = False
        self._barriers = 0
        self._cancelled: BaseException | None = None
        self._request_id = 0x600 + node
        self._sends = connection.sends[self._request_id]
        self._mailbox = connection.mailbox(0x580 + node)
        # Of the thread: one that is interrupted while a transfer begins must still be able to restore the drive.
        self._lock = threading.RLock()

    # ---- for callers ---------------------------------------------------------------------------

    def read(self, index: int, sub: int, *, size: int | None = None) -> bytes:
        """Return the bytes of an object; see :meth:`upload`."""
        return self.upload(index, sub, size=size).data

    def upload(
        self,
        index: int,
        sub: int,
        *,
        size: int | None = None,
        longest: int = LARGEST_UNKNOWN,
        mode: Mode = Mode.AUTO,
        tries: int = TRIES,
    ) -> Transfer:
        """Read an object.

        Parameters
        ----------
        size : int, optional
            Expected length; anything else is an error, also when the node announces it so.
        longest : int
            Bytes taken at most where no length is expected.
        mode : Mode
            ``AUTO`` reads by block when ``size`` says that pays, falling back to segments.

        Raises
        ------
        SdoAbort
            The node refused, or what it sent is not what it announced.
        DriveTimeout
            No answer in ``tries`` attempts.
        BusError
            The bus or the node went away.
        """
        if mode is Mode.AUTO:
            mode = Mode.BLOCK if (size or 0) > BLOCK_THRESHOLD else Mode.SEGMENTED
        with self._transfer(index, sub, mode, size) as attempt:
            attempt.longest = longest
            data, count = self._persist(attempt, tries, lambda: self._upload_once(attempt))
            return self._result(attempt, data, count)

    def download(
        self,
        index: int,
        sub: int,
        data: bytes,
        *,
        mode: Mode = Mode.AUTO,
        retry: Retry = Retry.READ_BACK,
        tries: int = TRIES,
    ) -> Transfer:
        """Write an object; returns when the node confirmed it.

        Raises
        ------
        SdoAbort
            The node refused; nothing is retried then.
        DriveTimeout
            No answer. With ``Retry.NEVER`` the node may have taken the value.
        BusError
            The bus or the node went away.
        """
        if 0 < len(data) <= 4 and mode is not Mode.BLOCK:
            mode = Mode.SEGMENTED if mode is Mode.SEGMENTED else Mode.EXPEDITED
        elif mode is Mode.AUTO:
            mode = Mode.BLOCK if len(data) > BLOCK_THRESHOLD else Mode.SEGMENTED
        with self._transfer(index, sub, mode, len(data)) as attempt:
            recover = (lambda: self._already_holds(attempt, data)) if retry is Retry.READ_BACK else None
            limit = 1 if retry is Retry.NEVER else tries
            attempt.urgent = mode is Mode.EXPEDITED and retry is not Retry.READ_BACK
            _, used = self._persist(attempt, limit, lambda: self._download_once(attempt, data), recover)
            return self._result(attempt, data, used)

    def post(self, index: int, sub: int, data: bytes) -> None:
        """Send an expedited write without waiting for the answer or for the lock: emergencies only."""
        self.connection.send(self._request_id, _expedited(index, sub, data))

    def cancel(self, reason: BaseException | None) -> None:
        """Make the transfer under way, and all later ones, raise ``reason``; None lifts that."""
        self._cancelled = reason

    def finish_within(self, seconds: float) -> None:
        """Give all transfers from now on this long together (s on the bus clock); then they raise ``OutOfTime``."""
        self._over_s = self.connection.clock.now() + seconds

    @contextmanager
    def limited(self, *, silence_s: float, own_s: float, total_s: float) -> Iterator[None]:
        """Inside, raise ``OutOfTime`` when no transfer was answered whole for ``silence_s``, or after ``total_s``.

        ``own_s``: what the transfers inside have at least, where the node was silent before (s).
        """
        before = self._over_s, self._silence_s
        now = self.connection.clock.now()
        self._over_s, self._silence_s = now + total_s, silence_s
        if self._unanswered_s is not None:
            self._unanswered_s = max(self._unanswered_s, now + own_s - silence_s)
        try:
            yield
        finally:
            self._over_s, self._silence_s = before

    def close(self) -> None:
        """Stop listening."""
        self._mailbox.close()

    # ---- for the transfer modules ---------------------------------------------------------------

    @property
    def contradiction(self) -> str:
        """The last answer that came a second time and said something else: two nodes answer. Empty where none did."""
        return self._answers.contradiction

    def send(self, frame: bytes) -> None:
        """Send one request of eight bytes."""
        self.connection.send(self._request_id, frame)
        self._sends = self.connection.sends[self._request_id]

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next frame of the node, or None after ``timeout_s`` on the bus clock."""
        while True:
            self.active_s = self.connection.clock.now()
            frame = self._mailbox.get(min(timeout_s, CHECK_INTERVAL_S))
            if frame is not None:
                return frame if len(frame) == 8 else frame.ljust(8, b"\0")
            self.raise_if_pointless()
            timeout_s -= CHECK_INTERVAL_S
            if timeout_s <= 0.0:
                return None

    def await_answer(self, attempt: Attempt, accept: Callable[[bytes], bool], what: str) -> bytes:
        """Return the first frame that ``accept`` takes; discard others, raise on an abort or silence."""
        now = self.connection.clock.now()
        deadline = now + attempt.timeout_s
        if self._unanswered_s is None:
            self._unanswered_s = now
        instead = ""
        while True:
            frame = self.receive(max(0.0, deadline - now))
            if frame is not None and frame[0] == 0x80:
                self.raise_if_abort_of(attempt, frame)
            elif frame is not None and accept(frame):
                self._answers.keep(frame, self.connection.clock.now())
                return frame
            now = self.connection.clock.now()
            if frame is None or now > deadline:  # whoever floods the channel does not prolong the wait
                silence = f"no answer to {what} within {attempt.timeout_s:.2g} s"
                raise TransferLost(f"{silence}{instead}", likely=WRONG_ANSWERS if instead else "")
            attempt.discarded += 1
            self._answers.compare(frame)
            instead = f", but {named(frame)}"

    def raise_if_abort_of(self, attempt: Attempt, frame: bytes) -> None:
        """Raise when an abort frame belongs to this transfer; a node that names no object means us."""
        if not attempt.owns(frame) and MULTIPLEXOR.unpack_from(frame)[1:] != (0, 0):
            return
        self._unanswered_s = None
        self._answers.keep(frame, self.connection.clock.now())
        code = int.from_bytes(frame[4:8], "little")
        if code in TRANSPORT_CODES:
            raise TransferLost(
                f"node aborted: {abort_text(code)} ({code:#010x})", code, abort_owed=False, likely=GIVEN_UP
            )
        likely, hint = abort_advice(code)
        raise SdoAbort(
            code, attempt.index, attempt.sub, f"node refused: {abort_text(code)} ({code:#010x})",
            where=self._where(attempt), likely=likely, hint=hint,
        )  # fmt: skip

    def check_announced(self, attempt: Attempt, announced: int | None) -> None:
        """Compare the announced with the expected length before anything is transferred."""
        if announced is None:
            return
        if attempt.size is not None and announced != attempt.size:
            raise TransferLost(f"node announces {announced} bytes, expected {attempt.size}", AbortCode.LENGTH)
        self._check_longest(attempt, announced)

    def raise_if_over(self, attempt: Attempt, received: int) -> None:
        """Raise when the object has taken its time, however lively the node is, or is longer than it may be."""
        self._check_longest(attempt, received)
        if self.connection.clock.now() > attempt.until_s:
            raise TransferLost(f"not complete in time: {received} bytes moved")

    def _check_longest(self, attempt: Attempt, length: int) -> None:
        if attempt.size is None and length > attempt.longest:
            self._abort(attempt, AbortCode.TOO_LONG)
            raise self._failure(
                attempt, TransferLost(f"longer than the {attempt.longest} bytes taken", AbortCode.TOO_LONG), 1
            )

    def check_size(self, attempt: Attempt, data: bytes, announced: int | None) -> bytes:
        """Compare what came with what was announced and what was expected."""
        for length, source in ((announced, "announced"), (attempt.size, "expected")):
            if length is not None and len(data) != length:
                # After a normal upload the node is done, inside a block transfer it awaits our verdict.
                owed = attempt.mode is Mode.BLOCK
                raise TransferLost(
                    f"node sent {len(data)} of {length} bytes {source}", AbortCode.LENGTH, abort_owed=owed
                )
        return data

    # ---- attempts -------------------------------------------------------------------------------

    def _persist(
        self, attempt: Attempt, tries: int, once: Callable[[], bytes], recover: Callable[[], bool] | None = None
    ) -> tuple[bytes, int]:
        """Try until it works; segments get one more try where the node may be unable to do blocks."""
        count = 0
        while True:
            count += 1
            try:
                self._settle(attempt)
                return once(), count
            except TransferLost as error:
                lost = error  # outside: what comes now is told by itself, not as an error during an error
            self._unsettled = True
            self._answers.forget(self.connection.clock.now())
            attempt.notes.append(f"try {count}: {lost.what}")
            self._leave(attempt, lost)
            if recover is not None and attempt.mode is Mode.EXPEDITED and recover():
                return b"", count
            over = self.connection.clock.now() > attempt.until_s
            if count < tries and not over:
                continue
            if over or attempt.mode is not Mode.BLOCK or (self.block_supported and lost.code == AbortCode.TIMED_OUT):
                raise self._failure(attempt, lost, count)
            attempt.mode = Mode.SEGMENTED
            attempt.notes.append("by segments now")

    def _upload_once(self, attempt: Attempt) -> bytes:
        if attempt.mode is Mode.BLOCK and self.block_supported is not False:
            try:
                # The node may answer a block initiate with a normal upload (CiA 301: pst, B9).
                data, normal = sdo_block.upload(self, attempt)
            except BlockRefused:
                self._fall_back(attempt)
            else:
                self.block_supported = self.block_supported or normal is None or None
                return data if normal is None else sdo_segmented.upload(self, attempt, normal)
        self.send(attempt.head(0x40) + b"\0\0\0\0")
        first = self.await_answer(attempt, lambda f: f[0] & 0xE0 == 0x40 and attempt.owns(f), "the upload request")
        return sdo_segmented.upload(self, attempt, first)

    def _download_once(self, attempt: Attempt, data: bytes) -> bytes:
        if attempt.mode is Mode.EXPEDITED:
            self.send(_expedited(attempt.index, attempt.sub, data))
            self.await_answer(attempt, lambda f: f[0] == 0x60 and attempt.owns(f), "the write")
            return data
        if attempt.mode is Mode.BLOCK and self.block_supported is not False:
            try:
                sdo_block.download(self, attempt, data)
            except BlockRefused:
                self._fall_back(attempt)
            else:
                self.block_supported = True
                return data
        attempt.mode = Mode.SEGMENTED
        sdo_segmented.download(self, attempt, data)
        return data

    def _already_holds(self, attempt: Attempt, data: bytes) -> bool:
        """After a lost answer: read the object before it is written again."""
        probe = Attempt(attempt.index, attempt.sub, attempt.timeout_s, Mode.SEGMENTED)
        try:
            self._settle(probe)
            held = self._upload_once(probe) == data
        except (TransferLost, SdoAbort) as error:
            attempt.notes.append(f"read-back after a lost answer failed: {error}")
            if isinstance(error, TransferLost):
                self._leave(attempt, error)
            return False
        finally:
            attempt.discarded += probe.discarded
        attempt.notes.append(
            "read back: " + ("the node had taken the value" if held else "the node holds another value")
        )
        return held

    # ---- ends -----------------------------------------------------------------------------------

    def _abort(self, attempt: Attempt, code: int) -> None:
        """Tell the node that this transfer is over (with its multiplexor, B4)."""
        self.send(attempt.head(0x80) + code.to_bytes(4, "little"))

    def _leave(self, attempt: Attempt, lost: TransferLost) -> None:
        """Abort what is left of a transfer and wait until nothing late arrives any more."""
        if lost.abort_owed:
            self._abort(attempt, lost.code)
        clock = self.connection.clock
        late_s = clock.now() + (LATE_S if attempt.segments and lost.code == AbortCode.TIMED_OUT else 0.0)
        deadline = clock.now() + DRAIN_LIMIT_S
        while clock.now() < deadline:
            if self.receive(QUIET_S) is not None:
                attempt.discarded += 1
            elif clock.now() >= late_s:
                return

    def _settle(self, attempt: Attempt) -> None:
        """After a lost transfer: read an object whose answer tells that nothing older is still to come."""
        if not self._unsettled or attempt.urgent:
            return
        index, sub = BARRIER[self._barriers % len(BARRIER)]
        self._barriers += 1
        barrier = Attempt(index, sub, attempt.timeout_s, Mode.SEGMENTED)
        began = self.connection.clock.now()
        for left in reversed(range(TRIES)):
            self.send(barrier.head(0x40) + b"\0\0\0\0")
            try:
                self.await_answer(barrier, lambda f: f[0] & 0xE0 == 0x40 and barrier.owns(f), "the next read")
                break
            except SdoAbort:
                break  # also an answer, to this very request
            except TransferLost:
                if not left:
                    raise
        self._unsettled = False
        took_s = self.connection.clock.now() - began
        if took_s > 0.5 * self.timeout_s:
            self.timeout_s = max(self.timeout_s, min(2.0 * took_s, SLOWEST_ANSWER_S))
            attempt.timeout_s = max(attempt.timeout_s, self.timeout_s)

    def _fall_back(self, attempt: Attempt) -> None:
        if not attempt.notes:
            self.block_supported = False  # refused on a quiet channel, not amid the debris of a lost transfer
        attempt.mode = Mode.SEGMENTED
        attempt.notes.append("node has no block transfer: by segments")

    @contextmanager
    def _transfer(self, index: int, sub: int, mode: Mode, size: int | None) -> Iterator[Attempt]:
        attempt = Attempt(index, sub, self.slow_objects.get((index, sub), self.timeout_s), mode, size)
        attempt.until_s = self.connection.clock.now() + OBJECT_LIMIT_S + SLOWEST_S_PER_BYTE * (size or 0)
        if size:
            self.usual_lengths.setdefault((index, sub), size)
        if self.connection.in_callback():
            raise PmsmtoolError(
                "SDO transfer asked for from a bus callback, where it would wait for itself",
                where=self._where(attempt),
                hint="let the callback only take notes; this is a bug worth reporting",
            )
        with self._lock:
            if self.connection.sends[self._request_id] != self._sends:  # another channel to this node has asked, too
                self._answers.clear()
            for frame in self._mailbox.clear():
                attempt.discarded += 1
                self._answers.compare(frame.ljust(8, b"\0"))
            self.raise_if_pointless()
            try:
                yield attempt
            except OutOfTime:
                self._unsettled = True
                self._answers.forget(self.connection.clock.now())
                self._abort_quietly(attempt)
                raise
            except (SdoAbort, DriveTimeout):
                raise
            except BaseException:
                self._unsettled = True
                self._answers.forget(self.connection.clock.now())
                # Interrupted, cancelled or supervised away: the node must not stay inside a transfer.
                self._abort_quietly(attempt)
                raise
            finally:
                self.discarded += attempt.discarded

    def _abort_quietly(self, attempt: Attempt) -> None:
        try:
            self._abort(attempt, AbortCode.GENERAL)
        except BusError:
            pass  # the error under way says more than this one

    def raise_if_pointless(self) -> None:
        """Raise what makes further transfers pointless: cancelled, out of time, or what the supervision found."""
        if self._cancelled is not None:
            raise self._cancelled
        now = self.connection.clock.now()
        silent_s = 0.0 if self._unanswered_s is None else now - self._unanswered_s
        if silent_s > self._silence_s or now > self._over_s:
            likely, hint = self.connection.explain_silence(self.node)
            raise OutOfTime(
                f"no valid answer for {silent_s:.1f} s" if silent_s > self._silence_s else "the command takes too long",
                where=f"node {self.node}", likely=likely, hint=hint,
            )  # fmt: skip
        if self._check is not None:
            self._check()

    def _result(self, attempt: Attempt, data: bytes, tries: int) -> Transfer:
        self._unanswered_s = None  # not before: a server may begin every upload and end none
        self.retries += tries - 1
        if tries > 1:  # the answer to an earlier try may still come
            self._answers.forget(self.connection.clock.now())
        return Transfer(data, attempt.mode, tries, attempt.retransmitted, attempt.discarded, tuple(attempt.notes))

    def _where(self, attempt: Attempt) -> str:
        return f"node {self.node}, 0x{attempt.index:04X}:{attempt.sub:02X}"

    def _failure(self, attempt: Attempt, lost: TransferLost, tries: int) -> PmsmtoolError:
        self.retries += tries - 1
        where = self._where(attempt)
        alike = all(note == f"try {k}: {lost.what}" for k, note in enumerate(attempt.notes, 1))
        silent = all(": no answer to " in note for note in attempt.notes)  # each may have waited for another frame
        told = f"{tries} tries" if alike or silent else f"{tries} tries: {'; '.join(attempt.notes)}"
        first = attempt.notes[0].partition(": ")[2] if silent and attempt.notes else lost.what
        what = first if tries == 1 else f"{first} ({told})"
        if lost.code == AbortCode.TIMED_OUT:
            likely, hint = self.connection.explain_silence(self.node)
            if lost.likely:
                likely, hint = lost.likely, f"`pmsmtool doctor`, then `pmsmtool info -n {self.node}`"
            return DriveTimeout(what, where=where, likely=likely, hint=hint)
        likely, hint = abort_advice(lost.code)
        return SdoAbort(lost.code, attempt.index, attempt.sub, what, where=where, likely=likely, hint=hint)


def _expedited(index: int, sub: int, data: bytes) -> bytes:
    return MULTIPLEXOR.pack(0x23 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")

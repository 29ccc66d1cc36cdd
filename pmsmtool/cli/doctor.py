# SPDX-License-Identifier: MIT
"""``pmsmtool doctor``: adapters, wiring, bit rate, round trip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import TIME, BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import BusError

if TYPE_CHECKING:
    from pmsmtool.bus.examination import Adapter, Examination


WITHIN_S = 60.0
"""Loading all interfaces takes 1 s, opening at most 10 s a bus, asking every node and timing three 20 s."""


@click.command(
    "doctor",
    epilog=examples(
        "pmsmtool doctor                                  # adapters and configuration only",
        "pmsmtool -i pmsmsim doctor",
        "pmsmtool -i socketcan -c can0 doctor --find-bitrate",
    ),
)
@click.option("--find-bitrate", is_flag=True, help="Open at every usual bit rate and only listen.")
@click.option("--listen", "listen_s", type=TIME, default="1s", help="How long to listen before anything is sent.")
@bus_options
@output_options
def doctor_command(bus: BusOptions, out: Output, find_bitrate: bool, listen_s: float) -> None:
    """Examine adapters, then the bus: listen first, ask then; nothing is written to any node.

    Lists what each usual adapter needs on this system, and the options for it. Exit code 3 when a bus is configured and
    no node answers on it. Ends within 60 s and the time of listening.
    """
    from pmsmtool.bus.connect import in_time

    rounds = 9.0 if find_bitrate else 1.0
    limit_s = WITHIN_S + rounds * listen_s
    if bus.simulated():
        result = _examined(bus, find_bitrate, listen_s)  # its clock belongs to this thread
    else:
        try:
            result = in_time(lambda: _examined(bus, find_bitrate, listen_s), limit_s)
        except TimeoutError as error:
            raise BusError(
                f"the examination does not end within {limit_s:g} s",
                where=" ".join(str(v) for v in (bus.interface, bus.channel) if v),
                likely="the adapter's driver hangs",
                hint="unplug the adapter, plug it in again, and try again",
            ) from error
    data, lines, failed = result
    out.result("doctor", data, lines)
    if failed:
        rate = "`pmsmtool doctor --find-bitrate` listens at every usual bit rate"
        raise BusError(
            failed, where=" ".join(str(v) for v in (bus.interface, bus.channel) if v),
            hint=rate if "bit rate" in failed and not find_bitrate else "see the lines above",
        )  # fmt: skip


def _examined(bus: BusOptions, find_bitrate: bool, listen_s: float) -> tuple[dict[str, Any], list[str], str]:
    """Return the facts, the lines, and what failed."""
    from pmsmtool.bus import examination

    found = examination.adapters()
    configured = _configuration(bus)
    data: dict[str, Any] = {"adapters": found, "configuration": configured}
    lines = _adapter_lines(found, configured)
    failed = ""
    if find_bitrate:
        rates = examination.find_bitrate(bus.interface, bus.channel, listen_s=listen_s)
        data["bitrates"] = {str(rate): {"frames": n, "error_frames": e} for rate, (n, e) in rates.items()}
        lines += [f"{rate:>8} bit/s  {n} frames, {e} error frames" for rate, (n, e) in rates.items()]
        heard = [rate for rate, (n, e) in rates.items() if n and not e]
        lines += [f"PASS  the bus runs at {rate} bit/s: give -b {rate}" for rate in heard]
        if not heard:
            failed = examination.no_rate(rates)
            lines.append(f"FAIL  {failed}")
    elif configured.get("interface") is not None:
        with bus.connect() as connection:
            bitrate = bus.bitrate or _number(configured.get("bitrate"))
            result = examination.examine(connection, bitrate, listen_s=listen_s)
        data["examination"] = result
        lines += _finding_lines(result)
        failed = "; ".join(text.partition(";")[0] for verdict, text in result.findings if verdict == "FAIL")
    else:
        lines.append("no bus is configured: give -i and -c, or configure python-can (~/can.conf, CAN_INTERFACE)")
    return data, lines, failed


def _configuration(bus: BusOptions) -> dict[str, Any]:
    """Return what python-can will use, from options, files and environment."""
    from pmsmtool.bus.connect import configuration

    typed = {key: value for key, value in bus.recorded.items() if value is not None}
    try:
        loaded = configuration(typed)
    except ValueError:
        return typed
    return {key: loaded.get(key) for key in bus.recorded if loaded.get(key) is not None}


def _adapter_lines(found: list[Adapter], configured: dict[str, Any]) -> list[str]:
    ready = [adapter.name for adapter in found if adapter.ready]
    lines = [f"python-can loads: {', '.join(ready)}"]
    chosen = next((a for a in found if a.name == configured.get("interface")), None)
    if chosen is not None and not chosen.ready:
        lines.append(f"FAIL  {chosen.name}: {chosen.reason}")
    if chosen is None or not chosen.ready:
        lines += _set_up_lines(configured.get("interface"))
    used = "  ".join(f"{key} {value}" for key, value in configured.items())
    return [*lines, f"configured: {used or 'nothing'}"]


def _set_up_lines(interface: str | None) -> list[str]:
    """Return what the adapter of an interface needs on this system; of all usual ones where none is named."""
    from pmsmtool.bus.connect import ADAPTERS, how_to_set_up

    named = [interface] if interface in ADAPTERS else list(ADAPTERS)
    return ["to set up an adapter on this system:", *(f"  {how_to_set_up(str(each))}" for each in named)]


def _finding_lines(result: Examination) -> list[str]:
    lines = [f"{verdict:<4}  {text}" for verdict, text in result.findings]
    return [*lines, f"controller state {result.state}"] if result.state else lines


def _number(value: Any) -> int | None:
    return int(value) if str(value).isdigit() else None

# SPDX-License-Identifier: MIT
"""`pmsmtool scope`: the trace it leaves, how it ends, and what browsers and others on its port can do to it."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest

from benchmarks.live_page import looks
from pmsmtool.cli import live_server, scope
from pmsmtool.cli.command_table import load_command
from pmsmtool.cli.live_server import MOST_CONNECTIONS, MOST_NUMBERS, MOST_ROWS, LiveServer, Samples
from pmsmtool.commissioning.printed_page import find_browser
from pmsmtool.errors import ConfigError
from pmsmtool.report.report import template
from pmsmtool.trace import read_trace
from tests.cli.conftest import Tool
from tests.drive.served import serving

HOSTILE = '</script><img src=x onerror=alert(1)> "'
SIM = ("--sim", "interior-2k2?nv=:memory:", "scope")


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the pace of the wall clock: a simulated second passes at once."""
    monkeypatch.setattr(scope.time, "sleep", lambda seconds: None)


# ---- the command -------------------------------------------------------------------------------------------


@pytest.mark.chain
@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_it_leaves_a_trace_of_what_was_kept(tool: Tool, suffix: str) -> None:
    code, out, err = tool(*SIM, "U_dc_v", "i_?_a", "--for", "3s", "--keep", "1s", "-o", f"t.{suffix}", "--json")
    assert code == 0, err
    told = json.loads(out)
    assert told["schema"] == "pmsmtool.scope/1" and told["url"].startswith("http://127.0.0.1:")
    trace = read_trace(Path(f"t.{suffix}"))
    assert set(trace.signals) == {"i_d_a", "i_q_a", "U_dc_v", "i_a_a", "i_b_a", "i_c_a"}
    assert trace.units["U_dc_v"] == "V" and trace["U_dc_v"][0] == pytest.approx(540.0, rel=0.05)
    assert len(trace) == 21 and trace.t_s[-1] == pytest.approx(2.95, abs=0.06)
    assert "the latest 21 of 60 readings" in err


@pytest.mark.usefixtures("at_once")
def test_process_data_and_the_choice_without_names(tool: Tool) -> None:
    code, _, err = tool(*SIM, "--pdo", "--rate", "100Hz", "--for", "1s", "-o", "t.npz")
    assert code == 0, err
    trace = read_trace(Path("t.npz"))
    assert tuple(sorted(trace.signals)) == tuple(sorted(scope.SHOWN)) and 95 <= len(trace) <= 101


@pytest.mark.usefixtures("at_once")
def test_plain_draws_in_the_terminal_and_serves_no_page(tool: Tool) -> None:
    code, out, _ = tool(*SIM, "--plain", "i_q_a", "U_dc_v", "--for", "1s", "-o", "x.csv")
    assert code == 0 and "127.0.0.1" not in out
    assert re.search(r"^U_dc_v \d+ V$", out, re.MULTILINE) and re.search(r"[▁-█]{9}|[#@]{9}", out)
    assert read_trace(Path("x.csv")).units["i_q_a"] == "A"


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("i_w_a",), 2, "did you mean i_"),
        (("-o", "t.mat"), 2, ".npz or .csv"),
        (("-o", "nowhere/t.npz"), 2, "no such folder"),
        (("--rate", "10kHz", "--keep", "1000s"), 2, "--keep"),
        (("*", "--pdo", "--for", "1s"), 9, "do not fit"),
    ],
)
def test_what_it_refuses(tool: Tool, arguments: tuple[str, ...], code: int, text: str) -> None:
    found, _, err = tool(*SIM, *arguments)
    assert found == code and text in err, err


def test_a_port_that_is_taken_is_named(tool: Tool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        code, _, err = tool(*SIM, "--port", str(port), "--for", "1s")
    assert code == 2 and f"127.0.0.1:{port}" in err and "--port" in err


@pytest.mark.parametrize(("arguments", "code"), [((), 0), (("--for", "9s"), 130)])
def test_ctrl_c_ends_it_as_it_ends_monitor(
    tool: Tool, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], code: int
) -> None:
    naps, here = iter(range(1000)), threading.get_ident()

    def nap(seconds: float) -> None:
        if threading.get_ident() == here and next(naps) == 30:  # the server's threads sleep, too
            raise KeyboardInterrupt

    monkeypatch.setattr(scope.time, "sleep", nap)
    found, _, err = tool(*SIM, "i_d_a", "-o", "t.csv", *arguments)
    assert found == code and len(read_trace(Path("t.csv"))) == 31, err


@pytest.mark.parametrize("pdo", [(), ("--pdo",)], ids=["polled", "pdo"])
@pytest.mark.parametrize("command", ["scope", "monitor"])
@pytest.mark.usefixtures("at_once")
def test_a_drive_that_falls_silent_ends_it(tool: Tool, command: str, pdo: tuple[str, ...]) -> None:
    """By process data `monitor` printed the last values for ever."""
    Path("cut.toml").write_text('[[drive]]\naction = "power-cut"\nat_s = 2.0\n')
    chosen = ("i_d_a", "-o", "t.csv") if command == "scope" else ("-g", "^i_d_a$")
    code, _, err = tool("--sim", "interior-2k2?nv=:memory:&faults=cut.toml", command, *chosen, "--for", "60s", *pdo)
    assert code == 3 and "error: " in err and "Traceback" not in err
    assert not pdo or ("no process data" in err if command == "monitor" else "no heartbeat" in err)
    if command == "scope":
        assert 1.0 < read_trace(Path("t.csv")).t_s[-1] < 4.0


def test_completion_knows_the_signals() -> None:
    from pmsmtool.cli.command_table import COMMANDS

    command = load_command(next(row for row in COMMANDS if row.name == "scope"))
    context = command.make_context("scope", [])
    found = [item.value for item in command.params[0].shell_complete(context, "U_")]
    assert found == ["U_dc_v"]


# ---- on the wire -------------------------------------------------------------------------------------------


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as chosen:
        return int(chosen.getsockname()[1])


def events(port: int, patience_s: float = 20.0) -> list[tuple[str, Any]]:
    """Follow the samples as a browser does, until the end."""
    latest = time.monotonic() + patience_s
    while True:
        connection = HTTPConnection("127.0.0.1", port, timeout=patience_s)
        try:
            connection.request("GET", "/samples")
            break
        except ConnectionRefusedError:
            assert time.monotonic() < latest
            time.sleep(0.02)
    text = connection.getresponse().read().decode()
    return [(name, json.loads(data)) for name, data in re.findall(r"event: (\w+)\ndata: (.*)\n\n", text)]


def followed(port: int) -> tuple[threading.Thread, list[tuple[str, Any]]]:
    seen: list[tuple[str, Any]] = []
    thread = threading.Thread(target=lambda: seen.extend(events(port)))
    thread.start()
    return thread, seen


@pytest.mark.wall_clock
def test_the_page_hears_that_the_drive_fell_silent(tool: Tool) -> None:
    Path("cut.toml").write_text('[[drive]]\naction = "power-cut"\nat_s = 1.0\n')
    port = free_port()
    thread, seen = followed(port)
    code, _, err = tool(
        "--sim", "interior-2k2?nv=:memory:&faults=cut.toml", "scope", "i_d_a", "--port", str(port), "--for", "60s"
    )
    thread.join()
    assert code == 3
    assert seen[0][0] == "head" and seen[0][1]["signals"] == [{"name": "i_d_a", "unit": "A"}]
    assert seen[-1] == ("end", seen[-1][1]) and seen[-1][1]["good"] is False
    assert seen[-1][1]["text"].split(": ")[1].split(" (")[0] in err


@pytest.mark.chain
@pytest.mark.wall_clock
def test_a_served_drive_at_the_pace_of_the_wall_clock(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with serving("--nv", ":memory:") as server:
        facts = {"host": "127.0.0.1", "port": server.port, "tcp_tune": True}
        monkeypatch.setenv("CAN_CONFIG", json.dumps(facts))
        thread, seen = followed(port)
        code, _, err = tool("-i", "socketcand", "-c", "vcan0", "scope", "--for", "1s", "--port", str(port))
        thread.join()
    assert code == 0, err
    rows = [row for name, data in seen if name == "samples" for row in data]
    assert len(rows) >= 10 and all(len(row) == 7 for row in rows) and 0.8 < rows[-1][0] <= 1.0
    assert seen[-1][1]["good"] is True


@contextlib.contextmanager
def served(rows: int = 10_000, title: str = "x") -> Iterator[LiveServer]:
    samples = Samples(["a", "b"], rows)
    head = {"title": title, "keep_s": 10.0, "signals": [{"name": "a", "unit": "A"}, {"name": "b", "unit": HOSTILE}]}
    with LiveServer(0, template("scope.html.j2").render(), samples, head) as server, server.serving():
        yield server


def port_of(server: LiveServer) -> int:
    return int(server.server_address[1])


def answered(server: LiveServer, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port_of(server)), timeout=5.0) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        parts = []
        with contextlib.suppress(ConnectionError):
            while part := connection.recv(65536):
                parts.append(part)
    return b"".join(parts)


def test_only_pages_of_this_address_are_answered() -> None:
    """Any site can let its own name point to 127.0.0.1 (DNS rebinding): the name then stands in Host."""
    with served() as server:
        port = port_of(server)
        for path in ("/", "/samples", "/other"):
            for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}", "", None):
                line = b"" if host is None else f"Host: {host}\r\n".encode()
                answer = answered(server, f"GET {path} HTTP/1.1\r\n".encode() + line + b"\r\n")
                assert answer.split(b"\r\n")[0].split()[1] == b"403", (path, host)
        good = f"Host: 127.0.0.1:{port}\r\n".encode()
        assert answered(server, b"GET / HTTP/1.1\r\n" + good + b"Host: evil\r\n\r\n").split()[1] == b"403"
        assert answered(server, b"GET /other HTTP/1.1\r\n" + good + b"\r\n").split()[1] == b"404"
        page = answered(server, f"GET / HTTP/1.1\r\nHost: LOCALHOST:{port}\r\n\r\n".encode())
        assert page.split()[1] == b"200" and b"default-src 'none'" in page and b"</html>" in page


def test_what_is_no_request_is_no_news(capfd: pytest.CaptureFixture[str]) -> None:
    with served() as server:
        for request in (b"", b"\0\xff\x16\x03\x01" * 50, b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"A" * 70_000,
                        b"POST / HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 200 + b"\r\n"):  # fmt: skip
            assert b" 200 " not in answered(server, request)[:20]
        thread, seen = followed(port_of(server))
        server.samples.add(0.0, (1.0, 2.0))
        server.samples.end("done", good=True)
        thread.join()
    assert seen[1:] == [("samples", [[0, 1, 2]]), ("end", {"text": "done", "good": True})]
    assert capfd.readouterr() == ("", "")


@pytest.mark.chain
def test_who_does_not_read_or_goes_away_slows_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten that ask and never read, ten that vanish, and more that never ask: one browser sees every sample."""
    monkeypatch.setattr(live_server._Request, "timeout", 0.5)
    with served(rows=20_000) as server:
        port = port_of(server)
        request = f"GET /samples HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
        thread, seen = followed(port)
        while not server.streams:
            time.sleep(0.01)
        idle = []
        for k in range(MOST_CONNECTIONS + 10):
            connection = socket.create_connection(("127.0.0.1", port), timeout=5.0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            with contextlib.suppress(ConnectionError):
                if k < 20:
                    connection.sendall(request)
            if k < 10:
                connection.close()
            else:
                idle.append(connection)
        longest = 0.0
        for k in range(20_000):
            begun = time.thread_time()
            server.samples.add(0.001 * k, (float(k), -1.0 / 3.0))
            longest = max(longest, time.thread_time() - begun)
        server.samples.end("done", good=True)
        thread.join()
        for connection in idle:
            connection.close()
    rows = [row for name, data in seen if name == "samples" for row in data]
    assert [row[1] for row in rows] == list(range(20_000))
    assert longest < 0.05, "of processor time; measured 0.3 ms"


def test_a_late_browser_gets_what_is_kept_in_pieces() -> None:
    with served(rows=1200) as server:
        for k in range(3000):
            server.samples.add(float(k), (float("nan"), float("inf")))
        server.samples.add(2999.0, (1.0, 1.0))  # not later than the last one
        server.samples.end(HOSTILE, good=False)
        seen = events(port_of(server))
    sizes = [len(data) for name, data in seen if name == "samples"]
    assert sum(sizes) == 1200 and max(sizes) == MOST_ROWS
    assert seen[1][1][0] == [1800, None, None] and seen[-1][1]["text"] == HOSTILE
    with pytest.raises(ConfigError):
        Samples(["a"], MOST_NUMBERS)


# ---- the page ----------------------------------------------------------------------------------------------

BROWSER = r"""
const vm = require("vm"), [page, stream, acts] = JSON.parse(require("fs").readFileSync(0, "utf8"));
const ops = [], ids = {}, made = [];
function element(tag) {
  const e = {tag, style: {}, kids: [], on: {}, textContent: "", clientWidth: 900, clientHeight: 208, setAttribute() {},
    addEventListener(n, f) { e.on[n] = f; }, append(...k) { e.kids.push(...k); }, setPointerCapture() {},
    replaceChildren(...k) { e.kids = k; if (k[0].value) e.value = (k.find(o => o.selected) || k[0]).value; },
    getContext: () => new Proxy({}, {get: (t, n) => (...a) => ops.push([n, ...a]), set: () => true})};
  made.push(tag);
  return e;
}
const find = id => ids[id] || (ids[id] = element(id));
find("state").firstChild = element("strong"); find("state").lastChild = element("p");
let frame, source;
vm.runInNewContext(page.match(/<script>([\s\S]*?)<\/script>/)[1], {
  document: {getElementById: find, createElement: element}, window: {addEventListener() {}},
  Option: function (text, value, a, selected) { return {text, value: String(value), selected}; },
  requestAnimationFrame: f => { frame = f; },
  EventSource: function () { source = this; this.on = {}; this.addEventListener = (n, f) => { this.on[n] = f; };
                             this.close = () => { this.closed = true; }; },
});
for (const [name, data] of stream) source.on[name]({data: JSON.stringify(data)});
frame();
for (const [id, event, given] of acts || []) {
  const e = id === "canvas" ? find("panels").kids.find(k => k.tag === "canvas") : find(id);
  if (event === "value") e.value = given; else e.on[event]({preventDefault() {}, ...given});
  frame();
}
const legends = find("panels").kids.filter(k => k.className === "legend");
console.log(JSON.stringify({ops, made, state: find("state").firstChild.textContent, closed: source.closed,
  readout: find("cursor").textContent, times: ops.filter(o => o[0] === "fillText" && / s$/.test(o[1])).map(o => o[1]),
  text: find("state").lastChild.textContent, title: find("title").textContent,
  values: legends.map(l => l.kids.map(s => s.kids[1] + s.kids[2].textContent + s.kids[3]))}));
"""


def test_the_page_has_nothing_from_outside_and_no_text_as_markup() -> None:
    page = template("scope.html.j2").render()
    assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval|//\S|@import|url\(", page)
    assert page.count("<script") == 1 and "{{" not in page and "{%" not in page


@pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script in")
def test_the_page_draws_what_it_is_told_and_says_how_it_ended() -> None:
    rows = [[0.01 * k, k % 7, None if k == 5 else 2.0] for k in range(2000)]
    head = {"title": HOSTILE, "keep_s": 60.0, "signals": [{"name": "a", "unit": "A"}, {"name": "b", "unit": HOSTILE}]}
    end = {"text": HOSTILE, "good": False}
    stream = [("head", head), ("samples", rows[:1500]), ("samples", rows[1500:]), ("end", end)]
    given = json.dumps([template("scope.html.j2").render(), stream])
    done = subprocess.run(["node", "-e", BROWSER], input=given, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["title"], found["state"], found["text"], found["closed"]) == (HOSTILE, "ended early", HOSTILE, True)
    assert found["values"] == [["a 4 A"], [f"b 2 {HOSTILE}"]]
    drawn = [op for op in found["ops"] if op[0] == "lineTo"]
    assert 1000 < len(drawn) < 8000 and all(0.0 <= x <= 900.0 and 0.0 <= y <= 208.0 for _, x, y in drawn)
    assert not {"img", "script"} & set(found["made"])


def acted(*acts: tuple[str, str, Any]) -> dict[str, Any]:
    """What the page shows after acts on it: a saw of 1 s over 20 s, sampled every 10 ms."""
    rows = [[0.01 * k, (k % 100) / 100.0] for k in range(2001)]
    head = {"title": "drive", "keep_s": 60.0, "signals": [{"name": "a", "unit": "A"}]}
    given = json.dumps([template("scope.html.j2").render(), [("head", head), ("samples", rows)], acts])
    done = subprocess.run(["node", "-e", BROWSER], input=given, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.chain
@pytest.mark.wall_clock
@pytest.mark.skipif(find_browser() is None, reason="no browser on this computer")
def test_no_sample_is_lost_on_the_way_to_a_browser() -> None:
    """Ten signals at 1 kHz for 3 s; ten minutes: ``python -m benchmarks.live_page``."""
    last = list(looks(str(find_browser()), 3.0, 1.0))[-1]
    assert (last.latest + 1, last.lost, last.rows) == (3000, 0, 3000)


@pytest.mark.chain
@pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script in")
def test_cursors_zoom_and_trigger_of_the_page() -> None:
    """The canvas draws from 64 to 892 px: 20 s of it at first, so 207 px are 5 s."""
    clicks = [("canvas", kind, {"offsetX": x}) for x in (271, 478) for kind in ("pointerdown", "pointerup")]
    readout = acted(*clicks)["readout"]
    assert "A 5.0000 s" in readout and "B 10.0000 s" in readout and "B - A: 5 s   a 0 A" in readout
    assert "A 5" not in acted(*clicks, ("clear", "click", {}))["readout"]
    wheel = ("canvas", "wheel", {"offsetX": 478, "deltaY": -1000})
    assert acted(wheel)["times"][-1] == "11 s", "e^2 of 20 s around 10 s: 8.65 to 11.35 s"
    dragged = [("canvas", "pointerdown", {"offsetX": 478}), ("canvas", "pointermove", {"offsetX": 271})]
    assert acted(wheel, *dragged)["times"][-1] == "12 s", "a quarter of 2.7 s later"
    assert acted(wheel, ("canvas", "dblclick", {}))["times"][-1] == "20 s", "live again"
    armed = [("span", "value", "2"), ("level", "value", "0.5"), ("edge", "value", "1"), ("source", "value", "1")]
    assert acted(*armed, ("source", "change", {}))["times"][-1] == "19 s", "the edge at 17.5 s: 17.1 to 19.1 s"
    falling = acted(*armed[:2], ("edge", "value", "-1"), armed[3], ("edge", "change", {}))["times"]
    assert falling[-1] == "19.5 s", "the edge at 18 s, with 1.6 s behind it"

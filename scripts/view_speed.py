#!/usr/bin/env python3
"""Pictures per second of `fspt view` while a slider moves.

    scripts/view_speed.py [SCENE.xml] [--seconds 5]             that its WebSocket sends, without a browser
    scripts/view_speed.py [SCENE.xml] [--seconds 5] --browser   that its page draws in a headless Chromium

Moves f_number, then view. Without a browser it asks for the next draft as the page does, two at a time; in the browser
it moves the page's slider sixty times a second. Prints a line for each: pictures a second, and the processor time of
one picture on all cores, in the browser without the browser's own.
"""

from __future__ import annotations

import argparse
import json
import shutil
import struct
import threading
import time
from collections.abc import Callable

from websockets.sync.client import connect

from mitsuba_fspt.viewer.answers import Answers
from mitsuba_fspt.viewer.server import ViewServer

WARM_UP = 10  # pictures before the clock starts
AT_ONCE = 2  # requests under way, as of the page


def measure(url: str, name: str, low: float, high: float, seconds: float) -> tuple[float, float, float]:
    """Pictures a second, processor time of one [s], and its bytes, while `name` moves back and forth."""
    address = url.replace("http", "ws") + "socket"
    with connect(address, origin=url.split("/")[0] + "//" + url.split("/")[2], max_size=None, compression=None) as page:
        page.recv()  # the sliders
        sent = received = count = size = 0  # numbers of the last requests, and of pictures since the warm-up
        start = cpu = 0.0
        while count <= WARM_UP or time.perf_counter() < start + seconds:
            while sent < received + AT_ONCE:
                sent += 1
                share = abs(sent % 60 - 30) / 30
                record = {"kind": "picture", "number": sent, "fine": False}
                page.send(json.dumps(record | {"values": {name: f"{low + share * (high - low):.4g}"}}))
            message = page.recv()
            length = struct.unpack_from("<I", message)[0]
            found = json.loads(message[4 : 4 + length])
            if found["kind"] != "picture":
                raise SystemExit(found["message"])
            received, size, count = found["number"], len(message), count + 1
            if count == WARM_UP:
                start, cpu = time.perf_counter(), time.process_time()
        elapsed, pictures = time.perf_counter() - start, count - WARM_UP
        return pictures / elapsed, (time.process_time() - cpu) / pictures, size


DRAG = """async ([name, low, high, seconds]) => {
    const root = document.querySelector(".fspt"), range = root.querySelector(`input[type=range][name="a:${name}"]`);
    const shown = () => Number(root.dataset.shown), before = shown(), start = performance.now();
    const end = (value) => name === "f_number" ? Math.log(value) : value;  // f_number: in stops
    for (let k = 0; performance.now() < start + 1000 * seconds; k++) {
        range.value = end(low) + (0.5 + 0.5 * Math.sin(k / 15)) * (end(high) - end(low));
        range.dispatchEvent(new Event("input"));
        await new Promise(requestAnimationFrame);
    }
    return [shown() - before, (performance.now() - start) / 1000];
}"""


def measure_in_browser(url: str, name: str, low: float, high: float, seconds: float) -> tuple[float, float, float]:
    """As `measure`, of the pictures that the page draws in a headless Chromium; no bytes."""
    from playwright.sync_api import sync_playwright

    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 860})
        page.goto(url)
        page.wait_for_selector("[data-stage=fine]", timeout=60_000)
        page.evaluate(DRAG, [name, low, high, 2.0])
        cpu = time.process_time()
        pictures, elapsed = page.evaluate(DRAG, [name, low, high, seconds])
        cpu = time.process_time() - cpu
        browser.close()
    return pictures / elapsed, cpu / pictures, float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="scenes/nylon_cylinder.xml")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--browser", action="store_true", help="of the page in a headless Chromium")
    options = parser.parse_args()
    how: Callable[..., tuple[float, float, float]] = measure_in_browser if options.browser else measure
    server = ViewServer(lambda: Answers(options.scene, {}), 0)

    def drag() -> None:
        try:
            for name, low, high in (("f_number", 2.8, 16.0), ("view", -90.0, 90.0)):
                rate, cpu, size = how(server.url, name, low, high, options.seconds)
                data = "" if options.browser else f" and {size / 1e6:.1f} MB"
                print(f"{name}: {rate:.1f} pictures/s, {1e3 * cpu:.0f} ms of processor time{data} each")
        finally:
            server.end()

    server.run(lambda _: threading.Thread(target=drag).start())


if __name__ == "__main__":
    main()

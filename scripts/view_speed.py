#!/usr/bin/env python3
"""Pictures per second that `fspt view` sends while a slider moves: through its WebSocket, without a browser.

    scripts/view_speed.py [SCENE.xml] [--seconds 5]

Moves f_number, then view, and asks for the next draft as the page does, two at a time. Prints a line for each:
pictures a second, and the processor time of one picture on all cores.
"""

from __future__ import annotations

import argparse
import json
import struct
import threading
import time

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="scenes/nylon_cylinder.xml")
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    server = ViewServer(lambda: Answers(options.scene, {}), 0)

    def drag() -> None:
        try:
            for name, low, high in (("f_number", 2.8, 16.0), ("view", -90.0, 90.0)):
                rate, cpu, size = measure(server.url, name, low, high, options.seconds)
                print(
                    f"{name}: {rate:.1f} pictures/s, {1e3 * cpu:.0f} ms of processor time and {size / 1e6:.1f} MB each"
                )
        finally:
            server.end()

    server.run(lambda _: threading.Thread(target=drag).start())


if __name__ == "__main__":
    main()

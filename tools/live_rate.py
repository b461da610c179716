"""How many pictures per second `footwork play` sends a visitor, and how many a browser draws.

    python tools/live_rate.py [--ants 2] [--seconds 20] [--browser]

The server runs in a process of its own; "core" is the share of a core that it used meanwhile.
With --browser, Debian's headless chromium draws the page too, in software, on the same cores: what
a browser with a graphics card leaves free, it takes.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from websockets.sync.client import connect

BESIDE = ["walker/symmetric-interleaved", "walker/plain"]


def cpu_seconds(process):
    """What a process has used so far (Linux)."""
    user, system = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def next_frame(visitor):
    """The next picture."""
    while (message := json.loads(visitor.recv(timeout=600)))["is"] != "frame":
        pass
    return message


def of_server(process, address, ants, seconds):
    """A visitor who draws nothing: pictures per second, control steps per second of one ant, share of a core."""
    with connect(address.replace("http", "ws") + "ants") as visitor:
        next_frame(visitor)
        if ants == 2:
            visitor.send(json.dumps({"do": "sub_policies", "rows": BESIDE}))
            while len(next_frame(visitor)["ants"]) < 2:
                pass
        for _ in range(60):  # the first pictures after compiling come in a bunch
            first = next_frame(visitor)
        begun, used, count = time.monotonic(), cpu_seconds(process), 0
        while (spent := time.monotonic() - begun) < seconds:
            last = next_frame(visitor)
            count += 1
    steps = last["ants"][0]["steps"] - first["ants"][0]["steps"]
    return {
        "pictures_per_second": round(count / spent, 1),
        "control_steps_per_second": round(steps / spent, 1),
        "core": round((cpu_seconds(process) - used) / spent, 2),
    }


def of_browser(address, seconds):
    """Pictures per second that a browser draws of one ant."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from webdriver import Browser

    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(profile, 1280, 800)
        browser.open(address)
        browser.wait("return footwork.panels[0]?.ant?.steps > 60", 600)
        browser.run("footwork.counted = 0; const draw = footwork.draw.bind(footwork);"
                    "footwork.draw = () => { footwork.counted++; draw(); }; return 1")  # fmt: skip
        begun = time.monotonic()
        time.sleep(seconds)
        count = browser.run("return footwork.counted")
        spent = time.monotonic() - begun
        browser.close()
    return {"drawn_per_second": round(count / spent, 1)}


def main():
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ants", type=int, default=1, choices=(1, 2))
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--browser", action="store_true")
    args = parser.parse_args()
    command = [sys.executable, "-m", "footwork", "play", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        address = re.match(r"http://\S+", process.stdout.readline())[0]
        figures = of_server(process, address, args.ants, args.seconds)
        if args.browser:
            figures |= of_browser(address, args.seconds)
        print(json.dumps({"ants": args.ants, **figures}))
    finally:
        process.terminate()
        process.wait(60)


if __name__ == "__main__":
    main()

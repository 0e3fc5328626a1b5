"""The viewer as its page sees it: pictures a second while the camera moves, and how soon the first one comes.

    python -m benchmarks.viewer [--seconds 6] [--out benchmarks/viewer.json]

`sgwarp view` serves the demo's room, 100,000 Gaussians, in a process of its own. Chromium, with GL in software on the
same cores, shows a canvas of 640 x 480 and turns the camera. A picture counts when the page has decoded it. Kernels are
compiled before the clock starts. Once the viewer chooses the size of moving pictures, once all have 480 rows. The
processor time of a picture says what a busy machine hides: how many there could be. Needs Playwright and chromium.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

from sgwarp.demo.data import ROOM, SCENE_FILE
from sgwarp.files.atomic import atomic_path
from sgwarp.ops.launcher import get_threads

WIDTH, HEIGHT = 640, 480
LOAD = round(os.getloadavg()[0], 1)  # of the machine before anything is measured
SOFTWARE_GL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox"]
# The page makes an address for the bytes of a picture, and gives it back when the picture is decoded.
COUNTER = """
window.decoded = [];
const made = URL.createObjectURL.bind(URL), given = URL.revokeObjectURL.bind(URL), pictures = new Map();
URL.createObjectURL = blob => {
    const url = made(blob);
    if (blob.type === 'image/jpeg') heightOf(blob).then(height => pictures.set(url, height));
    return url;
};
const heightOf = async blob => {  // from the header: to decode it once more would take the cores from what is measured
    const view = new DataView(await blob.slice(0, 4096).arrayBuffer());
    for (let at = 2; at + 9 < view.byteLength; at += 2 + view.getUint16(at + 2)) {
        const kind = view.getUint8(at + 1);
        if (kind >= 0xc0 && kind <= 0xc2) return view.getUint16(at + 5);
    }
    return 0;
};
URL.revokeObjectURL = url => { window.decoded.push([performance.now(), url]); given(url); };
window.heights = () => [...pictures.values()];
"""
MOVES = 40  # of the mouse, a second


def serve(height: int = 0) -> tuple[subprocess.Popen[str], str, float]:
    """The viewer's process, its address, and the seconds until it said so; with a height, for all moving pictures."""
    code = "import sys; from sgwarp.cli import main; sys.exit(main())"
    if height:
        code = f"from sgwarp.viewer import pace; pace.SIZES = len(pace.SIZES) * ({height},); {code}"
    arguments = ["view", str(ROOM / SCENE_FILE), "--views", str(ROOM), "--port", "18080"]
    start = time.perf_counter()
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None
    for line in process.stdout:
        found = re.search(r"http://\S+", line)
        if found:
            return process, found[0], time.perf_counter() - start
    raise SystemExit("the viewer did not start")


def end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    process.wait(timeout=30)


def open_page(browser: Any, url: str) -> tuple[Page, float]:
    """A page whose canvas has the wanted size, and the seconds until its first picture was decoded."""
    page = browser.new_page(viewport={"width": WIDTH + 324, "height": HEIGHT})
    page.add_init_script(COUNTER)
    start = time.perf_counter()
    page.goto(f"{url}?fixedDpr=1")  # else the page asks for fewer rows where it is slow
    page.wait_for_function("window.decoded.length > 0", timeout=120_000)
    first = time.perf_counter() - start
    page.wait_for_timeout(2000)
    box = page.locator("canvas").first.bounding_box()
    page.set_viewport_size({"width": round(WIDTH + WIDTH + 324 - box["width"]), "height": HEIGHT})
    page.wait_for_timeout(2000)
    box = page.locator("canvas").first.bounding_box()
    assert (round(box["width"]), round(box["height"])) == (WIDTH, HEIGHT), box
    return page, first


def processor_seconds(root: int) -> float:
    """Of a process and all that it has started and that still run."""
    parents, spent = {}, {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        number = int(folder.name)
        parents[number], spent[number] = int(fields[1]), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    total = 0.0
    for number in spent:
        above = number
        while above and above != root:
            above = parents.get(above, 0)
        total += spent[number] if above == root else 0.0
    return total


def drag(page: Page, seconds: float) -> dict[str, Any]:
    """Turn the camera to and fro with the mouse; says when pictures were decoded [ms]."""
    mouse, middle = page.mouse, (WIDTH / 2, HEIGHT / 2)
    mouse.move(*middle)
    mouse.down()
    begun = page.evaluate("window.decoded = [], performance.now()")
    start = time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        mouse.move(middle[0] + math.sin(passed / 0.7) * WIDTH / 4, middle[1])
        time.sleep(max(0.0, 1 / MOVES - (time.perf_counter() - start - passed)))
    ended, times = page.evaluate("[performance.now(), window.decoded.map(one => one[0])]")
    mouse.up()
    return {"seconds": (ended - begun) / 1000, "times": times}


def measure_rate(browser: Any, seconds: float, height: int = 0) -> dict[str, Any]:
    """Pictures while moving, of the size that the viewer chooses or of one height."""
    process, url, until_served = serve(height)
    page, until_picture = open_page(browser, url)
    drag(page, min(2.0, seconds))  # finds its size
    before = processor_seconds(process.pid), processor_seconds(os.getpid())
    rounds = [drag(page, seconds) for _ in range(3)]
    server = processor_seconds(process.pid) - before[0]
    page_and_driver = processor_seconds(os.getpid()) - before[1] - server
    heights = page.evaluate("window.heights()")
    page.close()
    end(process)
    count = sum(len(one["times"]) for one in rounds)
    gaps = sorted(b - a for one in rounds for a, b in itertools.pairwise(one["times"]))
    return {
        "pictures per second while moving": [round(len(one["times"]) / one["seconds"], 1) for one in rounds],
        "median height of moving pictures": statistics.median(heights[len(heights) // 2 :]),
        "90 % of gaps are shorter than [ms]": round(gaps[int(0.9 * len(gaps))], 1) if gaps else None,
        "processor time of the viewer per picture [ms]": round(1000 * server / max(count, 1), 1),
        "processor time of browser and driver per picture [ms]": round(1000 * page_and_driver / max(count, 1), 1),
        "seconds until it serves": round(until_served, 2),
        "seconds from opening the page to its first picture": round(until_picture, 2),
    }


def measure(seconds: float) -> dict[str, Any]:
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("no chromium here: apt-get install chromium")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=SOFTWARE_GL)
        measure_rate(browser, 0.5)  # compiles, and reads files into the system's cache
        found = {"size chosen": measure_rate(browser, seconds), "480 rows": measure_rate(browser, seconds, HEIGHT)}
        browser.close()
    about = {"gaussians": 100_000, "canvas": [WIDTH, HEIGHT], "threads": get_threads()}
    return {**about, "load average before and after": [LOAD, round(os.getloadavg()[0], 1)], **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=6.0, help="of each of three measurements")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("viewer.json"))
    options = parser.parse_args()
    found = measure(options.seconds)
    with atomic_path(options.out) as temporary:
        temporary.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()

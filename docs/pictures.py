"""The pictures of README and documentation, made anew: ``make pictures``.

The demo draws beam.png. report.png and explore.png are photographs of the pages, which need
playwright and a Chromium: the one that CALIBRATE_BROWSER names, or ``chromium``. Studies draw their
own pictures, ``python -m studies.<name>``, and notebooks theirs, ``make notebooks``.
``python docs/pictures.py report.png`` makes one.
"""

import io
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from calibrate.explorer import Explorer, serve
from calibrate.project import infer
from calibrate.project.demo import DEMOS, run_demo
from calibrate.report import write_report
from emulator.core.store import write_atomically
from emulator.surrogates import load

HERE = Path(__file__).parent
COLOURS = 128
_PATIENCE_MS = 300_000
# Of a page without a graphics card.
SOFTWARE = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


def beam(path: Path) -> None:
    """The figure of ``calibrate demo``."""
    with tempfile.TemporaryDirectory() as folder:
        run_demo(folder)
        write_atomically(path, (Path(folder) / "beam.png").read_bytes())


def report(path: Path, browser: Any) -> None:
    """The body on a report of the ventricle's demo, at one of its draws."""
    with tempfile.TemporaryDirectory() as folder:
        infer(replace(DEMOS["left_ventricle"], sampler="laplace"), folder)
        page = opened(browser, 1152, 900)
        page.goto(write_report(folder, fem=False).resolve().as_uri())
        page.wait_for_selector(".slider-rail-touch-rect")
        rail = page.query_selector(".slider-rail-touch-rect")
        rail.scroll_into_view_if_needed()
        box = rail.bounding_box()
        page.mouse.click(box["x"] + 0.7 * box["width"], box["y"] + 0.5 * box["height"])
        page.mouse.move(0, 0)  # away from the plot, which shows its tools under it
        plot = page.evaluate_handle(
            "[...document.querySelectorAll('.js-plotly-plot')].find(d => d.layout.sliders)"
        )
        page.evaluate(
            "plot => Plotly.relayout(plot, {'scene.camera.eye': {x: 1.5, y: 1.5, z: 1.2}})", plot
        )
        page.wait_for_timeout(2000)
        keep(plot.as_element().screenshot(), path)


def explore(path: Path, browser: Any) -> None:
    """The explorer of the ventricle at a high pressure, compared with FEM."""
    with serve(Explorer(load("left_ventricle"))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            page = opened(browser, 1024, 720)
            page.goto(f"http://127.0.0.1:{server.server_address[1]}")
            page.wait_for_function("window.updates > 0")
            box = page.query_selector("#p-pressure").bounding_box()
            page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + 0.5 * box["height"])
            said = "document.getElementById('{}').innerText.includes('{}')"
            page.wait_for_function(said.format("error", "median"))
            page.click("#fem")
            page.wait_for_function(said.format("against", "off by"))
            keep(page.screenshot(), path)
        finally:
            server.shutdown()
            thread.join()


def opened(browser: Any, width: int, height: int) -> Any:
    """An empty page that is waited for patiently: without a graphics card it draws slowly."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(_PATIENCE_MS)
    return page


def keep(photograph: bytes, path: Path) -> None:
    """Write a photograph with few colours."""
    target = io.BytesIO()
    image = Image.open(io.BytesIO(photograph)).convert("RGB")
    image.quantize(COLOURS).save(target, "PNG", optimize=True)
    write_atomically(path, target.getvalue())


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser, or None after a line that says what is missing."""
    executable = os.environ.get("CALIBRATE_BROWSER") or shutil.which("chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        executable = None
    if executable is None:
        print(
            "no photographs: pip install playwright, and set CALIBRATE_BROWSER to a Chromium",
            file=sys.stderr,
        )
        yield None
        return
    with sync_playwright() as engine:
        browser = engine.chromium.launch(executable_path=executable, args=list(SOFTWARE))
        yield browser
        browser.close()


PHOTOGRAPHS: dict[str, Callable[[Path, Any], None]] = {"report.png": report, "explore.png": explore}


def main() -> None:
    """Make the pictures that are named, or every one."""
    names = sys.argv[1:] or ["beam.png", *PHOTOGRAPHS]
    if "beam.png" in names:
        beam(HERE / "beam.png")
    chosen = [name for name in names if name in PHOTOGRAPHS]
    with chromium() as browser:
        for name in chosen if browser is not None else ():
            PHOTOGRAPHS[name](HERE / name, browser)


if __name__ == "__main__":
    main()

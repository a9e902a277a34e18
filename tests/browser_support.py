"""A real browser, where there is one: playwright, and a Chromium that it can drive."""

import os
import shutil
from contextlib import contextmanager

import pytest


@contextmanager
def opened(address):
    """A page at ``address`` and what it complained about; skips where no browser is installed."""
    sync = pytest.importorskip("playwright.sync_api", reason="no playwright here")
    browser = os.environ.get("CALIBRATE_BROWSER") or shutil.which("chromium")
    if not browser:
        pytest.skip("no browser: set CALIBRATE_BROWSER to a Chromium")
    software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync.sync_playwright() as engine:
        chromium = engine.chromium.launch(executable_path=browser, args=["--no-sandbox", *software])
        page, complaints = chromium.new_page(viewport={"width": 1280, "height": 900}), []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda m: m.type == "error" and complaints.append(m.text))
        page.on("request", lambda r: _is_local(r.url) or complaints.append(r.url))
        page.goto(address)
        yield page, complaints
        chromium.close()


def _is_local(url):
    return url.startswith(("file:", "blob:", "data:", "http://127.0.0.1:"))

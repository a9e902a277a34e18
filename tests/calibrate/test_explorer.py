"""The explorer's answers, its server, and its page in a browser."""

import json
import os
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from browser_support import opened
from calibrate.cli import main
from calibrate.explorer import Explorer, serve
from emulator.core.errors import InputError

CENTRE = {"a": "0.5", "b": "0.5", "a_f": "0.5", "b_f": "0.5", "pressure": "0.5"}


@pytest.fixture(scope="module")
def emulator():
    return em.load("left_ventricle")


@pytest.fixture(scope="module")
def explorer(emulator):
    return Explorer(emulator)


@pytest.fixture(scope="module")
def address(explorer):
    with serving(explorer) as found:
        yield found


@contextmanager
def serving(explorer):
    with serve(explorer) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def ask(address, what, position, **headers):
    words = "&".join(f"{name}={value}" for name, value in position.items())
    request = urllib.request.Request(f"{address}/{what}?{words}", headers=headers)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read()


@pytest.mark.slow
def test_displacement_and_volume_are_the_emulators(emulator, explorer, address):
    position = {**CENTRE, "pressure": "0.8"}
    found = np.frombuffer(ask(address, "at", position), "<f4")
    theta = emulator.scene.from_unit(np.array([0.5, 0.5, 0.5, 0.5, 0.8]))
    nodes = np.unique(emulator.scene.mesh.surface)
    exact = np.asarray(emulator.cache()(theta))
    np.testing.assert_allclose(found[:-1].reshape(-1, 3), exact[nodes], atol=1e-4)
    about = explorer.about()
    assert len(about["nodes"]) == len(nodes)
    assert about["cavities"] == ["endocardium"]
    curve = json.loads(ask(address, "curve", position))
    at = np.interp(float(theta[4]), curve["pressure"], curve["volume"])
    assert found[-1] == pytest.approx(at, rel=2e-3)
    assert (np.diff(curve["volume"]) > 0.0).all()
    klotz = cal.Klotz(at, float(theta[4])).volume(np.array(curve["pressure"]))
    np.testing.assert_allclose(curve["klotz"], klotz, rtol=1e-6)


def test_it_is_fast_enough_to_follow_a_slider(address):
    ask(address, "at", CENTRE)
    begin = time.perf_counter()
    for k in range(40):
        ask(address, "at", {**CENTRE, "a": f"{k / 40}"})
    assert 40 / (time.perf_counter() - begin) > 20.0


def test_the_page_holds_all_it_needs(address):
    page = ask(address, "", {}).decode()
    assert "{{" not in page[page.index("</head>") :]
    assert "src=" not in page[page.rindex("<script>") :]


@pytest.mark.parametrize(
    ("what", "position", "message"),
    [
        ("at", {"a": "0.5"}, "no position for 'b'"),
        ("at", {**CENTRE, "c": "0.5"}, "'c' is no parameter; there are a, b"),
        ("at", {**CENTRE, "a": "1.5"}, "a = 1.5 is not between 0 and 1"),
        ("at", {**CENTRE, "a": "nan"}, "a = nan is not between 0 and 1"),
        ("at", {**CENTRE, "a": "x"}, "a = 'x' is no number"),
        ("_fast", CENTRE, "there are /"),
    ],
)
def test_bad_requests_are_told_in_one_line(address, what, position, message):
    with pytest.raises(urllib.error.HTTPError) as refused:
        ask(address, what, position)
    with refused.value as answer:
        assert answer.code in (400, 404)
        assert message in answer.read().decode()


def test_only_this_machine(explorer, address):
    with pytest.raises(urllib.error.HTTPError) as refused:
        ask(address, "at", CENTRE, Host="elsewhere.example")
    with refused.value as answer:
        assert answer.code == 403
    for headers in ({"Origin": "http://elsewhere.example"}, {"Sec-Fetch-Site": "cross-site"}):
        with pytest.raises(urllib.error.HTTPError) as refused:
            ask(address, "at", CENTRE, **headers)
        with refused.value as answer:
            assert answer.code == 403
    with serve(explorer) as server:
        assert server.server_address[0] == "127.0.0.1"
        with pytest.raises(InputError, match=r"port \d+: .*; give another, or 0"):
            serve(explorer, server.server_address[1])
    with pytest.raises(InputError, match="port 70000"):
        serve(explorer, 70000)


def test_a_body_without_cavity(capsys):
    beam = Explorer(em.load("once_clamped_beam"))
    assert beam.about()["pressure"] is None
    with pytest.raises(InputError, match="no cavity whose pressure varies"):
        beam.curve({"mu": "0.5", "lam": "0.5"})
    for words, message in (
        (["nowhere"], "nowhere"),
        (["liver", "--emulator", "once_clamped_beam"], "is of scene 'once_clamped_beam'"),
    ):
        assert main(["explore", *words]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1


@pytest.mark.slow
def test_error_bar_and_fem(explorer):
    told = explorer.error(CENTRE)
    assert told["trusted"]
    assert told["max_mm"] < 0.01
    against = explorer.compare(CENTRE)
    assert against["status"] == "converged"
    assert against["max_mm"] < 0.01
    assert against["volumes"]["endocardium"] > 100.0


@pytest.mark.slow
def test_in_a_browser(address):
    with opened(address) as (page, complaints):
        page.wait_for_function("window.updates > 0")
        before = page.evaluate("Array.from(moved.slice(0, 300))")
        text = page.inner_text("#volumes")
        slider = page.query_selector("#p-pressure").bounding_box()
        page.mouse.click(slider["x"] + 0.9 * slider["width"], slider["y"] + 8)
        page.wait_for_function(f"document.getElementById('volumes').innerText !== '{text}'")
        page.wait_for_function("document.getElementById('error').innerText.includes('median')")
        assert page.evaluate("Array.from(moved.slice(0, 300))") != before
        assert page.evaluate("gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.getError()")
        page.click("#fem")
        page.wait_for_function("document.getElementById('against').innerText.includes('off by')")
        # As fast as it goes: every answer asks for the next.
        rate = page.evaluate("""async () => {
            const begin = performance.now(), first = window.updates;
            for (let k = 0; performance.now() - begin < 3000; k++) {
                position.a = (k % 100) / 100; await move();
            }
            return 1000 * (window.updates - first) / (performance.now() - begin);
        }""")
        if "CALIBRATE_SCREENSHOT" in os.environ:
            page.screenshot(path=os.environ["CALIBRATE_SCREENSHOT"])
        print(f"{rate:.0f} updates a second, drawn by software")
        assert rate > 5.0
        assert complaints == []

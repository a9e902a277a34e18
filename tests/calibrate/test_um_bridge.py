"""Forward maps for other programs: the protocol over HTTP, its own client, the command line."""

import http.client
import json
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from calibrate.um_bridge import serve
from emulator.surrogates.fem import fem_forward
from linear_support import linear_forward

# What is started in the background, as all of a test run may be, inherits that Ctrl-C is ignored.
CALL = """
import signal, sys
from calibrate.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(sys.argv[1:]))
"""


class NoError(urllib.request.HTTPErrorProcessor):
    """Returns answers of every status."""

    def http_response(self, request, response):
        return response


@contextmanager
def serving(forward, observe):
    with serve(forward, observe, port=0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def ask(address, what, asked=None, **headers):
    """The answer, or the error's type and message."""
    sent = asked if isinstance(asked, bytes | None) else json.dumps(asked).encode()
    request = urllib.request.Request(f"{address}/{what}", data=sent, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.loads(answer.read())
    except urllib.error.HTTPError as refused:
        with refused:
            return json.loads(refused.read()).get("error", {})


@pytest.fixture(scope="module")
def forward(ventricle):
    return linear_forward(ventricle)


@pytest.fixture(scope="module")
def observe(forward):
    landmarks = cal.nodal_displacements(forward.scene, np.array([10, 50]))
    return {"landmarks": landmarks, "volume": cal.CavityVolume(forward.scene)}


@pytest.fixture(scope="module")
def address(forward, observe):
    with serving(forward, observe) as found:
        yield found


def exactly(forward, observe, theta):
    u = forward(theta)
    return [jnp.ravel(part(u[part.nodes], theta)) for part in observe.values()]


def asked(theta, **more):
    return {"name": "forward", "input": [list(map(float, theta))], "config": {}, **more}


def test_what_a_client_is_told(address):
    assert ask(address, "Info") == {"protocolVersion": 1.0, "models": ["forward"]}
    named = {"name": "forward", "config": {}}
    assert ask(address, "InputSizes", named) == {"inputSizes": [5]}
    assert ask(address, "OutputSizes", named) == {"outputSizes": [6, 1]}
    does = ask(address, "ModelInfo", named)["support"]
    assert does.pop("ApplyHessian") is False
    assert all(does.values())


def test_values_and_derivatives_are_the_map_s(address, forward, observe):
    theta = np.array(forward.scene.centre) * 1.1
    found = ask(address, "Evaluate", asked(theta))["output"]
    exact = exactly(forward, observe, theta)
    for one, other in zip(found, exact, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9)
    rng = np.random.default_rng(0)
    for output, numbers in enumerate((6, 1)):
        weights, along = rng.normal(size=numbers), rng.normal(size=5)
        jacobian = jax.jit(jax.jacfwd(lambda t, o=output: exactly(forward, observe, t)[o]))(theta)
        where = {"outWrt": output, "inWrt": 0}
        gradient = ask(address, "Gradient", asked(theta, sens=weights.tolist(), **where))
        np.testing.assert_allclose(gradient["output"], weights @ jacobian, rtol=1e-7, atol=1e-9)
        pushed = ask(address, "ApplyJacobian", asked(theta, vec=along.tolist(), **where))
        np.testing.assert_allclose(pushed["output"], jacobian @ along, rtol=1e-7, atol=1e-9)


def test_fem_with_derivatives_from_its_factors(beam, simulator):
    observe = cal.nodal_displacements(beam, np.array([40]))
    theta = np.array(beam.centre)
    with serving(fem_forward(simulator), observe) as address:
        (u,) = ask(address, "Evaluate", asked(theta))["output"]
        np.testing.assert_allclose(u, simulator(beam.centre)[40], rtol=1e-10)
        step = np.zeros(2)
        step[0] = 1e-4 * theta[0]
        ends = [ask(address, "Evaluate", asked(theta + s * step))["output"][0] for s in (1, -1)]
        slope = ask(address, "ApplyJacobian", asked(theta, outWrt=0, inWrt=0, vec=[1.0, 0.0]))
        by_differences = (np.array(ends[0]) - ends[1]) / (2.0 * step[0])
        np.testing.assert_allclose(slope["output"], by_differences, rtol=1e-4, atol=1e-10)


@pytest.mark.parametrize(
    ("what", "change", "kind", "message"),
    [
        ("Evaluate", {"name": "other"}, "ModelNotFound", "no model 'other', but 'forward'"),
        ("Evaluate", {"input": [[1.0, 2.0]]}, "InvalidInput", r"shape (2,); give 5 finite numbers"),
        ("Evaluate", {"input": [[float("nan")] * 5]}, "InvalidInput", "give 5 finite numbers"),
        ("Evaluate", {"input": []}, "InvalidInput", "give one input: theta"),
        ("Evaluate", {"input": [["x"] * 5]}, "InvalidInput", "cannot read the request"),
        ("Gradient", {"outWrt": 2}, "InvalidInput", "outWrt is 2; give 0 to 1"),
        ("Gradient", {"inWrt": -1}, "InvalidInput", "inWrt is -1; give 0 to 0"),
        ("Gradient", {"sens": [1.0, 1.0]}, "InvalidInput", "sens has shape (2,); give 1"),
        ("ApplyJacobian", {}, "InvalidInput", "cannot read the request: 'vec'"),
        ("ApplyHessian", {}, "UnsupportedFeature", "ApplyHessian: not offered"),
    ],
)
def test_bad_requests_are_told_by_type_and_line(address, forward, what, change, kind, message):
    request = asked(forward.scene.centre, outWrt=1, inWrt=0, sens=[1.0]) | change
    error = ask(address, what, request)
    assert error["type"] == kind
    assert message in error["message"]
    assert "\n" not in error["message"]


def test_what_is_no_request(address):
    for sent in (b"{", b"[1]", b""):
        assert ask(address, "Evaluate", sent)["type"] == "InvalidInput"
    named = {"name": "forward"}
    assert ask(address, "InputSizes", named, Host="elsewhere.example")["type"] == "InvalidInput"
    assert ask(address, "nothing") == {}


def test_requests_that_cannot_be_read_are_answered(address):
    """A length below 0 was read to an end that never comes; deep lists overflowed the stack."""
    for length in ("-1", "x", "9" * 12, ""):
        connection = http.client.HTTPConnection(address.removeprefix("http://"), timeout=20)
        connection.putrequest("POST", "/Evaluate")
        connection.putheader("Content-Length", length)
        connection.endheaders()
        answer = connection.getresponse()
        assert answer.status == 400
        assert f"Content-Length is {length}; give" in json.loads(answer.read())["error"]["message"]
        connection.close()
    for deep in (b"[" * 20_000, b'{"a": ' * 20_000 + b"1" + b"}" * 20_000, b"[" * 10**6):
        error = ask(address, "Evaluate", deep)
        assert error["type"] == "InvalidInput"
        assert "\n" not in error["message"]


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({}, 200),
        ({"Origin": "{address}"}, 200),
        ({"Origin": "http://elsewhere.example"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "null"}, 403),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}, 403),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}, 200),
    ],
)
def test_pages_of_other_sites_are_refused(address, headers, code):
    headers = {name: value.format(address=address) for name, value in headers.items()}
    for what, data in (("Info", None), ("InputSizes", b'{"name": "forward"}')):
        request = urllib.request.Request(f"{address}/{what}", data=data, headers=headers)
        with urllib.request.build_opener(NoError).open(request, timeout=60) as answer:
            assert answer.status == code


def test_no_answer_is_an_error_not_a_number(beam):
    """Nor is a slope one, nor what is not finite, which JSON has no word for."""
    observe = cal.nodal_displacements(beam, np.array([40]))
    with serving(linear_forward(beam, limit=1e3), observe) as address:
        outside = asked([1e6, 1e6], outWrt=0, inWrt=0, sens=[1.0] * 3)
        for what in ("Evaluate", "Gradient"):
            error = ask(address, what, outside)
            assert error["message"] == "serve: linear has no answer at 1 of 1 theta"
    with serving(linear_forward(beam, bias=np.inf), observe) as address:
        assert ask(address, "Evaluate", asked([1.0, 1.0]))["type"] == "InvalidOutput"


def test_many_ask_at_once(address, forward):
    centre = np.array(forward.scene.centre)
    thetas = [centre * (1.0 + 0.01 * k) for k in range(8)]
    alone = [ask(address, "Evaluate", asked(theta)) for theta in thetas]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(lambda t: ask(address, "Evaluate", asked(t)), thetas)) == alone


def test_the_protocol_s_own_client(address, forward, observe):
    umbridge = pytest.importorskip("umbridge")
    model = umbridge.HTTPModel(address, "forward", use_shmem=True)
    theta = np.array(forward.scene.centre)
    assert model.get_input_sizes() == [5]
    assert model.get_output_sizes() == [6, 1]
    exact = exactly(forward, observe, theta)
    np.testing.assert_allclose(model([theta.tolist()])[1], exact[1], rtol=1e-8)
    gradient = model.gradient(1, 0, [theta.tolist()], [1.0])
    along = [model.apply_jacobian(1, 0, [theta.tolist()], e.tolist())[0] for e in np.eye(5)]
    np.testing.assert_allclose(gradient, along, rtol=1e-9)
    with pytest.raises(Exception, match="InvalidInput: theta has shape"):
        model([[1.0]])


def test_from_the_command_line():
    words = [sys.executable, "-c", CALL, "serve", "once_clamped_beam", "--port", "0", "--json"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as process:
        try:
            lines = list(iter(process.stdout.readline, "}\n"))
            told = json.loads("".join([*lines, "}"]))
            assert told["input"] == ["mu", "lam"]
            assert told["output"] == [{"name": "displacement", "numbers": 72, "unit": "mm"}]
            found = ask(told["address"], "Evaluate", asked([70.0, 80.0]))["output"]
            assert np.abs(found).max() > 1.0
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert said.strip() == "ended"

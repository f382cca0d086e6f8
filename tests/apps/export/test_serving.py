"""Answers over HTTP: many clients, malformed requests, clients that die,
a stop after what is under way.
"""

import contextlib
import http.client
import json
import logging
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from refusals import refused_as

import gsparc
from gsparc.base.limits import SettingError
from gsparc.models import checkpoint
from gsparc.prediction.updating import versions_extra

pytest.importorskip("uvicorn", reason="the extra `serve` is not installed")
pytest.importorskip("fastapi", reason="the extra `serve` is not installed")
from gsparc.apps.export import serving
from gsparc.apps.export.batching import Batcher
from gsparc.apps.export.serving import Limits, build_application, make_server
from gsparc.apps.export.told_file import ToldFile
from gsparc.apps.export.wire import RAW

TX = np.array([3.0, 2, 2])


def fitted(kind="rssi", model=None, save=None):
    rng = np.random.default_rng(0)
    rx = rng.uniform([0, 0, 0], [20, 20, 2], (60, 3))
    far = np.linalg.norm(rx - TX, axis=1)
    if kind == "rssi":
        return gsparc.fit(
            rx=rx, tx=TX, rssi=-40 - 20 * np.log10(far), model=model or "gp", save=save
        )
    csi = (np.exp(-2j * np.pi * 30e6 / 3e8 * far) / far)[:, None, None]
    return gsparc.fit(rx=rx, tx=TX, csi=csi, frequency_hz=30e6, model="complex_gp", save=save)


def ask_http(port, method, path, body, headers):
    """Status, body and headers of an answer."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as client:
        client.request(method, path, body, headers)
        answer = client.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())


class Served:
    def __init__(self, predictor, token=None, update_file=None, accepts_pilots=False, **limits):
        limits = Limits(**{"most": 64, **limits})
        app = build_application(predictor, limits, token, update_file, accepts_pilots)
        self.server = make_server(app, limits, port=0)
        self.thread = threading.Thread(target=self.server.run, daemon=True)

    def __enter__(self):
        self.thread.start()
        until = time.monotonic() + 20
        while not self.server.started and time.monotonic() < until:
            time.sleep(0.01)
        self.port = self.server.servers[0].sockets[0].getsockname()[1]
        return self

    def __exit__(self, *_):
        self.server.should_exit = True
        self.thread.join(20)
        assert not self.thread.is_alive()

    def post(self, body, kind="application/json", path="/predict", **headers):
        return ask_http(self.port, "POST", path, body, {"content-type": kind, **headers})

    def get(self, path, **headers):
        return ask_http(self.port, "GET", path, None, headers)

    def send(self, sent):
        client = socket.create_connection(("127.0.0.1", self.port), timeout=20)
        client.sendall(sent)
        return client

    def within(self, seconds, ready):
        until = time.monotonic() + seconds
        while not ready() and time.monotonic() < until:
            time.sleep(0.02)
        return ready()


def as_json(places, **more):
    return json.dumps({"places": np.asarray(places).tolist(), **more})


@pytest.fixture(scope="module")
def powers():
    return fitted()


@pytest.fixture(scope="module")
def served(powers):
    with Served(powers) as running:
        yield running


def test_json_and_raw_bodies_hold_what_the_model_answers(powers, served):
    places = np.random.default_rng(1).uniform(0, 10, (7, 3)).astype(np.float32)
    expected = powers.rssi(rx=places.astype(np.float64))
    status, body, _ = served.post(as_json(places))
    assert status == 200 and json.loads(body)["shape"] == [7, 1]
    np.testing.assert_allclose(json.loads(body)["values"], expected, rtol=1e-5)
    status, body, headers = served.post(places.tobytes(), RAW)
    assert status == 200 and headers["x-shape"] == "7,1"
    np.testing.assert_allclose(np.frombuffer(body, "<f4"), expected[:, 0], rtol=1e-5)
    assert json.loads(served.get("/healthz")[1]) == {
        "status": "ok",
        "kind": "rssi",
        "model": "gp",
        "end": "rx",
        "unit": "dBm",
    }


def test_a_media_type_in_capitals_was_taken_for_json(served):
    assert served.post(np.ones((1, 3), "<f4").tobytes(), RAW.title())[0] == 200


def test_deviations_took_a_second_request_and_a_second_computation(powers, served, monkeypatch):
    places, calls = np.random.default_rng(3).uniform(0, 9, (5, 3)), []
    spread, own = powers.std(rx=places), powers.method.predict
    monkeypatch.setattr(
        powers.method, "predict", lambda query: calls.append(len(query)) or own(query)
    )
    status, body, _ = served.post(as_json(places, std=True))
    said = json.loads(body)
    assert status == 200 and calls == [5]
    np.testing.assert_allclose(said["std"], spread, rtol=1e-5)
    np.testing.assert_allclose(said["values"], powers.rssi(rx=places), rtol=1e-5)
    _, raw, heads = served.post(places.astype("<f4").tobytes(), RAW, "/predict?std=true")
    assert heads["x-shape"] == heads["x-std-shape"] == "5,1"
    np.testing.assert_allclose(np.frombuffer(raw, "<f4")[5:], spread[:, 0], rtol=1e-3)
    assert served.post(as_json(places), path="/std")[0] == 404


def test_those_who_ask_for_deviations_are_computed_with_those_who_do_not(powers):
    places = np.random.default_rng(4).uniform(0, 9, (3, 3))
    with Served(powers, delay_ms=300) as served, ThreadPoolExecutor(3) as clients:
        bodies = as_json(places), as_json(places[:1], std=True), as_json(places[:1], std=1)
        plain, both, wrong = clients.map(served.post, bodies)
    np.testing.assert_allclose(json.loads(plain[1])["values"], powers.rssi(rx=places), rtol=1e-5)
    assert "std" not in json.loads(plain[1]) and np.shape(json.loads(both[1])["std"]) == (1, 1)
    assert wrong[0] == 422 and json.loads(wrong[1])["detail"].startswith("std: ")


def test_channels_with_deviations_have_as_many_axes():
    model, places = fitted("csi"), np.random.default_rng(4).uniform(0, 9, (3, 3))
    with Served(model) as served:
        said = json.loads(served.post(as_json(places, std=True))[1])
    wanted = model.csi(rx=places)
    np.testing.assert_allclose(np.array(said["values"])[..., 0], wanted.real, atol=1e-5)
    np.testing.assert_allclose(said["std"], model.std(rx=places), rtol=1e-5)


def test_a_method_without_deviations_says_so():
    with Served(gsparc.fit(rx=np.eye(3), tx=TX, rssi=[-40, -50, -60], model="zero")) as served:
        status, body, _ = served.post(as_json([[5, 5, 1]], std=True))
    assert status == 422 and json.loads(body)["detail"] == "the model states no deviations"


def test_all_stations_in_the_unit_asked_for():
    """Of several stations none was served but by name, and no deviation at all."""
    level = -40 - np.arange(60)[:, None] / 9 - [0, 10]
    places = np.random.default_rng(0).uniform(0, 20, (60, 3))
    masts = [[0, 0, 9], [9, 9, 9]]
    several = gsparc.fit(rx=places, station_position=masts, rssi=level, unit="dBW", model="gp")
    with Served(gsparc.Predictor(several.method, several.site, unit="mW")) as running:
        status, body, _ = running.post(as_json(places[:3], std=True))
        _, raw, headers = running.post(places[:3].astype("<f4").tobytes(), RAW)
    said, wanted = json.loads(body), several.rssi(rx=places[:3], unit="mW")
    assert status == 200 and headers["x-unit"] == said["unit"] == "mW" and said["shape"] == [3, 2]
    np.testing.assert_allclose(said["values"], wanted, rtol=1e-5)
    np.testing.assert_allclose(said["std"], several.std(rx=places[:3], unit="mW"), rtol=1e-5)
    np.testing.assert_allclose(np.frombuffer(raw, "<f4"), wanted.ravel(), rtol=1e-4)


def test_channels_of_all_stations_hear_pilots_of_a_run():
    """Channels were served by station alone, and never told of anything."""
    draw = np.random.default_rng(0)
    places, stations = draw.uniform(0, 2, (60, 3)), draw.uniform([0, 0, 3], [2, 2, 5], (3, 3))
    far = np.linalg.norm(places[:, None] - stations, axis=2)
    heard = np.exp(-2j * np.pi * 5 * far) / far
    known = {"station_position": stations, "frequency_hz": [1.5e9], "align": "none"}
    model = gsparc.fit(tx=places[:40], csi=heard[:40], **known)
    limits = Limits()
    refused_as(
        SettingError, "reaches it", build_application, model, limits, None, accepts_pilots=True
    )
    turned = 2j * heard[40:, :]
    parts = np.stack([turned.real, turned.imag], -1).reshape(20, -1).tolist()
    parts[0][:2] = [None, None]
    pilots = json.dumps({"places": places[40:].tolist(), "csi": parts})
    query = json.dumps({"places": places[40:].tolist()})
    head = {"authorization": "Bearer word"}
    with Served(model, "word", accepts_pilots=True) as served:
        before = json.loads(ask_http(served.port, "POST", "/predict", query, head)[1])
        assert before["shape"] == [20, 3, 1, 1, 2]
        status, body, _ = ask_http(served.port, "POST", "/hear", pilots, head)
        assert (status, json.loads(body)) == (200, {"rows": 20})
        short = json.dumps({"places": [[0, 0, 0]], "csi": [[1.0]]})
        assert ask_http(served.port, "POST", "/hear", short, head)[0] == 422
        after = json.loads(ask_http(served.port, "POST", "/predict", query, head)[1])
    answers = (np.array(said["values"])[..., 0, 0, :] @ [1, 1j] for said in (before, after))
    missed = [np.abs(said - turned).mean() for said in answers]
    assert missed[1] < 0.3 * missed[0]


def test_the_level_of_silence_is_null(monkeypatch):
    """JSON has no infinity: the answer was an error of the server."""
    silent = gsparc.fit(rx=np.eye(3), tx=TX, rssi=[-40, -50, -60], model="zero")
    with Served(silent) as running:
        status, body, _ = running.post(as_json([[5, 5, 1], [4, 4, 1]]))
    assert status == 200 and json.loads(body)["values"] == [[None], [None]]


def test_32_clients_get_their_own_answers_computed_together(powers, monkeypatch):
    rng = np.random.default_rng(2)
    given = [rng.uniform(0, 10, (1 + i % 3, 3)) for i in range(32 * 8)]
    expected = [powers.rssi(rx=places) for places in given]
    calls = []
    own = powers.predict
    with Served(powers) as served, ThreadPoolExecutor(32) as clients:
        monkeypatch.setattr(powers, "predict", lambda rx: calls.append(len(rx)) or own(rx=rx))
        found = list(clients.map(lambda places: served.post(as_json(places)), given))
    for (status, body, _), wanted in zip(found, expected, strict=True):
        assert status == 200
        np.testing.assert_allclose(json.loads(body)["values"], wanted, rtol=1e-5)
    assert sum(calls) == sum(map(len, given)) and len(calls) < len(given)


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [
        ("", "application/json", 422),
        ("{", "application/json", 422),
        ("[1, 2]", "application/json", 422),
        ('{"places": "here"}', "application/json", 422),
        ('{"places": [[1, 2]]}', "application/json", 422),
        ('{"places": [[1, 2], [3, 4, 5]]}', "application/json", 422),
        ('{"places": [[1, 2, NaN]]}', "application/json", 422),
        ('{"places": []}', "application/json", 422),
        (b"\xff\xfe", "application/json", 422),
        ('{"places": [[1, 2, 1e300]]}', "application/json", 422),
        ('{"places": [[1, 2, 1%s]]}' % ("0" * 400), "application/json", 422),
        ('{"places": [[1, 2, true]]}', "application/json", 422),
        ('{"places": [[1, 2, "3"]]}', "application/json", 422),
        ('{"places": [[1, 2, 3]], "unit": "km"}', "application/json", 422),
        ('{"places": ' + "[" * 60, "application/json", 422),
        ('{"places": ' + "[" * 9000, "application/json", 413),
        (b"12345", RAW, 422),
        (np.full(3, np.inf, "<f4").tobytes(), RAW, 422),
        (np.zeros((65, 3), "<f4").tobytes(), RAW, 413),
        (b"0" * 100_000, RAW, 413),
    ],
)
def test_malformed_requests_are_refused_and_the_next_is_answered(served, body, kind, status):
    found = served.post(body, kind)
    assert found[0] == status and "\n" not in json.loads(found[1])["detail"]
    assert served.post(as_json([[1, 2, 1]]))[0] == 200


def test_a_token_is_asked_for(powers):
    with Served(powers, token="secret") as served:
        for path in ("/docs", "/openapi.json", "/nowhere"):
            assert served.get(path)[0] == 401
            assert served.get(path, authorization="Bearer secret")[0] in (200, 404)
        assert served.get("/healthz")[0] == 200
        assert served.post(as_json([[1, 2, 1]]))[0] == 401
        assert served.post(as_json([[1, 2, 1]]), authorization="Bearer wrong")[0] == 401
        assert served.post(as_json([[1, 2, 1]]), authorization="Bearer secret")[0] == 200


def test_raw_places_in_utm_metres_were_rounded_to_half_a_metre():
    north = np.array([447_000.0, 4_500_000, 0])
    rx = np.random.default_rng(0).uniform([0, 0, 0], [20, 20, 2], (40, 3))
    level = -40 - 20 * np.log10(np.linalg.norm(rx - TX, axis=1))
    utm = gsparc.fit(rx=rx + north, tx=TX + north, rssi=level, model="gp")
    with Served(utm) as served:
        status, body, _ = served.post((rx[:2] + north).astype("<f4").tobytes(), RAW)
        assert (
            status == 422 and "float32, which moves in steps of 0.5 m" in json.loads(body)["detail"]
        )
        assert served.post(as_json(rx[:2] + north))[0] == 200


@pytest.fixture(scope="module")
def spectra():
    rng = np.random.default_rng(3)
    given = {"rx": np.array([2.0, 1, 1]), "tx": rng.uniform(0, 4, (20, 3)), "model": "gp"}
    return gsparc.fit(spectrum=rng.uniform(0, 1, (20, 18, 36)), **given)


def test_numbers_of_an_answer_are_limited(spectra):
    places = np.random.default_rng(1).uniform(0, 4, (31, 3)).astype(np.float32)
    with Served(spectra, numbers=20_000) as served:
        status, body, _ = served.post(as_json(places))
        assert status == 413 and json.loads(body)["detail"] == "at most 30 places, 648 numbers each"
        expected = spectra.spectrum(tx=places[:30].astype(np.float64))
        found = json.loads(served.post(as_json(places[:30]))[1])
        assert found["shape"] == [30, 18, 36]
        np.testing.assert_allclose(found["values"], expected, rtol=1e-4, atol=1e-6)
        raw = np.frombuffer(served.post(places[:30].tobytes(), RAW)[1], "<f4")
        np.testing.assert_allclose(raw.reshape(30, 18, 36), expected, rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="numbers=600: one place's answer holds 648"):
        build_application(spectra, Limits(numbers=600), None)


def test_requests_beyond_the_connections_are_refused_until_one_ends(powers):
    with Served(powers, connections=3) as served:
        clients = [served.send(b"POST /predict HTTP/1.1\r\n") for _ in range(3)]
        assert served.within(5, lambda: served.post(as_json([[1, 2, 1]]))[0] == 503)
        clients.pop().close()
        assert served.within(5, lambda: served.post(as_json([[1, 2, 1]]))[0] == 200)
        for client in clients:
            client.close()


def test_a_head_of_more_than_8_kilobytes_is_refused(served):
    with served.send(b"GET /healthz HTTP/1.1\r\nhost: " + b"a" * 9000) as client:
        assert client.recv(65536).startswith(b"HTTP/1.1 400")


def test_the_log_stays_open_while_there_are_files(powers, tmp_path):
    """The server closed it, and opened it again to say that there are no files."""
    log = logging.FileHandler(tmp_path / "log")
    logging.getLogger().addHandler(log)
    try:
        with Served(powers):
            assert log.stream is not None
    finally:
        logging.getLogger().removeHandler(log)
        log.close()


@contextlib.contextmanager
def commanded(folder, predictor, *settings, files=None):
    """The command in a process of its own that may open so many files, and its port."""
    checkpoint.save(folder / "model.ckpt", predictor.method)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    line = [
        sys.executable,
        "-m",
        "gsparc",
        "serve",
        f"ckpt={folder}/model.ckpt",
        f"port={port}",
        *settings,
    ]
    allow = files and partial(resource.setrlimit, resource.RLIMIT_NOFILE, (files, files))
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    served = subprocess.Popen(line, cwd=folder, env=environment, preexec_fn=allow)
    try:
        until = time.monotonic() + 60
        while time.monotonic() < until and served.poll() is None:
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", port)).close()
                break
            time.sleep(0.2)
        yield served, port
    finally:
        served.kill()
        served.wait()


def asked(port, places):
    status, body, _ = ask_http(
        port, "POST", "/predict", as_json(places), {"content-type": "application/json"}
    )
    return status, json.loads(body)


@pytest.mark.slow
def test_the_command_serves_until_it_is_told_to_stop(powers, tmp_path):
    with (
        commanded(tmp_path, powers, "delay_ms=1000") as (served, port),
        ThreadPoolExecutor(1) as clients,
    ):
        answer = clients.submit(asked, port, [[1, 2, 1]])
        time.sleep(0.5)
        served.send_signal(signal.SIGTERM)  # while the request waits for others
        assert answer.result()[0] == 200
        assert served.wait(20) in (0, -signal.SIGTERM)


@pytest.mark.slow
def test_a_port_in_use_was_told_after_the_model_was_read(powers, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        checkpoint.save(tmp_path / "model.ckpt", powers.method)
        line = [sys.executable, "-m", "gsparc", "serve", "ckpt=model.ckpt", f"port={port}"]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
    said = (done.stdout + done.stderr).strip()
    assert done.returncode == 1 and said.count("\n") == 0
    assert f"port={port} of host=127.0.0.1: Address already in use" in said


@pytest.mark.slow
def test_several_processes_answer_at_one_port_and_count_together(powers, tmp_path):
    with commanded(tmp_path, powers, "workers=2") as (served, port):
        until = time.monotonic() + 60
        while time.monotonic() < until and asked(port, [[1, 2, 1]])[0] != 200:
            time.sleep(0.2)
        for _ in range(20):
            assert asked(port, [[1, 2, 1]])[0] == 200
        text = ask_http(port, "GET", "/metrics", None, {})[1].decode()
        assert "gsparc_places_total 21.0" in text
        served.send_signal(signal.SIGTERM)
        assert served.wait(20) in (0, -signal.SIGTERM)


def test_several_processes_take_no_rows(powers, tmp_path):
    checkpoint.save(tmp_path / "model.ckpt", powers.method)
    line = [sys.executable, "-m", "gsparc", "serve", "ckpt=model.ckpt", "workers=2", "updates=true"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and "updates=true one process" in done.stdout + done.stderr


@pytest.mark.slow
def test_half_sent_requests_took_all_files(powers, tmp_path):
    """And the process ended: it answers again when they are gone."""
    with commanded(tmp_path, powers, files=90) as (served, port):
        assert asked(port, [[1, 2, 1]])[0] == 200
        with contextlib.ExitStack() as clients:
            for _ in range(120):
                client = clients.enter_context(socket.create_connection(("127.0.0.1", port)))
                client.sendall(b"POST /predict HTTP/1.1\r\n")
            time.sleep(2)
            assert served.poll() is None
        assert asked(port, [[1, 2, 1]])[0] == 200


def test_a_second_request_hid_in_a_body_of_two_ends(served):
    """`Content-Length` beside `Transfer-Encoding` was answered, and what stood behind it, too."""
    body = as_json([[1, 2, 1]])
    chunked = f"{len(body):x}\r\n{body.decode() if isinstance(body, bytes) else body}\r\n0\r\n\r\n"
    head = (
        "POST /predict HTTP/1.1\r\nHost: a\r\nContent-Type: "
        "application/json\r\nContent-Length: 4\r\n"
    )
    with socket.create_connection(("127.0.0.1", served.port), timeout=10) as client:
        client.sendall((head + "Transfer-Encoding: chunked\r\n\r\n" + chunked).encode())
        client.sendall(b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n")
        answer = b""
        with contextlib.suppress(ConnectionResetError):
            while part := client.recv(65536):
                answer += part
    assert answer.startswith(b"HTTP/1.1 400") and answer.count(b"HTTP/1.1") == 1
    assert b"Content-Length beside Transfer-Encoding" in answer and b"connection: close" in answer


@pytest.mark.parametrize(
    ("body", "where"),
    [
        ('{"places": [[1, 2, 3], [1, 2, 3], [1, 2, 3], [1, "2", 3]]}', "places[3][1]: "),
        ('{"places": [[1, 2, 3], [1, 2]]}', "places[1][2]: "),
        ('{"places": [[1, 2, 1e300]]}', "places[0][2]: "),
        ('{"places": [[1, 2, 3]], "unit": "km"}', "unit: "),
        ("{", "Invalid JSON: "),
        ('{"places": [[1, 2, 1]], "places": [[9, 9, 1]]}', "'places' is twice"),
    ],
)
def test_a_refusal_said_what_a_body_holds_and_not_where_it_is_wrong(served, body, where):
    status, answer, _ = served.post(body)
    assert status == 422 and json.loads(answer)["detail"].startswith(where)


def test_no_page_loads_scripts_from_elsewhere(served):
    status, page, _ = served.get("/docs")
    assert status == 200 and b"POST /predict" in page and b"places" in page
    assert not [word for word in (b"<script", b"http:", b"https:", b"<link") if word in page]
    assert served.get("/redoc")[0] == 404


def test_routes_had_no_schema_of_their_bodies(served):
    paths = json.loads(served.get("/openapi.json")[1])["paths"]
    content = paths["/predict"]["post"]["requestBody"]["content"]
    assert {*content} == {"application/json", RAW}
    assert {*content["application/json"]["schema"]["properties"]} == {"places", "std"}
    assert {*paths} == {"/predict", "/healthz", "/readyz", "/metrics", "/docs"} - {"/docs"} | {
        "/docs"
    }


def test_requests_are_counted_by_path_and_status(powers):
    with Served(powers, token="word") as served:
        assert served.post(as_json([[1, 2, 1]] * 3), authorization="Bearer word")[0] == 200
        assert served.post("{", authorization="Bearer word")[0] == 422
        assert served.get("/a/path/of/a/client")[0] == 401
        text = served.get("/metrics", authorization="Bearer word")[1].decode()
    for path, status in (("/predict", 200), ("/predict", 422), ("other", 401)):
        assert f'gsparc_request_seconds_count{{path="{path}",status="{status}"}} 1.0' in text
    assert "gsparc_places_total 3.0" in text


def test_a_server_whose_model_is_asked_no_more_is_not_ready(powers, monkeypatch):
    monkeypatch.setattr(Batcher, "_next", lambda self: 1 / 0)
    with Served(powers) as served, served.send(b"") as client:
        assert served.get("/readyz")[0] == 200
        body = as_json([[1, 2, 1]])
        head = f"POST /predict HTTP/1.1\r\nHost: a\r\nContent-Length: {len(body)}\r\n\r\n"
        client.sendall((head + body).encode())
        assert served.within(5, lambda: served.get("/readyz")[0] == 503)


@pytest.mark.parametrize(
    "path",
    ["/predict?unit=dBm", "/predict?std=1", "/healthz?std=true", "/healthz?verbose=1", "/?="],
)
def test_what_stands_after_a_question_mark_was_read_nowhere(served, path):
    body = as_json([[1, 2, 1]])
    status, answer = ask_http(
        served.port, "POST", path, body, {"Content-Type": "application/json"}
    )[:2]
    assert status == 422 and b"nothing is read after ?" in answer


@pytest.mark.parametrize(
    "coding, status", [("gzip", 415), ("identity, br", 415), ("Identity", 200)]
)
def test_bodies_that_said_they_are_packed_were_read_as_places(served, coding, status):
    """Twelve bytes of a packed raw body are some place on Earth."""
    heads = {"Content-Type": RAW, "Content-Encoding": coding}
    answer = ask_http(served.port, "POST", "/predict", np.zeros((1, 3), "<f4").tobytes(), heads)
    assert answer[0] == status and (status == 200 or b"Content-Encoding" in answer[1])


@pytest.fixture
def told(tmp_path, monkeypatch):
    """A model's file, the model, and a server of it that is told rows."""
    monkeypatch.setattr(serving, "FILE_S", 0.5)
    path = tmp_path / "m.ckpt"
    fitted(save=path)
    stored = checkpoint.read(path)
    predictor = gsparc.load(stored)
    with Served(predictor, "word", ToldFile(stored, gsparc.load)) as running:
        yield (
            path,
            predictor,
            partial(running.post, **{"path": "/update", "authorization": "Bearer word"}),
        )


ROW = json.dumps({"places": [[1.0, 2.0, 1.0]], "levels": [[-90.0]]})


def test_levels_that_were_measured_change_the_answers_and_are_stored(told):
    path, predictor, post = told
    at = np.random.default_rng(5).uniform([0, 0, 0], [20, 20, 2], (30, 3)).round(3)
    before = predictor.rssi(rx=at)
    rows = {"places": at.tolist(), "levels": [[float(level) - 10] for level in before[:, 0]]}
    rows["levels"][0] = [None]
    assert post(json.dumps(rows), authorization="")[0] == 401
    status, body, _ = post(json.dumps(rows))
    said = json.loads(body)
    assert status == 200 and said["rows"] == [*range(29)] and said["alarms"][0]["kind"] == "offset"
    after = json.loads(post(as_json(at), path="/predict")[1])["values"]
    np.testing.assert_allclose(np.array(after), before - 10, atol=2)
    np.testing.assert_allclose(gsparc.load(path).rssi(rx=at), after)
    assert post(json.dumps({**rows, "levels": rows["levels"][:5]}))[0] == 422
    status, body, _ = post(b'{"places": [[1, 2, 3]]}')
    assert status == 422 and b"levels" in body
    for wrong, says in (
        ('{"places": [], "levels": []}', b"holds nothing"),
        ('{"places": [[1, 2, 1]], "levels": [[-90]], "levels": [[-60]]}', b"'levels' is twice"),
        ('{"places": [[1, 2, 1], [2, 2, 1]], "levels": [[-90], [400]]}', b"row 1: a level"),
        ('{"places": [[1, 2, 1], [2000000, 2, 1]], "levels": [[-90], [-90]]}', b"row 1: 2000 km"),
        ('{"places": [[1, 2, 1], [2, 2, 1]], "levels": [[-90, -90]]}', b"found (1, 2)"),
    ):
        status, body, _ = post(wrong)
        assert status == 422 and says in body, body
    assert post(json.dumps({name: part * 3 for name, part in rows.items()}))[0] == 413
    assert len(gsparc.load(path).rows) == 29
    with pytest.raises(SettingError, match="updates=true: whoever reaches it"):
        build_application(predictor, Limits(), None, ToldFile(checkpoint.read(path), gsparc.load))
    with Served(predictor) as running:
        assert running.post(json.dumps(rows), path="/update")[0] == 404


def test_rows_of_a_key_that_are_posted_twice_are_taken_once(told):
    """A client that tried again after a lost answer told its rows twice."""
    path, predictor, post = told
    rows = {"places": [[1.0, 2.0, 1.0]], "levels": [[-90.0]]}
    for key, status in (("a", 200), ("a", 409), ("b", 200), (None, 200), (None, 200)):
        assert post(json.dumps(rows | ({"key": key} if key else {})))[0] == status
    assert len(predictor.rows) == len(gsparc.load(path).rows) == 4


def test_rows_that_another_process_told_the_file_were_overwritten(told):
    """Of 303 rows 120 were lost, and the server never heard of what it had left of them."""
    path, predictor, post = told
    assert post(ROW)[0] == 200
    with checkpoint.rewriting(path) as file:
        other = gsparc.load(file.stored)
        other.update(rx=[[3.0, 4.0, 1.0]] * 2, rssi=[-70.0] * 2)
        assert post(ROW)[0] == 503  # and the row is not told later: its sender knows
        file.store(versions_extra(other.versions))
    assert post(ROW)[0] == 200
    assert predictor.rows.tolist() == gsparc.load(path).rows.tolist() == [0, 1, 2, 3]

"""Answers over HTTP: many clients, malformed requests, clients that die, a stop after what is under way."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import gsparc
from gsparc.commands.serve import loopback
from gsparc.models import checkpoint

uvicorn = pytest.importorskip("uvicorn", reason="the extra `serve` is not installed")
pytest.importorskip("fastapi", reason="the extra `serve` is not installed")
from gsparc.prediction.serving import RAW, application  # noqa: E402

TX = np.array([3.0, 2, 2])


def fitted(kind="rssi"):
    rng = np.random.default_rng(0)
    rx = rng.uniform([0, 0, 0], [20, 20, 2], (60, 3))
    far = np.linalg.norm(rx - TX, axis=1)
    if kind == "rssi":
        return gsparc.fit(rx=rx, tx=TX, rssi=-40 - 20 * np.log10(far), model="gp")
    csi = (np.exp(-2j * np.pi * 30e6 / 3e8 * far) / far)[:, None, None]
    return gsparc.fit(rx=rx, tx=TX, csi=csi, frequency_hz=30e6, model="complex_gp")


class Served:
    def __init__(self, predictor, most=64, token=None, delay_s=2e-3):
        app = application(predictor, delay_s, most, token)
        self.asked = []
        config = uvicorn.Config(app, port=0, log_level="warning", timeout_graceful_shutdown=5)
        self.server = uvicorn.Server(config)
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

    def post(self, body, kind="application/json", **headers):
        client = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        client.request("POST", "/predict", body, {"content-type": kind, **headers})
        answer = client.getresponse()
        found = answer.status, answer.read(), dict(answer.getheaders())
        client.close()
        return found


def as_json(places):
    return json.dumps({"places": np.asarray(places).tolist()})


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
    client = http.client.HTTPConnection("127.0.0.1", served.port, timeout=20)
    client.request("GET", "/healthz")
    assert json.loads(client.getresponse().read()) == {
        "status": "ok", "kind": "rssi", "model": "gp", "end": "rx", "unit": "dBm"
    }  # fmt: skip


def test_deviations_and_all_stations_in_the_unit_asked_for(powers, served):
    """Of several stations none was served but by name, and no deviation at all."""
    client = http.client.HTTPConnection("127.0.0.1", served.port, timeout=20)
    client.request("POST", "/std", as_json([[5, 5, 1]]))
    said = json.loads(client.getresponse().read())
    assert said["unit"] == "dBm" and said["values"] == powers.std(rx=[[5.0, 5, 1]]).tolist()
    level = -40 - np.arange(60)[:, None] / 9 - [0, 10]
    places = np.random.default_rng(0).uniform(0, 20, (60, 3))
    masts = [[0, 0, 9], [9, 9, 9]]
    several = gsparc.fit(rx=places, station_position=masts, rssi=level, unit="dBW", model="gp")
    with Served(gsparc.Predictor(several.method, several.site, unit="mW")) as running:
        status, body, _ = running.post(as_json(places[:3]))
        _, raw, headers = running.post(places[:3].astype("<f4").tobytes(), RAW)
    said, wanted = json.loads(body), several.rssi(rx=places[:3], unit="mW")
    assert status == 200 and headers["x-unit"] == said["unit"] == "mW" and said["shape"] == [3, 2]
    np.testing.assert_allclose(said["values"], wanted, rtol=1e-5)
    np.testing.assert_allclose(np.frombuffer(raw, "<f4"), wanted.ravel(), rtol=1e-4)


def test_the_level_of_silence_is_null(monkeypatch):
    """JSON has no infinity: the answer was an error of the server."""
    silent = gsparc.fit(rx=np.eye(3), tx=TX, rssi=[-40, -50, -60], model="zero")
    with Served(silent) as running:
        status, body, _ = running.post(as_json([[5, 5, 1], [4, 4, 1]]))
    assert status == 200 and json.loads(body)["values"] == [[None], [None]]


def test_channels_are_pairs():
    predictor = fitted("csi")
    with Served(predictor) as served:
        _, body, headers = served.post(np.array([[5, 5, 1]], "<f4").tobytes(), RAW)
    expected = predictor.csi(rx=[[5.0, 5, 1]])
    assert headers["x-shape"] == "1,1,1,2"
    np.testing.assert_allclose(
        np.frombuffer(body, "<f4"), [expected.real.item(), expected.imag.item()], rtol=1e-4
    )


def test_32_clients_get_their_own_answers_computed_together(powers, monkeypatch):
    rng = np.random.default_rng(2)
    given = [rng.uniform(0, 10, (1 + i % 3, 3)) for i in range(32 * 8)]
    expected = [powers.rssi(rx=places) for places in given]
    calls = []
    own = powers.rssi
    monkeypatch.setattr(powers, "rssi", lambda rx: calls.append(len(rx)) or own(rx=rx))
    with Served(powers) as served, ThreadPoolExecutor(32) as clients:
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


def test_one_bad_request_of_a_batch_spoils_no_other(powers):
    with Served(powers, delay_s=0.3) as served, ThreadPoolExecutor(2) as clients:
        good = clients.submit(served.post, as_json([[1, 2, 1]]))
        bad = clients.submit(served.post, as_json([[1, 2, 1e300]]))
        assert (good.result()[0], bad.result()[0]) == (200, 422)


def test_a_client_that_dies_is_no_matter(powers, caplog):
    with Served(powers) as served:
        for sent in (
            b"POST /predict HTTP/1.1\r\nhost: a\r\ncontent-length: 500\r\n\r\n{",
            b"POST /predict HTTP/1.1\r\nhost: a\r\ncontent-length: 25\r\n\r\n" + b'{"places": [[1, 2, 1.5]]}',
            b"nonsense\r\n\r\n",
        ):
            for _ in range(8):
                with socket.create_connection(("127.0.0.1", served.port)) as client:
                    client.sendall(sent)
        assert served.post(as_json([[1, 2, 1]]))[0] == 200
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


def test_a_token_is_asked_for(powers):
    with Served(powers, token="secret") as served:
        assert served.post(as_json([[1, 2, 1]]))[0] == 401
        assert served.post(as_json([[1, 2, 1]]), authorization="Bearer wrong")[0] == 401
        assert served.post(as_json([[1, 2, 1]]), authorization="Bearer secret")[0] == 200


def test_others_reach_what_is_no_loopback():
    assert [loopback(host) for host in ("::1", "localhost", "0.0.0.0", "example.org")] == [1, 1, 0, 0]


@pytest.mark.slow
def test_the_command_serves_until_it_is_told_to_stop(powers, tmp_path):
    checkpoint.save(tmp_path / "model.ckpt", powers.method)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    line = [
        sys.executable,
        "-m",
        "gsparc",
        "serve",
        f"ckpt={tmp_path}/model.ckpt",
        f"port={port}",
        "delay_ms=1000",
    ]
    served = subprocess.Popen(line, cwd=tmp_path, env={**os.environ, "OMP_NUM_THREADS": "1"})
    try:
        client = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        for _ in range(300):
            try:
                client.request("POST", "/predict", as_json([[1, 2, 1]]), {"content-type": "application/json"})
                break
            except OSError:
                client.close()
                time.sleep(0.2)
        time.sleep(0.3)
        served.send_signal(signal.SIGTERM)  # while the request waits for others
        assert client.getresponse().status == 200
        assert served.wait(20) in (0, -signal.SIGTERM)
    finally:
        served.kill()
        served.wait()

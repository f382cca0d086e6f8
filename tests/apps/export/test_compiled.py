"""Fields exported for C answer as the model does, from any number of threads;
what is damaged is refused.
"""

import copy
import importlib.util
import os
import signal
import subprocess
import sys
import time
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import campaigns
import field_files
import numpy as np
import pytest
import torch
from refusals import refused
from releases import release
from rooms import directed

import gsparc
from gsparc.apps.export.compiled import make
from gsparc.apps.export.compiled.blob import CHECKED, HEAD, Form, pack_form
from gsparc.commands import export
from gsparc.commands.train import train
from gsparc.data.assemble import FARTHEST
from gsparc.data.query import Query
from gsparc.models import checkpoint
from gsparc.models.channels.field import ChannelField
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.directional.position_refine import UncertainPositions
from gsparc.models.image_sources.clutter.blocking import Clutter
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.mixture.methods import ImageSources
from gsparc.models.terms import EffectSettings
from gsparc.prediction.predictor import Predictor
from gsparc.processes import powers
from gsparc.training.context import FitContext

ROOT = Path(__file__).parents[3]
SOURCES, EXAMPLES = ROOT / "ops" / "csrc" / "field", ROOT / "examples" / "c-library"
LIGHT, PLACES, SCALE = 299_792_458.0, int(os.environ.get("GSPARC_PLACES", "400")), 1e-5
FUZZ_S = int(os.environ.get("GSPARC_FUZZ_S", "10"))


def of_powers(count, model="gp", **settings):
    """About a distance law, far from the world's origin."""
    rng = np.random.default_rng(0)
    tx, rx = np.array([103.0, 52.0, 2.5]), rng.uniform([100, 50, 0], [130, 75, 2], (count, 3))
    far = np.linalg.norm(rx - tx, axis=1)
    level = -40 - 22 * np.log10(far) + 3 * np.sin(rx[:, 0] - 100) + rng.normal(0, 1, count)
    return gsparc.fit(rx=rx, tx=tx, rssi=level, model=model, settings=settings)


def of_sources(tones, antennas=1, clutter=False):
    """A line of sight and a wall."""
    rng = np.random.default_rng(1)
    tx, rx = np.array([4.0, 2.5, 2.2]), rng.uniform([0, 0, 0.5], [5, 4, 2], (40, 3))
    frequency = 2.4e9 + 1e6 * np.arange(tones)
    array = np.c_[0.05 * np.arange(antennas), np.zeros((antennas, 2))]
    heard = rx[:, None] + array
    far = np.stack([np.linalg.norm(heard - place, axis=-1) for place in (tx, tx * [-1, 1, 1])])[
        ..., None
    ]
    csi = (np.exp(-2j * np.pi * frequency / LIGHT * far) / far).sum(0)
    given = {} if antennas == 1 else {"array_position": array}
    settings = {"searches": 1, "clutter": clutter, "search_rows": 80}
    return gsparc.fit(
        rx=rx,
        tx=tx,
        csi=csi,
        frequency_hz=frequency,
        model="image_source_gp",
        settings=settings,
        effort=0.3,
        rx_rotation=np.eye(3),
        **given,
    )


def hidden(predictor):
    """The same sources, as two searches that disagree: behind a box, and in a mirror that ends."""
    method = copy.copy(predictor.method)
    scene = method.members[0].scene
    middle = method.frame.middle.float()
    box = torch.cat(
        [torch.tensor([3.0, 1.5, 0.0]) - middle, torch.tensor([3.4, 2.0, 2.0]) - middle]
    )
    whole = replace(scene, clutter=Clutter.empty().add_box(box))
    mirror = Clutter.empty().add_patch(torch.tensor([-1.0, -1.2, 1.5, 0.4]), 0)
    # Legs that padded the shorter search hid its source near the box.
    ended = replace(whole, clutter=Clutter(box[None], mirror.patches, mirror.plane))
    scenes = [ended, whole.select_sources([0])]
    method._set_posteriors(method.members[0].rows, scenes)
    method.weights = torch.tensor([0.7, 0.3])
    return Predictor(method, predictor.site)


def of_directions(blurred=False, **room):
    """Sources where measured directions cross, some hidden, some of uncertain places."""
    data, fold, _ = directed(60, pillar=True, **room)
    method = DirectionalGP(rows=200)
    method.fit(data, fold, FitContext(Path()))
    if blurred:
        known = method.posterior.positions
        spread = (
            known.covariance
            + 1e-3 * torch.eye(3) * (torch.arange(len(known.points)) % 2)[:, None, None]
        )
        uncertain = UncertainPositions(known.points, spread)
        method.posterior = replace(method.posterior, positions=uncertain).precompute()
        assert 0 < len(method.posterior.incoherent) < len(known.points)
    return Predictor(method, data.site)


def of_a_mean():
    """Of measured directions and of a search, as the default weighs them."""
    predictor = of_directions()
    data, fold, _ = directed(60, pillar=True)
    search = ImageSourceGP(searches=1, search_rows=60)
    search.fit(data, fold, FitContext(Path(), effort=0.3))
    method = ImageSources()
    method.site, method.members = data.site, [predictor.method, search]
    method.weights, method.doubt = (0.6, 0.4), 1.3
    return Predictor(method, data.site)


def of_images(model, **settings):
    """Of 18 x 36 pixels with two lobes."""
    rng = np.random.default_rng(2)
    rx, tx = np.array([2.0, 1.0, 1.0]), rng.uniform([0, 0, 0.5], [4, 3, 2], (40, 3))
    column = np.arctan2(*(tx - rx)[:, 1::-1].T)[:, None, None] + np.pi
    rows, columns = np.meshgrid(np.arange(18), np.arange(36) / 18 * np.pi, indexing="ij")
    lobes = np.exp(4 * np.cos(columns - column) - 4 - (rows - 5) ** 2 / 20) * 0.8 + 0.1
    return gsparc.fit(rx=rx, tx=tx, spectrum=lobes, model=model, settings=settings)


def of_an_array(folder):
    """Spectra of the release; with the averaged process the form is distilled."""
    settings = (
        "model.effects.residual=false",
        "dataset=rfid",
        f"dataset.root={release('rfid-s23-160')}",
        "model=gsparc",
        "baselines=[]",
        "logger=none",
    )
    train(campaigns.compose(*settings), folder)
    return gsparc.load(folder / "model.ckpt")


def built(folder, *options):
    for command in (
        ["cmake", "-S", SOURCES, "-B", folder, "-DCMAKE_BUILD_TYPE=Release", *options],
        ["cmake", "--build", folder],
    ):
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=600)
    return folder / "libgsparc_field.so"


def driver(library, *options):
    out = library.with_name("driver")
    source = ROOT / "tests" / "helpers" / "driver.cpp"
    linked = ["-L", library.parent, "-lgsparc_field", f"-Wl,-rpath,{library.parent}"]
    given = [
        "g++",
        "-O1",
        "-std=c++17",
        "-pthread",
        *options,
        source,
        "-I",
        SOURCES,
        *linked,
        "-o",
        out,
    ]
    subprocess.run(given, check=True, capture_output=True, text=True, timeout=300)
    return out


@pytest.fixture(scope="session")
def library(tmp_path_factory):
    return built(tmp_path_factory.mktemp("library"))


@pytest.fixture(scope="session")
def example():
    spec = importlib.util.spec_from_file_location("field", EXAMPLES / "field.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_form_says_what_it_is_and_its_file_is_checked(tmp_path):
    predictor = of_powers(60)
    found = make.compile_model(predictor)
    assert (found.form.kind, found.error) == (4, 0) and found.summary == (
        "a process of powers, exactly"
    )
    blob = pack_form(found.form, predictor.site.origin, found.error)
    magic, version, checksum, size, _ = HEAD.unpack(blob[: HEAD.size])
    assert (magic, version, size) == (b"GSPARC\r\n", 4, len(blob))
    assert checksum == zlib.crc32(blob[CHECKED:])


def test_more_members_than_the_library_holds_were_packed():
    process = of_powers(60).method.powers
    for count, packs in ((7, True), (8, False)):
        many = replace(process, others=((0.1, replace(process, others=())),) * count)
        assert (make.compile_powers(many, 1.0) is not None) == packs


def test_channels_without_sources_and_stations_are_refused_in_one_line():
    rng = np.random.default_rng(0)
    rx, csi = rng.uniform(size=(20, 3)), rng.normal(size=20) + 1j
    waves = gsparc.fit(rx=rx, tx=[3.0, 2, 1], csi=csi, frequency_hz=2.4e9, model="complex_gp")
    fault = r": channels that are no sum of sources have no compiled form; take model=[^\n]*$"
    refused("^complex_gp" + fault, make.compile_model, waves)
    # Whatever else is in a mean: each member answers.
    mean = ImageSources()
    mean.members, mean.weights = [ChannelField()], (1.0,)
    refused(
        "^image_sources" + fault, make.compile_model, SimpleNamespace(method=mean, site=waves.site)
    )
    refused(
        r"^gp: of spectra only rendered Gaussians can be compiled",
        make.compile_model,
        of_images("gp"),
    )
    moving = SimpleNamespace(method=waves.method, site=replace(waves.site, static_end=None))
    refused(
        r"^to=c: channels and spectra of two moving ends .* stands still$",
        make.compile_model,
        moving,
    )


MODELS = {
    "powers, all rows": partial(of_powers, 300),
    "powers, variance of the nearest": partial(of_powers, 1500),
    "powers, the nearest": partial(of_powers, 700),
    "powers, a mean of processes": partial(of_powers, 120, "gsparc"),
    "powers, distilled": partial(of_powers, 80, "idw"),
    "sources": partial(of_sources, 1),
    "sources, many tones": partial(of_sources, 40),
    "sources, four antennas": partial(of_sources, 7, 4),
    "sources, hidden": lambda: hidden(of_sources(3, 4)),
    "directions": partial(of_directions, tones=5, array=0.06 * np.eye(4, 3)),
    "directions, uncertain": partial(of_directions, True, tones=3),
    "directions and sources": of_a_mean,
    "image of Gaussians": partial(of_images, "gsparc", effects=EffectSettings(residual=False)),
    "array": None,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_the_library_answers_as_the_model(name, library, example, tmp_path, monkeypatch):
    """At random places to 1e-5 of the scale, with variance and unknown share."""
    monkeypatch.setattr(powers, "MOST_ROWS", 500 if name == "powers, the nearest" else 6000)
    torch.set_num_threads(1)
    predictor = MODELS[name]() if MODELS[name] else of_an_array(tmp_path)
    site, found = predictor.site, make.compile_model(predictor)
    assert (found.error > 0) == ("distilled" in name), found.summary
    path = tmp_path / "field.gsparc"
    path.write_bytes(pack_form(found.form, np.asarray(site.origin), found.error))
    field, places = example.Field(path, library), make.random_places(site, PLACES, 3)
    answers = [field(place.astype(np.float64) + site.origin) for place in places]
    own = np.stack([one[0] for one in answers])
    expected = make.ask_model(found.form.predictor or predictor, places).reshape(own.shape)
    told = site.kind != "spectrum" and not found.error
    if told:
        # Channels in float64: Python's float32 is further from it than the library is.
        whole = torch.float64 if site.target.is_complex else torch.float32
        rx = torch.from_numpy(places).to(whole)
        tx = torch.tensor(site.static_position).to(whole).expand(len(rx), 3)
        with torch.no_grad():
            said = predictor.method.predict(Query(tx, gsparc.ops.Pose.identity(rx)))
        if site.target.is_complex:
            expected = said.mean.numpy() * site.target_scale
    assert field.facts.error == found.error
    scale = np.sqrt(np.mean(np.abs(expected) ** 2))
    # Soft edges are 2 cm wide, and phases of uncertain places many turns: five digits are left.
    least = SCALE * (50 if "hidden" in name or "uncertain" in name else 1)
    assert np.abs(own - expected).max() < least * scale
    if told:
        variance, unknown = (np.array(part) for part in list(zip(*answers, strict=True))[1:])
        # Of channels few combinations of rows tell: a little more is left in the mean.
        near, apart = (1e-4, 1e-5) if site.kind == "rssi" else (0.1, 0.02)
        np.testing.assert_allclose(variance, said.variance * site.target_scale**2, rtol=near)
        np.testing.assert_allclose(unknown, said.unknown, atol=apart)
    else:
        assert np.isnan([one[1] for one in answers]).all()
    field.close()


def damaged(blob, draw):
    """One to four bytes otherwise, or an end cut off."""
    found = bytearray(blob)
    for at in draw.integers(0, len(blob) if draw.random() < 0.5 else 600, draw.integers(1, 5)):
        found[at] ^= int(draw.integers(1, 256))
    return bytes(found[: draw.integers(len(found))] if draw.random() < 0.2 else found)


def files(folder, count, make_one, seed=0):
    """Of `make_one(draw)`."""
    draw, names = np.random.default_rng(seed), [folder / f"{number}" for number in range(count)]
    for name in names:
        name.write_bytes(make_one(draw))
    return names


@pytest.mark.slow
def test_threads_agree_nothing_is_allocated_and_damage_is_refused(library, tmp_path):
    predictor = of_powers(100)
    blob = pack_form(make.compile_model(predictor).form, predictor.site.origin, 0.0)
    path = tmp_path / "field.gsparc"
    path.write_bytes(blob)
    run = partial(subprocess.run, capture_output=True, text=True, check=True, timeout=300)
    asked = driver(library)
    # Of a tenth two threads' collision was often missed
    said = run([asked, path, "8", "10000000"]).stdout
    assert said.split() == ["queries", "10000000", "wrong", "0", "allocations", "0"]
    cut = files(tmp_path, 1000, partial(damaged, blob))
    assert run([asked, *cut]).stdout.split() == ["refused", "1000"]


@pytest.mark.slow
def test_sizes_whose_product_left_32_bits_were_written_beyond(library, example, tmp_path):
    """65,536 x 65,536 entries: none in 32 bits: no factors were needed, and answers had no room."""
    rest = [1, 0, 0, 0, 0, 0, 0, 0, 0]  # a search; no variance, nothing that hides
    kernel = [1.0, 1e9, 1e9, 0.5, 0.5, 0.5, 0.1, 1.0]
    sizes = [1, 1, 65536, 65536, 1, 1, *rest]
    arrays = {
        name: np.ones(count)
        for name, count in field_files.needed(3, sizes).items()
        if name != "factors"
    }
    double = ("moving", "sources", "images", "combs", "offsets")
    arrays = {
        name: value.astype("f8" if name in double else "i4" if name == "counts" else "f4")
        for name, value in arrays.items()
    }
    form = Form(3, [*map(float, sizes), *kernel], arrays | {"middle": np.zeros(3)})
    (path := tmp_path / "field.gsparc").write_bytes(pack_form(form, np.zeros(3)))
    refused("factors is missing", example.Field, path, library)
    arrays = arrays | {"middle": np.zeros(3), "factors": np.ones(2 << 20, "f4")}
    sizes = [1, 1, 1, 1 << 20, 1, 1, *rest]
    needed = field_files.needed(3, sizes).items()
    fits = {name: np.resize(arrays[name], count) for name, count in needed if count}
    fits |= {"middle": np.zeros(3), "combs": np.array([1e9, 1e6, 1e5])}
    path.write_bytes(pack_form(Form(3, [*map(float, sizes), *kernel], fits), np.zeros(3)))
    refused("an answer of 209715200000 numbers", example.Field, path, library)


@pytest.mark.slow
def test_places_that_python_refuses_were_answered_by_the_library(library, example, tmp_path):
    predictor = of_powers(60)
    path = tmp_path / "field.gsparc"
    path.write_bytes(pack_form(make.compile_model(predictor).form, predictor.site.origin))
    field = example.Field(path, library)
    for place in ([FARTHEST * 1.01, 0, 0], [0, 0, -2 * FARTHEST], [0, np.nan, 0]):
        refused("status 1", field, np.array(place))
        refused(r"^rx= holds", predictor.rssi, rx=place)
    field(np.array([FARTHEST * 0.99, 0, 0]))
    field.close()


@pytest.mark.slow
def test_the_stated_error_missed_the_metres_under_a_station(monkeypatch):
    """Of 256 draws over 400 x 400 m none was there; and it was linear,
    which a few strong places decide.
    """
    monkeypatch.setattr(make, "ANSWERED", 1500)
    rng, tx = np.random.default_rng(0), np.array([200.0, 200, 3])
    rx = rng.uniform([0, 0, 0], [400, 400, 2], (300, 3))
    level = -40 - 20 * np.log10(np.linalg.norm(rx - tx, axis=1))
    predictor = gsparc.fit(rx=rx, tx=tx, rssi=level, model="idw")
    found = make.compile_model(predictor, 4096)
    assert (
        found.form.predictor is not None
        and "RMSE dB" in found.summary
        and "at the worst" in found.summary
    )
    places = make.random_places(predictor.site, 3_000, 9)
    own, whole = (make.ask_model(one, places)[:, 0] for one in (found.form.predictor, predictor))
    apart = 10 * np.log10(own / whole)
    assert found.error == pytest.approx(np.sqrt(np.mean(apart**2)), rel=0.1)
    assert found.worst > 0.7 * np.abs(apart).max()
    near = make.near_places(predictor.site, 400, 1) - predictor.site.static_position
    assert np.median(np.linalg.norm(near[:, :2], axis=1)) < 10


@pytest.mark.slow
@pytest.mark.timeout(900 + FUZZ_S)
@pytest.mark.parametrize("portable", ["OFF", "ON"])
def test_sanitizers_see_nothing(tmp_path, portable, capsys):
    """Sound files, and those with several fields changed whose checksums are right: refused, or
    answered from within. `GSPARC_FUZZ_S=3600`: for an hour."""
    library = built(tmp_path / "library", "-DGSPARC_SANITIZE=ON", f"-DGSPARC_PORTABLE={portable}")
    asked = driver(library, "-fsanitize=address,undefined", "-DGSPARC_WATCHED")
    models = (of_powers(60), of_powers(40, "idw"), of_sources(5), hidden(of_sources(3, 4)))
    models += (of_directions(True), of_a_mean())
    forms = [
        field_files.an_array(),
        *(make.compile_model(predictor, 64).form for predictor in models),
    ]
    until, seed, slow, refused = time.monotonic() + FUZZ_S, 0, 0, 0
    while seed < 2 or time.monotonic() < until:
        for number, form in enumerate(forms):
            (sound := tmp_path / "sound").write_bytes(pack_form(form, np.zeros(3)))
            given = [
                sound,
                *files(tmp_path, 100, partial(field_files.mutated, form), (seed, number)),
            ]
            found = subprocess.run([asked, *given], capture_output=True, text=True, timeout=300)
            slow += found.returncode == -signal.SIGALRM
            assert found.returncode in (0, -signal.SIGALRM), (seed, number, found.stderr[-2000:])
            if not found.returncode:
                refused += int(found.stdout.split()[1])
                assert int(found.stdout.split()[1]) < len(given)  # the sound one was answered
        seed += 1
    with capsys.disabled():
        sys.stderr.write(f"{seed * len(forms) * 100} files, {refused} refused, {slow} slow\n")


@pytest.mark.slow
def test_the_command_writes_a_folder_whose_library_and_example_build(tmp_path, monkeypatch):
    predictor, path, out = of_powers(60), tmp_path / "model.ckpt", tmp_path / "out"
    checkpoint.save(path, predictor.method)
    monkeypatch.setattr("gsparc.runs.output.run_directory", lambda: tmp_path)
    config = campaigns.compose(f"ckpt={path}", f"out={out}", config="export")
    facts = export.task(config)
    assert (
        facts["export/error"] == 0
        and (out / "field.gsparc").stat().st_size == facts["export/bytes"]
    )
    refused("is there already", export.task, config)
    for command in (
        ["cmake", "-S", out / "source" / "field", "-B", out / "build", "-DGSPARC_PORTABLE=ON"],
        ["cmake", "--build", out / "build"],
        [
            "cc",
            EXAMPLES / "query.c",
            "-I",
            out,
            "-L",
            out / "build",
            "-lgsparc_field",
            f"-Wl,-rpath,{out / 'build'}",
            "-lm",
            "-o",
            tmp_path / "query",
        ],
    ):
        subprocess.run(command, check=True, capture_output=True, timeout=300)
    query = [tmp_path / "query", out / "field.gsparc", "110", "60", "1"]
    said = subprocess.run(query, check=True, capture_output=True, text=True).stdout
    expected = float(predictor.rssi(rx=[110.0, 60, 1], unit="linear")[0])
    assert float(said.split("first value ")[1].split(",")[0]) == pytest.approx(expected, rel=1e-4)

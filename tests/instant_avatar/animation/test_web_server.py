"""The avatar in a browser: served, written to a folder, and driven as a person would."""

import hashlib
import http.client
import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from export import player_page
from export.package.package_file import read_package
from export.player import PictureDifference, Player, premultiply
from export.player_inputs import graph_initializers
from instant_avatar.animation import web_server
from instant_avatar.animation.driving_motion import FollowingCamera, demo_motion
from instant_avatar.animation.web_server import sample_motions
from preprocess.poses.pose_format_registry import read_poses
from tests.instant_avatar.browser import Browser, in_browser, serving, until, with_runtime

EXAMPLES = Path(__file__).parents[3] / "examples"
SIZE = (900, 700)
STAGE = (slice(60, 600), slice(4, -4))
"""Between the page's head and its bar, inside of the ring that marks the focus."""


@pytest.fixture(scope="module")
def served(package, novel):
    """Where ia-play --web says that the page is."""
    command = [sys.executable, "-m", "instant_avatar.play", package, "--poses", novel, "--web"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    address = process.stdout.readline().strip()
    yield address
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=30.0) == 0
    process.stdout.close()


@pytest.fixture(scope="module")
def page(served, tmp_path_factory):
    """The page, open and playing."""
    with Browser(tmp_path_factory.mktemp("browser"), size=SIZE) as browser:
        browser.emulate(scheme="light", size=SIZE)
        browser.go(served)
        until(lambda: browser.run("!!window.player"), 120.0)
        yield browser


def drawn(browser):
    """Where the stage is not empty."""
    picture = browser.picture()[STAGE].astype(int)
    return np.abs(picture - picture[0, 0]).max(axis=2) > 24


def paused(browser):
    if browser.run("document.getElementById('play').classList.contains('playing')"):
        browser.press(" ")
    until(lambda: not moves(browser), 30.0)


def moves(browser):
    """Whether two looks at the stage, half a second apart, differ."""
    before = browser.picture()[STAGE]
    browser.run("new Promise((done) => setTimeout(done, 500))")
    return bool((browser.picture()[STAGE] != before).any())


def test_only_this_machine_is_answered():
    def asked(path, **headers):
        line = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
        line.request("GET", path, headers=headers)
        with line.getresponse() as answer:
            answer.read()
        line.close()
        return answer

    with serving({"index.html": b"page", "page.js": b"script"}, 8370) as address:
        port = int(re.fullmatch(r"http://127\.0\.0\.1:(\d+)", address).group(1))
        assert asked("/").headers["Content-Type"] == "text/html; charset=utf-8"
        assert asked("/page.js").headers["Content-Type"] == "text/javascript; charset=utf-8"
        assert asked("/../pyproject.toml").status == 404
        assert asked("/", Host="example.org").status == 403
        with pytest.raises(ConnectionRefusedError):
            http.client.HTTPConnection("127.0.0.2", port, timeout=5.0).connect()


@in_browser
@pytest.mark.parametrize("subdivision", [1, 2])
def test_the_browser_decodes_the_tables_that_python_decodes(page, package, subdivision):
    found = page.run(
        f"""(async () => {{
          const {{ decodeTables }} = await import("./package.js");
          const names = {{}}, entries = player.entries, hashes = {{}};
          for (const entry of Object.keys(entries)) {{
            const [, name] = /^hq\\/(\\w+)\\.bin$/.exec(entry) ?? [];
            if (name) names[name] = await entries[entry]();
          }}
          const tables = decodeTables(names, player.avatar.tiers.hq.layout, {subdivision});
          for (const [name, table] of Object.entries(tables)) {{
            const hash = new Uint8Array(await crypto.subtle.digest("SHA-256", table));
            hashes[name] = [...hash].map((byte) => byte.toString(16).padStart(2, "0")).join("");
          }}
          return hashes;
        }})()""",
        seconds=120.0,
    )
    held = read_package(package)
    settings = replace(held.manifest.tiers["hq"].settings, skinning_subdivision=subdivision)
    expected = graph_initializers(held.tables["hq"], settings)
    assert found == {
        name: hashlib.sha256(table.tobytes()).hexdigest() for name, table in expected.items()
    }


def shown_by(page, tier, row, view):
    """What the page draws of a row of its motion, premultiplied."""
    width, height = view.size_px
    camera = {
        "focal": view.focal_px,
        "center": view.center_px,
        "width": width,
        "height": height,
        "cameraFromWorld": view.camera_from_world[:3].ravel().tolist(),
    }
    part = page.run(
        f"""(async () => {{
          await player.open({{ tier: "{tier}" }}, true);
          const pose = player.pose({row});
          const part = await player.draw({{ tier: "{tier}" }}, pose, {json.dumps(camera)});
          return {{ ...part, rgba: Array.from(part.rgba) }};
        }})()""",
        seconds=120.0,
    )
    rows = slice(part["y"], part["y"] + part["height"])
    columns = slice(part["x"], part["x"] + part["width"])
    shown = np.zeros((height, width, 4), dtype=np.uint8)
    shown[rows, columns] = np.reshape(part["rgba"], (part["height"], part["width"], 4))
    return premultiply(shown)


@in_browser
def test_the_browser_draws_what_the_player_draws(page, package, novel):
    motion, row, size = read_poses(novel), 7, 96
    for tier in ("hq", "lite"):
        player = Player.load(package, tier=tier)
        view = FollowingCamera.of(player, motion, size).camera_for(motion[row])
        expected = premultiply(player.render(motion[row], view))
        assert expected[..., 3].max() == 1.0
        if tier == "lite":  # the first picture is that of the coarse graph
            first = PictureDifference.of(shown_by(page, tier, row, view), expected)
            assert first.psnr > 25.0
            assert not first.matches
        assert PictureDifference.of(shown_by(page, tier, row, view), expected).matches


@in_browser
def test_the_page_plays_pauses_turns_and_zooms(page):
    until(lambda: moves(page), 30.0)
    paused(page)
    front = drawn(page)
    page.run("document.activeElement.blur()")
    for _ in range(3):
        page.press("ArrowLeft")  # also where nothing was clicked
    until(lambda: (drawn(page) != front).mean() > 0.01, 30.0)
    page.press("Home")
    until(lambda: np.array_equal(drawn(page), front), 30.0)
    page.run("document.getElementById('picture').focus()")
    rows, columns = np.flatnonzero(front.any(axis=1)), np.flatnonzero(front.any(axis=0))
    assert len(rows) > 0.6 * front.shape[0]  # a person upright in the middle
    assert abs(columns.mean() - SIZE[0] / 2.0) < 0.1 * SIZE[0]
    page.drag((450, 300), (300, 300))
    until(lambda: (drawn(page) != front).mean() > 0.01, 30.0)
    until(lambda: not moves(page), 30.0)
    turned = drawn(page)
    for _ in range(4):
        page.press("+")
    until(lambda: drawn(page).mean() > 1.3 * turned.mean(), 30.0)
    page.press("Home")
    until(lambda: np.array_equal(drawn(page), front), 30.0)
    before = page.run("Number(document.getElementById('timeline').value)")
    page.press(".")
    after = (before + 1) % 12
    until(lambda: page.run("Number(document.getElementById('timeline').value)") == after, 30.0)


@in_browser
def test_a_motion_plays_once_it_is_chosen_beside_the_given_one(page):
    def choose(file, count):
        page.run(
            f"""(() => {{
              const motions = document.getElementById("motions");
              motions.value = "{file}";
              motions.dispatchEvent(new Event("change"));
            }})()"""
        )
        until(lambda: page.run("player.count") == count, 30.0)

    given = page.run("player.count")
    paused(page)
    for file, motion in list(sample_motions().items())[1:]:
        choose(f"{file.lower()}.npz", len(motion))
        until(lambda: moves(page), 30.0)
        assert page.run("Number(document.getElementById('timeline').max)") == len(motion) - 1
    choose("motion.npz", given)


@in_browser
def test_the_page_is_dark_for_those_who_like_it_and_fits_a_phone(page):
    paused(page)
    page.emulate(scheme="dark", size=(390, 700))
    try:
        until(lambda: not moves(page), 30.0)
        until(lambda: page.picture()[70, 10].max() < 60, 30.0)
        assert page.run("document.documentElement.scrollWidth") <= 390
        assert 0.03 < drawn(page).mean() < 0.5
    finally:
        page.emulate(scheme="light", size=SIZE)
    until(lambda: page.picture()[70, 10].min() > 200, 30.0)


@in_browser
@pytest.mark.parametrize("size", [(640, 300), (390, 700)])
def test_the_person_stands_above_the_bar_however_low_the_screen(page, size):
    paused(page)
    page.emulate(scheme="light", size=size)
    try:
        until(lambda: not moves(page), 30.0)
        feet, bar = page.run(
            """(() => {
              const canvas = document.getElementById("picture").canvas;
              const { width, height, clientHeight } = canvas;
              const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
              let last = 0;
              for (let i = 3; i < data.length; i += 4) if (data[i] > 127) last = i;
              const row = Math.floor(last / 4 / width);
              const bar = document.getElementById("bar").getBoundingClientRect();
              return [(row / height) * clientHeight, bar.top];
            })()"""
        )
    finally:
        page.emulate(scheme="light", size=SIZE)
    assert 0.5 * bar < feet < bar


@in_browser
def test_what_is_too_near_for_surfels_is_drawn_with_fewer_pixels(page):
    far, near, beside = page.run(
        """(async () => {
          const { Orbit } = await import("./orbit.js");
          const orbit = new Orbit(player.avatar.look), pose = player.pose(0);
          const camera = () => orbit.camera(pose, 2000, 2000);
          const width = () => player.drawable({ tier: "hq" }, pose, camera()).width;
          const far = width();
          orbit.nearer(100);
          const near = width();
          orbit.shift(0, -1e6, 2000, 2000);
          return [far, near, width()];
        })()"""
    )
    assert far == beside == 2000
    assert 500 < near < 1800


def edited_page(package, file, before, after):
    """A page of its own with another number in a script."""
    motions = {"Turn": player_page.encode_motion(demo_motion(), 30.0)}
    page = player_page.build_page(package, motions, name="x", compression_level=1)
    assert page[file].count(before) == 1
    return page | {file: page[file].replace(before, after)}


@in_browser
@pytest.mark.parametrize(
    ("isolated", "cores", "pays", "threads"),
    [(True, 6, 1e9, 3), (True, 6, 0, 1), (True, 2, 1e9, 1), (False, 6, 1e9, 1)],
)
def test_an_isolated_page_draws_with_more_threads_where_they_pay(
    package, tmp_path, monkeypatch, isolated, cores, pays, threads
):
    page = edited_page(package, "engine.js", b"PAYS = 0.8", f"PAYS = {pays}".encode())
    quick = 0 if threads > 1 else 1e9  # the page tries by itself, or the test makes it
    edited = page["playback.js"].replace(b"QUICK_MS = 45", f"QUICK_MS = {quick}".encode())
    assert edited != page["playback.js"]
    page["playback.js"] = edited
    if not isolated:
        monkeypatch.delitem(web_server.HEADERS, "Cross-Origin-Embedder-Policy")
    with serving(page, 8098) as address, Browser(tmp_path, size=(360, 400)) as browser:
        browser.emulate(scheme="light", size=(360, 400))
        browser.claim_cores(cores)
        browser.go(f"{address}/?start=hq")
        until(lambda: browser.run("!!window.player"), 120.0)
        assert browser.run("crossOriginIsolated") is isolated
        if threads == 1:
            assert browser.run("player.engine.spread()", seconds=120.0) is False
        until(lambda: browser.run("player.engine.graphs.threads") == threads, 120.0)
        until(lambda: browser.worker_threads() == 1 + threads, 60.0)
        found = browser.run("player.verify()", seconds=240.0)
        assert found, "no golden frames"
        assert all(frame["alike"] for frame in found), found


@in_browser
def test_full_replaces_lite_without_a_word_where_the_device_is_fast(package, tmp_path):
    page = edited_page(package, "playback.js", b"QUICK_MS = 45", b"QUICK_MS = 1e9")
    with serving(page, 8095) as address, Browser(tmp_path, size=(360, 400)) as browser:
        browser.emulate(scheme="light", size=(360, 400))
        browser.go(f"{address}/?start=lite")
        chosen = "document.querySelector('#tiers input:checked')?.value"
        until(lambda: browser.run(chosen) == "lite", 60.0)
        assert browser.run("document.getElementById('status').hidden")
        until(lambda: browser.run(chosen) == "hq", 120.0)
        assert browser.run("document.getElementById('status').hidden")


@in_browser
def test_nothing_came_from_anywhere_else(page, served):
    names = page.run("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert len(names) > 5
    assert all(name.startswith(served + "/") for name in names)


@in_browser
def test_the_folder_plays_below_any_address(call_play, package, tmp_path):
    """Python's own server stands for any static host; without --poses the avatar turns round."""
    out = tmp_path / "host" / "people" / "actor"
    outcome = call_play(package, "--web", "--out", out)
    assert outcome.code == 0
    host = [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1"]
    with subprocess.Popen(
        host, cwd=tmp_path / "host", stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        address = re.search(r"http://\S+", process.stdout.readline()).group(0)
        try:
            with Browser(tmp_path / "browser", size=SIZE) as browser:
                browser.emulate(scheme="light", size=SIZE)
                browser.go(f"{address.rstrip('/').rstrip(')')}/people/actor/")
                until(lambda: browser.run("!!window.player"), 120.0)
                until(lambda: drawn(browser).mean() > 0.03, 60.0)
                paused(browser)
                until(
                    lambda: browser.run("document.getElementById('picture').playback.sharp"), 30.0
                )
                until(lambda: not moves(browser), 30.0)
                before = browser.picture()[STAGE].astype(int)
                browser.run("document.querySelector('#tiers input[value=lite]').click()")
                until(
                    lambda: browser.run("document.getElementById('picture').state.tier == 'lite'"),
                    60.0,
                )
                until(lambda: np.abs(browser.picture()[STAGE] - before).mean() < 2.0, 60.0)
                held = out / "avatar.iavatar"
                held.write_bytes(held.read_bytes()[:-1000])  # as a copy that was cut off
                browser.run("location.reload()")
                told = "avatar.iavatar cannot be read: it is damaged"
                until(lambda: told in browser.text(), 60.0)
        finally:
            process.terminate()


@in_browser
def test_the_element_plays_in_a_page_of_ones_own(call_play, package, novel, tmp_path):
    """The example: one avatar dances, another one is loaded when it is scrolled near."""
    words = ("--poses", novel, "--web", "--out", tmp_path / "player")
    assert call_play(package, *words).code == 0
    files = {"index.html": (EXAMPLES / "4_avatar_in_a_page.html").read_bytes()}
    for file in (tmp_path / "player").rglob("*.*"):
        files[str(file.relative_to(tmp_path))] = file.read_bytes()
    folder = tmp_path / "browser"
    with serving(files, 8390) as address, Browser(folder, size=SIZE) as browser:
        for motion in ("reduce", ""):
            browser.emulate(scheme="light", size=SIZE, motion=motion)
            browser.go(f"{address}/?{motion}")
            until(lambda: browser.run("!!window.dancer?.playback?.shown.length"), 120.0)
            assert browser.run("dancer.state.playing") is (motion == "")
        assert browser.run("stander.loading === undefined")
        browser.run("dancer.pause(); dancer.focus()")
        before = browser.run("dancer.orbit.yaw")
        browser.press("ArrowLeft")
        until(lambda: browser.run("dancer.orbit.yaw") > before, 30.0)
        browser.run(
            "stander.preview = (blob) => { early = [blob.type, !stander.playback]; };"
            "stander.scrollIntoView()"
        )
        until(lambda: browser.run("!!stander.playback?.shown.length"), 120.0)
        assert browser.run("early") == ["image/png", True]
        assert browser.run("dancer.state.inSight") is False
        assert browser.run("stander.player.count") == 1
        browser.run("stander.setAttribute('src', 'player/none.iavatar')")
        until(lambda: "404" in browser.run("stander.message.textContent"), 30.0)


@with_runtime
def test_a_page_replaces_a_page(call_play, package, tmp_path):
    out = tmp_path / "page"
    for _ in range(2):
        outcome = call_play(package, "--web", "--out", out)
        assert outcome.code == 0
        assert outcome.out.strip() == str(out)
    assert (out / "index.html").is_file()
    assert (out / "runtime" / "LICENSE").is_file()
    assert (out / "runtime" / "ort.js").is_file()
    assert not list(out.rglob("*.mjs"))  # which many hosts do not serve as a script

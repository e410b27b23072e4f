"""The phone page in headless Chromium, whose fake camera plays a film of the actor."""

import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager

import av
import numpy as np
import pytest

from capture.source_opening import open_source
from instant_avatar.phone import film_queue
from instant_avatar.phone.access_control import AccessControl, made_certificate
from instant_avatar.phone.film_queue import FilmQueue
from instant_avatar.phone.phone_server import PhoneServer
from instant_avatar.studio.shoot import ShootConfig, film_capture
from tests.instant_avatar.browser import Browser, until, with_chromium, with_runtime

pytest.importorskip("aiohttp")
pytest.importorskip("segno")


PIXEL = "data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAAC"
"""A picture of one pixel."""


pytestmark = [pytest.mark.slow, with_chromium, with_runtime]


@pytest.fixture(scope="module")
def camera_film(tmp_path_factory):
    """A film of the actor for Chromium's fake camera."""
    folder = tmp_path_factory.mktemp("camera")
    film_capture(folder / "film", ShootConfig(frames=60, size=240, turns=1.0, like_a_phone=True))
    frames = [frame.rgb for frame in open_source(folder / "film").frames()]
    write_camera_film(folder / "camera.mjpeg", [*frames, *frames[::-1]])
    return folder / "camera.mjpeg"


def write_camera_film(path, frames):
    with av.open(str(path), "w", format="mjpeg") as container:
        stream = container.add_stream("mjpeg", rate=15, options={"qmin": "2", "qmax": "4"})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuvj420p"
        for rgb in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        container.mux(stream.encode())


def camera_flags(path):
    return [
        "--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream",
        f"--use-file-for-fake-video-capture={path}",
    ]  # fmt: skip


@contextmanager
def opened(folder, port, *, size=(360, 740), flags=()):
    """A browser that has entered the page, and the queue of its films."""
    queue, access = FilmQueue(folder / "out", 30.0), AccessControl()
    queue.folder.mkdir(exist_ok=True)
    server = PhoneServer(queue, access, None)
    server.start("127.0.0.1", [(port, None)])
    with Browser(folder / "browser", size=size, flags=list(flags)) as browser:
        browser.emulate(scheme="light", size=size)
        browser.go(f"http://127.0.0.1:{port}/?token={access.token}")
        until(lambda: browser.run("!!document.getElementById('live')?.onclick"), 60.0)
        yield browser, queue
    server.close()


def test_an_upright_camera_is_not_cropped(tmp_path):
    write_camera_film(tmp_path / "camera.mjpeg", [np.full((1280, 720, 3), 90, np.uint8)] * 8)
    flags = camera_flags(tmp_path / "camera.mjpeg")
    with opened(tmp_path, 8747, flags=flags) as (browser, _):
        browser.click("Film here, with advice")
        width, height = (f"document.getElementById('camera').video{s}" for s in ("Width", "Height"))
        until(lambda: browser.run(width), 60.0)
        assert (browser.run(width), browser.run(height)) == (720, 1280)


def test_the_plain_page_leads_to_that_with_tls_and_opens_again_after_it(tmp_path):
    port = 8741
    flags = ["--ignore-certificate-errors"]  # a person would choose to go on
    with Browser(tmp_path / "browser", size=(360, 740), flags=flags) as browser:
        for _ in range(2):  # the second time beside the cookies of the first
            access = AccessControl()
            server = PhoneServer(FilmQueue(tmp_path, 30.0), access, port + 1)
            server.start("127.0.0.1", [(port, None), (port + 1, made_certificate("127.0.0.1"))])
            try:
                browser.go(f"http://127.0.0.1:{port}/?token={access.token}")
                until(lambda: "Film an avatar" in browser.text(), 60.0)
                browser.run("location.href = 'live'")
                until(lambda: browser.run("location.protocol") == "https:", 60.0)
                until(lambda: "Film an avatar" in browser.text(), 60.0)
            finally:
                server.close()


@pytest.fixture
def page(run, tmp_path):
    """A page of 360 px with an earlier avatar, Anna, and the queue of its films."""
    place = tmp_path / "out" / "Anna" / "run"
    place.mkdir(parents=True)
    shutil.copy(run / "avatar.iavatar", place)
    with opened(tmp_path, 8745) as (browser, queue):
        until(lambda: "Anna" in browser.text(), 60.0)
        yield browser, queue


def choose_video(browser, size=4):
    """A person chooses a file of `size` bytes."""
    browser.run(
        f"""(() => {{
          const held = new DataTransfer();
          held.items.add(new File([new Uint8Array({size})], "film.mp4", {{ type: "video/mp4" }}));
          const input = document.getElementById("stored");
          input.files = held.files;
          input.dispatchEvent(new Event("change"));
        }})()"""
    )


def text_of(browser, name):
    return browser.run(f"document.getElementById('{name}').textContent")


def test_the_page_stays_with_what_a_person_looks_at(page, run):
    browser, queue = page
    choose_video(browser)
    film = queue.take_next(60.0)
    until(lambda: "Making the avatar" in browser.text(), 60.0)
    assert browser.run("document.getElementById('poster').hidden")  # there is no picture yet
    assert browser.run("getComputedStyle(document.getElementById('player')).opacity") == "0"
    film.tell("preview", image=PIXEL)
    until(lambda: not browser.run("document.getElementById('poster').hidden"), 60.0)
    film.run.path.mkdir()
    shutil.copy(run / "avatar.iavatar", film.run.path)
    film.tell("warning", text="The phone fell silent.")
    film.tell("avatar", name=film.place.name, final=False)
    until(lambda: "It can be played" in browser.text(), 60.0)
    until(lambda: not browser.run("!!document.getElementById('warm-up')"), 120.0)  # drawn
    assert "The phone fell silent." in browser.text()
    bottom = "document.getElementById('warning').getBoundingClientRect().bottom"
    assert browser.run(f"{bottom} <= innerHeight")
    browser.click("Film more")
    assert "The next film is added to avatar." in browser.text()
    assert browser.run("document.getElementById('name').offsetParent === null")  # it has its name
    browser.click("Back to avatar")
    assert text_of(browser, "title") == "avatar"
    browser.click("Another person")
    assert "The next film is added" not in browser.text()
    until(lambda: browser.run("document.querySelectorAll('#avatars button').length") == 1, 60.0)
    browser.click("Anna")
    until(lambda: text_of(browser, "title") == "Anna", 60.0)
    film.tell("progress", text="scoring", share=0.5)
    film.tell("avatar", name=film.place.name, final=True)
    film.tell("state", state="done")
    film.tell("advice", text="last", time=0.0)
    until(lambda: text_of(browser, "advice") == "last", 60.0)
    assert text_of(browser, "title") == "Anna"
    assert text_of(browser, "note") == ""  # all of these were of the other avatar
    assert "fell silent" not in browser.text()


def test_a_full_disk_ends_the_film_by_name_and_its_avatar_is_made(page, monkeypatch):
    browser, queue = page
    free = shutil.disk_usage(queue.folder)

    def usage(place):
        return free._replace(free=0 if any(film.file.received for film in queue) else 1 << 40)

    monkeypatch.setattr(film_queue.shutil, "disk_usage", usage)
    choose_video(browser, size=5_000_000)
    film = queue.take_next(60.0)
    until(lambda: "The disk of the computer is full: the film ends here." in browser.text(), 60.0)
    assert "Making the avatar" in browser.text()
    assert 0 < film.file.path.stat().st_size < 5_000_000


def test_a_film_that_the_computer_has_ended_says_why_and_its_avatar_is_made(page):
    browser, queue = page
    choose_video(browser)
    until(lambda: list(queue), 60.0)
    next(iter(queue)).file.end("The phone fell silent for 30 s: the film ends here.")
    queue.take_next(60.0)
    until(lambda: "The phone fell silent for 30 s" in browser.text(), 60.0)
    assert "Making the avatar" in browser.text()


def test_a_film_begins_without_the_figures_of_the_one_before(page):
    browser, queue = page
    choose_video(browser)
    queue.take_next(60.0)
    until(lambda: "0.0 MB sent" in text_of(browser, "sent"), 60.0)
    until(lambda: "Making the avatar" in browser.text(), 60.0)
    choose_video(browser)
    until(lambda: "Waiting for avatar" in browser.text(), 60.0)
    assert text_of(browser, "sent") == ""


def test_the_page_names_a_file_for_other_programs_until_it_is_saved(page, tmp_path):
    browser, queue = page
    browser.save_to(tmp_path)
    browser.click("Anna")
    glb = "document.getElementById('glb')"
    browser.run(f"{glb}.click(); {glb}.click()")  # the second one is not another file
    assert "Making the GLB of Anna: half a minute" in browser.text()
    until(lambda: "The GLB of Anna is saved." in browser.text(), 300.0)
    until(lambda: list(tmp_path.glob("*.glb")), 60.0)
    assert [path.name for path in tmp_path.glob("*.glb")] == ["Anna.glb"]
    assert (tmp_path / "Anna.glb").read_bytes()[:4] == b"glTF"
    queue.package("Anna").unlink()
    browser.run("document.getElementById('vrm').click()")
    until(lambda: "The VRM was not saved: There is no avatar 'Anna'." in browser.text(), 60.0)


def reload(browser):
    browser.run("window.before = true")
    browser.go(browser.run("location.href"))
    until(lambda: browser.run("!window.before && !!document.getElementById('live')?.onclick"), 60.0)


def test_a_page_that_is_loaded_again_goes_on_with_a_file(page, run):
    browser, queue = page
    browser.run(
        """(async () => {
          const note = { name: "Ben", type: "video/mp4", size: 5_000_000 };
          const body = JSON.stringify(note);
          const { film } = await (await fetch("films", { method: "POST", body })).json();
          await fetch(`films/${film}?offset=0`, { method: "PUT", body: new Uint8Array(1_500_000) });
        })()"""
    )  # the page ends here
    film = queue.take_next(60.0)
    reload(browser)
    until(lambda: "1.5 of 5.0 MB of Ben were sent" in browser.text(), 60.0)
    film.heard_at -= 20.0
    silent_since = film.heard_at
    until(lambda: film.heard_at > silent_since, 60.0)  # the film waits for the choice
    choose_video(browser, size=4)
    until(lambda: "That is another video" in browser.text(), 60.0)
    assert film.file.received == 1_500_000
    choose_video(browser, size=5_000_000)
    until(lambda: film.file.ended, 60.0)
    assert film.file.received == 5_000_000
    until(lambda: "Making the avatar" in browser.text(), 60.0)
    reload(browser)  # also while it is learnt from
    until(lambda: "Making the avatar" in browser.text(), 60.0)
    film.run.path.mkdir()
    shutil.copy(run / "avatar.iavatar", film.run.path)
    film.tell("avatar", name="Ben", final=True)
    until(lambda: "It is ready." in browser.text(), 60.0)
    queue.finish(film)
    reload(browser)
    until(lambda: browser.run("document.querySelectorAll('#avatars button').length") == 2, 60.0)
    assert not browser.run("document.getElementById('home').hidden")


def test_a_page_that_is_loaded_again_keeps_what_it_filmed(camera_film, tmp_path):
    flags = camera_flags(camera_film)
    with opened(tmp_path, 8749, size=(1200, 800), flags=flags) as (browser, queue):
        browser.click("Film here, with advice")
        film = queue.take_next(60.0)
        until(lambda: film.file.received > 50_000, 60.0)
        browser.go("http://127.0.0.1:8749/")  # the tab was closed
        until(lambda: "while it filmed avatar" in browser.text(), 60.0)
        film.tell("seconds", seconds=7.0)
        film.tell("map", svg="", seen=0.44)
        until(lambda: text_of(browser, "seen") == "44 % of you seen", 60.0)
        mark = "getComputedStyle(document.getElementById('seen'), '::before').content"
        assert browser.run(mark) == '" · "'  # though nothing was sent from this page
        received = film.file.received
        assert not film.file.ended
        assert browser.run("document.getElementById('same').offsetParent === null")
        browser.click("Make the avatar of what came")
        until(lambda: "Making the avatar" in browser.text(), 60.0)
        assert film.file.ended
        assert film.file.received == film.file.path.stat().st_size == received


def test_a_film_of_the_pages_camera_becomes_an_avatar_in_its_player(camera_film, tmp_path):
    command = [
        sys.executable, "-m", "instant_avatar.phone.phone_command", "--out", str(tmp_path / "out"),
        "--host", "127.0.0.1", "--port", "8731", "--size", "160", "--no-tls",
    ]  # fmt: skip
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    flags = camera_flags(camera_film)
    try:
        address = server.stdout.readline().strip()
        with Browser(tmp_path / "browser", size=(360, 740), flags=flags) as browser:
            browser.emulate(scheme="light", size=(360, 740))
            browser.go(address)
            until(lambda: browser.run("!!document.getElementById('live')?.onclick"), 300.0)
            assert "Film an avatar" in browser.text()
            assert browser.run("crossOriginIsolated")
            browser.run("document.getElementById('name').value = 'Anna'")
            browser.run("document.getElementById('live').click()")
            until(lambda: "seen" in browser.text(), 600.0)
            assert browser.run("document.documentElement.scrollWidth") <= 360
            until(lambda: browser.run("!document.getElementById('preview').hidden"), 600.0)
            stop = "document.getElementById('stop').getBoundingClientRect().bottom"
            assert browser.run(f"{stop} <= innerHeight")  # also below advice, figures and preview
            browser.click("Stop")
            until(lambda: browser.run("!document.getElementById('done').hidden"), 900.0)
            until(lambda: browser.run("document.getElementById('poster').naturalWidth"), 60.0)
            played = "!!document.getElementById('player').contentWindow.player"
            until(lambda: browser.run(played), 600.0)
            until(lambda: browser.run("document.getElementById('poster').hidden"), 600.0)
            finer = "[...document.querySelectorAll('#show iframe')].map((f) => f.src).join()"
            until(lambda: browser.run(finer).endswith("/avatars/Anna/?start=hq"), 900.0)
            until(lambda: browser.run(finer).count("start") == 1, 600.0)
            assert browser.run(
                "document.getElementById('player').contentWindow.crossOriginIsolated"
            )
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=600.0) in (0, 130)
        server.stdout.close()
    (film,) = (tmp_path / "out" / "Anna").glob("film.*[!d]")
    assert film.stat().st_size > 10_000
    assert (tmp_path / "out" / "Anna" / "run" / "avatar.iavatar").is_file()

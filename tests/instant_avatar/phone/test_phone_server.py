"""The phone page's server, with clients that are slow, broken or hostile; nothing is trained."""

import errno
import gc
import gzip
import http.client
import json
import re
import shutil
import socket
import sys
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from urllib.parse import quote

import psutil
import pytest

pytest.importorskip("aiohttp")

from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from capture import received_video
from capture.input_error import InputError
from instant_avatar.phone import access_control, film_queue, phone_server
from instant_avatar.phone.access_control import (
    AccessControl,
    load_certificate,
    made_certificate,
)
from instant_avatar.phone.film_queue import FilmQueue
from instant_avatar.phone.phone_command import CaptureOptions
from instant_avatar.phone.phone_server import PhoneServer

CONTENT = bytes(range(256)) * 40


@pytest.fixture
def queue(tmp_path, monkeypatch):
    monkeypatch.setattr(film_queue, "MIN_FREE_BYTES", 0)
    return FilmQueue(tmp_path, 0.2)


@pytest.fixture
def phone(queue):
    """A browser that has entered with the token."""
    access = AccessControl()
    server = PhoneServer(queue, access, None)
    server.start("127.0.0.1", [(0, None)])
    port = server._runner.addresses[0][1]
    yield Phone(port, access)
    server.close()


def test_connections_that_come_while_the_server_ends_are_closed(queue, monkeypatch):
    unclosed = []
    monkeypatch.setattr(sys, "unraisablehook", lambda each: unclosed.append(each.exc_value))
    monkeypatch.setattr(phone_server, "_player_files", dict)
    for _ in range(3):
        server = PhoneServer(queue, AccessControl(), None)
        server.start("127.0.0.1", [(0, None)])
        address, connected, ended = server._runner.addresses[0], threading.Event(), []

        def connect(address=address, connected=connected, ended=ended):
            while not ended:
                with suppress(OSError), socket.create_connection(address, timeout=1.0):
                    connected.set()

        browsers = [threading.Thread(target=connect) for _ in range(3)]
        for browser in browsers:
            browser.start()
        connected.wait()
        server.close()
        ended.append(True)
        for browser in browsers:
            browser.join()
        del server
        gc.collect()
    assert not unclosed


class Phone:
    def __init__(self, port, access):
        self.port, self.access = port, access
        self.host = f"127.0.0.1:{port}"
        entered = self.ask("GET", f"/?token={access.token}", cookie="")
        assert entered.status == 303
        self.cookie = entered.headers["Set-Cookie"].split(";")[0]

    def ask(self, method, path, body=None, *, cookie=None, origin=None, **headers):
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120.0)
        sent = {"Cookie": self.cookie if cookie is None else cookie, **headers}
        sent["Origin"] = origin or f"http://{self.host}"
        line.request(method, path, body=body, headers=sent)
        with line.getresponse() as answer:
            answer.content = answer.read()
        line.close()
        return answer

    def put_in_part(self, film, offset, content, size):
        """A piece of `size` bytes whose connection has sent only some, and is still open."""
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120.0)
        line.putrequest("PUT", f"/films/{film}?offset={offset}")
        headers = {"Cookie": self.cookie, "Origin": f"http://{self.host}", "Content-Length": size}
        for name, value in headers.items():
            line.putheader(name, str(value))
        line.endheaders(content)
        return line

    def state(self, film):
        return json.loads(self.ask("GET", f"/films/{film}").content)

    def begin(self, **given):
        note = {"name": "Anna", "type": "video/mp4", "size": len(CONTENT), **given}
        answer = self.ask("POST", "/films", json.dumps(note))
        assert answer.status == 201, answer.content
        return json.loads(answer.content)["film"]


def test_a_token_opens_the_page_once(phone):
    old = phone.access.token
    assert phone.ask("GET", f"/?token={old}", cookie="").status == 303
    refused = phone.ask("GET", f"/?token={old}", cookie="")
    assert refused.status == 403
    assert refused.content.decode() == phone_server.REFUSED
    page = phone.ask("GET", "/")
    assert page.status == 200
    assert page.headers["Cross-Origin-Embedder-Policy"] == "require-corp"


@pytest.mark.parametrize("path", ["/", "/films", "/avatars", "/page/capture.js", "/avatars/x/"])
def test_without_a_session_everything_is_refused(phone, path):
    assert phone.ask("GET", path, cookie="").status == 403
    assert phone.ask("GET", path, cookie="session=guess").status == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "null"])
def test_pages_of_other_sites_are_refused(phone, origin):
    assert phone.ask("POST", "/films", "{}", origin=origin).status == 403


def test_a_film_survives_two_broken_connections(phone, queue, caplog):
    film = phone.begin()
    for start, end in ((0, 3000), (3000, 7000)):
        line = phone.put_in_part(film, start, CONTENT[start:end], len(CONTENT) - start)
        deadline = time.perf_counter() + 120.0
        while phone.state(film)["received"] < end:
            assert time.perf_counter() < deadline
            time.sleep(0.05)  # fewer requests than a browser may send
        line.close()
    assert phone.state(film)["next"] == 7000
    done = phone.ask("PUT", f"/films/{film}?offset=7000", CONTENT[7000:])
    assert json.loads(done.content)["ended"]
    assert next(iter(queue)).file.path.read_bytes() == CONTENT
    assert caplog.records == []  # a break is no error of the server's


@pytest.mark.parametrize(
    ("query", "size", "status"),
    [
        ("offset=-1", 10, 413),
        ("offset=x", 10, 400),
        ("", 10, 400),
        ("offset=0", 0, 400),
        ("offset=10000", 1000, 413),
    ],
)
def test_malformed_and_oversized_pieces_are_refused(phone, query, size, status):
    film = phone.begin()
    answer = phone.ask("PUT", f"/films/{film}?{query}", bytes(size))
    assert answer.status == status
    assert phone.state(film)["received"] == 0


@pytest.mark.parametrize(
    ("given", "status"),
    [
        ({"type": "text/html"}, 415),
        ({"size": 1 << 40}, 413),
        ({"size": 0}, 413),
        ({"size": -1}, 413),
        ({"size": "many"}, 400),
        ({"avatar": "../../etc"}, 404),
        ({"avatar": "nothing"}, 404),
        *((text, 400) for text in ("[]", "5", "null", '"x"', "[" * 100_000, "{")),
    ],
)
def test_films_that_cannot_be_are_refused(phone, given, status, caplog):
    note = {"name": "Anna", "type": "video/mp4", "size": 100}
    body = given if isinstance(given, str) else json.dumps(note | given)
    answer = phone.ask("POST", "/films", body)
    assert answer.status == status
    assert json.loads(answer.content)["message"]
    assert caplog.records == []


def test_a_piece_that_takes_too_long_keeps_what_came(phone, monkeypatch, caplog):
    monkeypatch.setattr(phone_server, "PIECE_TIMEOUT_S", 0.2)
    film = phone.begin()
    line = phone.put_in_part(film, 0, CONTENT[:10], 100)
    assert line.getresponse().status == 504  # after which the page goes on where it stopped
    line.close()
    assert phone.state(film)["next"] == 10
    assert caplog.records == []


def test_names_are_no_paths(phone, queue):
    phone.begin(name="../../evil/../name")
    film = next(iter(queue))
    assert film.place.parent == queue.folder


def test_a_gap_in_what_is_being_filmed_is_refused(phone):
    film = phone.begin(size=None)
    assert phone.ask("PUT", f"/films/{film}?offset=5", b"late").status == 409


def test_a_browser_finds_its_films_again_and_another_one_does_not(phone):
    film = phone.begin()
    phone.ask("PUT", f"/films/{film}?offset=0", CONTENT[:1000])
    entered = phone.ask("GET", f"/?token={phone.access.token}")
    assert entered.status == 303
    assert "Set-Cookie" not in entered.headers
    (begun,) = json.loads(phone.ask("GET", "/films").content)
    assert begun == {
        "film": film, "avatar": "Anna", "size": len(CONTENT), "received": 1000, "ended": False,
    }  # fmt: skip
    other = phone.ask("GET", f"/?token={phone.access.token}", cookie="")
    other = other.headers["Set-Cookie"].split(";")[0]
    assert json.loads(phone.ask("GET", "/films", cookie=other).content) == []
    assert phone.ask("GET", f"/films/{film}", cookie=other).status == 404
    assert phone.ask("PUT", f"/films/{film}?offset=0", b"x", cookie=other).status == 404


def test_a_full_disk_ends_the_film_and_keeps_what_came(phone, queue, monkeypatch):
    film = phone.begin()
    assert phone.ask("PUT", f"/films/{film}?offset=0", CONTENT[:1000]).status == 200
    full = shutil.disk_usage(queue.folder)._replace(free=-1)
    monkeypatch.setattr(film_queue.shutil, "disk_usage", lambda place: full)
    assert phone.ask("PUT", f"/films/{film}?offset=1000", CONTENT[1000:2000]).status == 507
    state = phone.state(film)
    assert state["ended"]
    assert "disk" in state["reason"]
    assert state["received"] == 1000


def test_a_disk_without_room_for_a_note_ends_the_film_by_name(phone, queue, monkeypatch, caplog):
    film = phone.begin()

    def fail(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(received_video, "write_text_atomically", fail)
    answer = phone.ask("PUT", f"/films/{film}?offset=0", CONTENT[:1000])
    assert answer.status == 507
    assert "disk" in json.loads(answer.content)["message"]
    assert phone.state(film)["ended"]
    assert caplog.records == []  # no traceback


def test_a_silent_phone_ends_its_film_by_name(phone, queue):
    phone.begin()
    film = queue.take_next(1.0)
    film.heard_at -= 1.0
    queue.end_silent()
    assert film.file.ended
    assert "fell silent" in film.file.reason
    late = phone.ask("PUT", f"/films/{film.number}?offset=0", b"late")
    assert json.loads(late.content)["reason"] == film.file.reason
    assert film.file.received == 0


def test_films_wait_for_those_before_them_by_name(phone, queue):
    phone.begin(name="Anna")
    phone.begin(name="Ben")
    first, second = queue
    assert queue.take_next(1.0) is first
    kinds = {kind: content for _, kind, content in second.messages(0)}
    assert kinds["state"] == {"state": "waiting", "behind": ["Anna"]}
    queue.finish(first)
    assert queue.take_next(1.0) is second


def test_without_the_browsers_runtime_page_and_terminal_say_so(tmp_path, monkeypatch):
    def fail():
        raise InputError("The browser page needs onnxruntime-web.")

    monkeypatch.setattr(phone_server, "_player_files", fail)
    access = AccessControl()
    server = PhoneServer(FilmQueue(tmp_path, 0.2), access, None)
    server.start("127.0.0.1", [(0, None)])
    page = Phone(server._runner.addresses[0][1], access).ask("GET", "/").content.decode()
    server.close()
    assert server.missing_player == "The browser page needs onnxruntime-web."
    assert 'data-player="missing"' in page
    assert "{{" not in page


def test_too_many_requests_must_wait(phone, monkeypatch):
    monkeypatch.setattr(phone_server, "MAX_REQUESTS_PER_S", 1)
    assert 429 in [phone.ask("GET", "/avatars").status for _ in range(8)]


@pytest.mark.parametrize("address", ["192.168.0.7", "localhost", "studio.local"])
def test_a_certificate_is_made_for_an_address_or_a_name(address, monkeypatch):
    made = []

    def load(path, key):
        made.append(x509.load_pem_x509_certificate(path.read_bytes()).extensions)
        return load_certificate(path, key)

    monkeypatch.setattr(access_control, "load_certificate", load)
    made_certificate(address)
    (usage,) = made[0].get_extension_for_class(x509.ExtendedKeyUsage).value
    assert usage == ExtendedKeyUsageOID.SERVER_AUTH  # Apple's systems ask for it


@pytest.mark.parametrize("seconds", [9.9, float("nan"), float("inf")])
def test_a_phone_may_be_silent_for_as_long_as_the_page_counts_down(tmp_path, seconds):
    CaptureOptions(out=tmp_path, silent_seconds=10.0).validate()
    with pytest.raises(InputError, match="at least 10"):
        CaptureOptions(out=tmp_path, silent_seconds=seconds).validate()


def test_what_is_no_certificate_is_bad_input(tmp_path):
    path = tmp_path / "notes.pem"
    path.write_text("notes")
    with pytest.raises(InputError, match=r"--cert .*notes\.pem.*PEM files"):
        load_certificate(path, path)


@pytest.fixture
def anna(queue, run):
    """A finished avatar of that name."""
    place = queue.folder / "Anna" / "run"
    place.mkdir(parents=True)
    shutil.copy(run / "avatar.iavatar", place)


@pytest.mark.slow
def test_an_avatar_is_saved_for_other_programs_under_a_name_in_any_script(
    phone, queue, run, capsys
):
    place = queue.folder / "Zoë-さくら" / "run"
    place.mkdir(parents=True)
    shutil.copy(run / "avatar.iavatar", place)
    name = quote("Zoë-さくら")

    def saved(ending, query=""):
        answer = phone.ask("GET", f"/avatars/{name}/avatar.{ending}{query}")
        assert answer.status == 200
        kept_as = f"attachment; filename*=UTF-8''{name}.{ending}"
        assert answer.headers["Content-Disposition"] == kept_as
        return answer.content

    assert saved("iavatar") == (place / "avatar.iavatar").read_bytes()
    for query, author in (("?author=Ann%20M.", "Ann M."), ("?author=", "unknown")):
        content = saved("vrm", query)
        length = int.from_bytes(content[12:16], "little")
        scene = json.loads(content[20 : 20 + length])
        assert scene["extensions"]["VRMC_vrm"]["meta"]["authors"] == [author]
    assert gzip.decompress(saved("spz")).startswith(b"NGSP")
    assert capsys.readouterr().err == ""  # no path of a file that is gone


@pytest.mark.slow
def test_what_makes_a_mesh_is_no_thread_of_the_page(phone, anna):
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(phone.ask, "GET", "/avatars/Anna/avatar.glb")
        commands = []
        while not waiting.done():
            for child in psutil.Process().children():
                with suppress(psutil.Error):
                    commands += child.cmdline()
            assert phone.ask("GET", "/avatars").status == 200
            time.sleep(0.05)
    assert "instant_avatar.export" in commands
    assert waiting.result().content.startswith(b"glTF")


@pytest.mark.slow
def test_the_player_waits_for_the_package_that_a_film_makes(phone, queue, run):
    phone.begin()
    film = queue.take_next(1.0)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(phone.ask, "GET", "/avatars/Anna/avatar.iavatar")
        time.sleep(0.3)
        assert not waiting.done()
        film.run.path.mkdir(parents=True)
        shutil.copy(run / "avatar.iavatar", film.run.path)
        assert not waiting.done()  # it could be that of an earlier film
        film.tell("avatar", name="Anna", final=False)
        assert waiting.result(timeout=60.0).content == film.run.package.read_bytes()
        queue.finish(film)
        assert phone.ask("GET", "/avatars/Bea/avatar.iavatar").status == 404


@pytest.mark.slow
def test_the_players_module_is_served_once_for_all_avatars(phone, anna):
    warm_up = re.search(r'src="(avatars/-/[^"]+)"', phone.ask("GET", "/").content.decode())
    if warm_up is None:
        pytest.skip("onnxruntime-web is not here (make web)")
    assert phone.ask("GET", f"/{warm_up[1]}").status == 200
    answer = phone.ask("GET", "/avatars/Anna/runtime/ort.wasm.zlib")
    assert answer.status == 302
    path = answer.headers["Location"].removeprefix("../../../")
    module = phone.ask("GET", f"/{path}")
    assert len(zlib.decompress(module.content)) > 1_000_000
    assert phone.ask("GET", "/avatars/-/avatar.iavatar").content.startswith(b"PK")
    assert "immutable" in module.headers["Cache-Control"]
    assert phone.ask("GET", f"/{path}", cookie="").status == 403

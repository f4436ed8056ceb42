"""Downloads: from a real server that breaks off, stalls, lies and redirects."""

from __future__ import annotations

import dataclasses
import fcntl
import io
import json
import urllib.request
from collections.abc import Iterator
from http.client import HTTPMessage
from pathlib import Path

import pytest
from fetch_server import (
    CONTENT,
    QUICK,
    Handler,
    Server,
    answer,
    break_off,
    chunked,
    fail,
    files_of_at_most,
    ignore_range,
    redirect,
    running,
    stall,
    trickle,
)

from synthetless.fetch import DownloadError, Persistence, _CarefulRedirects, download

MB = 1_000_000


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with running() as made:
        yield made


def get(server: Server, folder: Path, limit_bytes: int = MB, persistence: Persistence = QUICK) -> bytes:
    target = folder / "got"
    download(server.url, target, limit_bytes, persistence=persistence)
    assert [path.name for path in folder.iterdir()] == ["got"], "nothing else is left"
    return target.read_bytes()


def test_a_file_is_downloaded(server: Server, tmp_path: Path) -> None:
    assert get(server, tmp_path) == CONTENT
    assert server.ranges == [None]


def test_a_broken_download_is_continued(server: Server, tmp_path: Path) -> None:
    server.script = [break_off(70_000), break_off(50_001), break_off(0), break_off(100_000)]
    assert get(server, tmp_path) == CONTENT
    assert server.ranges == [None, "bytes=70000-", "bytes=120001-", "bytes=120001-", "bytes=220001-"]


def test_a_later_call_goes_on(server: Server, tmp_path: Path) -> None:
    server.script = [break_off(123_456), fail(503), fail(503), fail(500)]
    with pytest.raises(DownloadError, match=r"HTTP 500 .*; run it again to continue from 0\.1 MB"):
        get(server, tmp_path)
    assert get(server, tmp_path) == CONTENT
    assert server.ranges[-1] == "bytes=123456-"


def test_a_file_that_changed_is_fetched_from_its_start(server: Server, tmp_path: Path) -> None:
    def change(handler: Handler) -> None:
        break_off(100_000)(handler)
        server.content, server.etag = CONTENT[::-1], '"two"'

    server.script = [change]
    assert get(server, tmp_path) == CONTENT[::-1]
    assert server.requests[-1][1]["If-Range"] == '"one"'


def test_a_changed_file_without_a_mark_is_recognised_by_its_size(server: Server, tmp_path: Path) -> None:
    def unmarked(handler: Handler, sent: int | None = None) -> None:
        status, body, headers = answer(handler)
        handler.reply(status, body, {name: value for name, value in headers.items() if name != "ETag"}, sent)

    def change(handler: Handler) -> None:
        unmarked(handler, sent=100_000)
        server.content = CONTENT[::-1][:-7]

    server.script = [change, unmarked]
    assert get(server, tmp_path) == CONTENT[::-1][:-7]
    assert server.ranges == [None, "bytes=100000-", None]


def test_what_was_left_of_another_address_is_dropped(server: Server, tmp_path: Path) -> None:
    server.script = [break_off(100_000), fail(404)]
    with pytest.raises(DownloadError, match="HTTP 404"):
        get(server, tmp_path)
    download(server.url + "?other", tmp_path / "got", MB, persistence=QUICK)
    assert (tmp_path / "got").read_bytes() == CONTENT
    assert server.ranges[-1] is None


@pytest.mark.parametrize("note", [None, "", "[]", '{"address": 3}', '{"no": "such"}'])
def test_a_partial_file_of_unknown_origin_is_dropped(server: Server, tmp_path: Path, note: str | None) -> None:
    (tmp_path / "got.part").write_bytes(b"rubbish")
    if note is not None:
        (tmp_path / "got.part.json").write_text(note)
    assert get(server, tmp_path) == CONTENT


def test_a_whole_file_that_only_lacked_its_name_needs_no_request(server: Server, tmp_path: Path) -> None:
    (tmp_path / "got.part").write_bytes(CONTENT)
    note = {"address": server.url, "validator": '"one"', "total_bytes": len(CONTENT)}
    (tmp_path / "got.part.json").write_text(json.dumps(note))
    assert get(server, tmp_path) == CONTENT
    assert server.requests == []


def test_a_partial_file_that_is_too_long_is_dropped(server: Server, tmp_path: Path) -> None:
    (tmp_path / "got.part").write_bytes(CONTENT + b"more")
    (tmp_path / "got.part.json").write_text(json.dumps({"address": server.url}))
    assert get(server, tmp_path) == CONTENT
    assert server.ranges == [f"bytes={len(CONTENT) + 4}-", None]


def test_a_server_that_ignores_ranges_gets_its_way(server: Server, tmp_path: Path) -> None:
    server.script = [break_off(100_000), ignore_range]
    assert get(server, tmp_path) == CONTENT


def test_a_server_that_ignores_ranges_and_breaks_off_is_given_up(server: Server, tmp_path: Path) -> None:
    server.script = [lambda handler: ignore_range(handler, 5000)] * 9
    with pytest.raises(DownloadError, match="closed after 5000 of 300000 bytes; run it again"):
        get(server, tmp_path)
    assert len(server.requests) == 1 + QUICK.attempts


def test_redirects_are_followed_with_the_range(server: Server, tmp_path: Path) -> None:
    server.script = [redirect("/elsewhere"), break_off(100_000), redirect("/elsewhere")]
    assert get(server, tmp_path) == CONTENT
    assert [path for path, _ in server.requests] == ["/archive.zip", "/elsewhere"] * 2
    assert server.ranges[-1] == "bytes=100000-"


def test_a_circle_of_redirects_is_one_line(server: Server, tmp_path: Path) -> None:
    server.script = [redirect("/archive.zip")] * 30
    with pytest.raises(DownloadError, match="redirect") as raised:
        get(server, tmp_path)
    assert "\n" not in str(raised.value)


def test_a_redirect_to_a_local_file_is_refused(server: Server, tmp_path: Path) -> None:
    server.script = [redirect("file:///etc/hostname")]
    with pytest.raises(DownloadError, match="HTTP 302"):
        get(server, tmp_path)


@pytest.mark.parametrize("to", ["ftp://127.0.0.1/archive.zip", "data:,hello", "gopher://127.0.0.1/", "//\x1b[2J/a"])
def test_a_redirect_to_another_scheme_is_refused(to: str, server: Server, tmp_path: Path) -> None:
    server.script = [redirect(to)] * QUICK.attempts
    with pytest.raises(DownloadError) as raised:
        get(server, tmp_path)
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_a_redirect_that_gives_up_encryption_is_refused() -> None:
    handler, secure = _CarefulRedirects(), urllib.request.Request("https://example.org/a.zip")
    with pytest.raises(DownloadError, match=r"refused: it redirects to http://example\.org/b\.zip"):
        handler.redirect_request(secure, io.BytesIO(), 302, "Found", HTTPMessage(), "http://example.org/b.zip")
    for address in ("https://example.org/a.zip", "http://example.org/a.zip"):
        followed = handler.redirect_request(
            urllib.request.Request(address), io.BytesIO(), 302, "Found", HTTPMessage(), "https://example.org/b.zip"
        )
        assert followed is not None
        assert followed.full_url == "https://example.org/b.zip"


@pytest.mark.parametrize("length", ["²", "1" * 5000, "-5", "many", "1e3"])
def test_a_length_that_is_no_number_is_passed_over(length: str, server: Server, tmp_path: Path) -> None:
    server.script = [lambda handler: handler.reply(200, CONTENT, {"Content-Length": length})]
    assert get(server, tmp_path) == CONTENT


def test_a_slow_server_is_waited_for(server: Server, tmp_path: Path) -> None:
    server.script = [trickle]
    assert get(server, tmp_path) == CONTENT


def test_a_silent_server_is_asked_again(server: Server, tmp_path: Path) -> None:
    server.script = [stall]
    assert get(server, tmp_path, persistence=dataclasses.replace(QUICK, timeout_s=0.3)) == CONTENT
    assert server.ranges == [None, "bytes=1000-"]


def test_a_file_of_unknown_size_is_downloaded(server: Server, tmp_path: Path) -> None:
    server.script = [chunked(whole=False), chunked(whole=True)]
    assert get(server, tmp_path) == CONTENT


@pytest.mark.parametrize("status", [401, 403, 404, 410])
def test_a_refusal_is_final_and_one_line(server: Server, tmp_path: Path, status: int) -> None:
    server.script = [fail(status)]
    with pytest.raises(DownloadError, match=rf"http://127\.0\.0\.1:\d+/archive\.zip: HTTP {status} "):
        get(server, tmp_path)
    assert len(server.requests) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_never_sends_anything_leaves_nothing(server: Server, tmp_path: Path) -> None:
    server.script = [break_off(0)] * QUICK.attempts
    with pytest.raises(DownloadError, match=r"closed after 0 of 300000 bytes$"):
        get(server, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_failing_server_is_asked_again(server: Server, tmp_path: Path) -> None:
    server.script = [fail(500), fail(429)]
    assert get(server, tmp_path) == CONTENT


def test_a_file_beyond_the_limit_is_refused(server: Server, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"0\.3 MB, more than 0\.2 MB"):
        get(server, tmp_path, limit_bytes=200_000)
    server.script = [chunked(whole=True)]
    with pytest.raises(DownloadError, match=r"more than 0\.2 MB"):
        get(server, tmp_path, limit_bytes=200_000)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_too_small_is_told_at_once(server: Server, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"MB needed, .* MB free"):
        download(server.url, tmp_path / "got", MB, reserve_bytes=10**18, persistence=QUICK)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_line(server: Server, tmp_path: Path) -> None:
    with files_of_at_most(100_000), pytest.raises(DownloadError, match=r"part: cannot be written \(File too large\)"):
        get(server, tmp_path)
    assert len(server.requests) == 1, "asking again would not help"


def test_no_network_is_one_line(server: Server, tmp_path: Path) -> None:
    server.shutdown()
    server.server_close()
    with pytest.raises(DownloadError, match=r"no connection \(.*refused"):
        download(server.url, tmp_path / "got", MB, persistence=QUICK)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", ["http://[::1/x", "http://host:port/x", "http://127.0.0.1/a b\n"])
def test_an_address_that_is_none_is_one_line(address: str, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match="not a usable address"):
        download(address, tmp_path / "got", MB, persistence=QUICK)


def test_two_downloads_into_one_file_do_not_mix(server: Server, tmp_path: Path) -> None:
    with (tmp_path / "got.part").open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="under way"):
            download(server.url, tmp_path / "got", MB, persistence=QUICK)
    assert (tmp_path / "got.part").exists()


def test_waits_double_up_to_a_bound() -> None:
    patience = Persistence(first_wait_s=1, longest_wait_s=5)
    assert [patience.wait_s(failures) for failures in range(1, 6)] == [1, 2, 4, 5, 5]

"""Datasets on S3 (the server of moto) and on web servers: numbers, requests, failures, and unseen secrets."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count, repeat
from pathlib import Path
from typing import Any

import pytest
import servers

import todframes as tod
from todframes.base import remote
from todframes.base.errors import RemoteError, SettingsError
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile

pytestmark = pytest.mark.oracle
s3fs = pytest.importorskip("s3fs", reason="s3:// needs the extra remote")
sync = pytest.importorskip("fsspec.asyn").sync
pytest.importorskip("aiohttp", reason="http:// needs the extra remote")

KEY, SECRET = "AKIA0TESTKEY00000001", "very/secret+words0123456789"
NUMBERS = count()
FORBIDDEN, BROKEN = (partial(servers.status, line=line) for line in ("403 Forbidden", "500 Broken"))


@pytest.fixture
def web(tmp_path: Path) -> Iterator[servers.Server]:
    with servers.Server(tmp_path) as server:
        yield server


@pytest.fixture(scope="module")
def s3_server() -> Iterator[str]:
    """The URL of a server of S3, and credentials for it in the environment."""
    server_module = pytest.importorskip("moto.server", reason="tests of s3:// need moto of the group dev")
    server = server_module.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def s3_environment(s3_server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    environment = {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET, "AWS_ENDPOINT_URL": s3_server}
    environment |= {"AWS_EC2_METADATA_DISABLED": "true", "AWS_CONFIG_FILE": str(tmp_path / "none")}
    for name, value in environment.items():
        monkeypatch.setenv(name, value)

    def close(loop: object, s3: Any) -> None:
        """In place of s3fs's own, which on a busy machine leaves connections open after a tenth of a second."""
        try:
            asyncio.get_running_loop().create_task(s3.__aexit__(None, None, None))
        except RuntimeError:  # this thread has no loop
            sync(loop, s3.__aexit__, None, None, None, timeout=60)

    monkeypatch.setattr(s3fs.S3FileSystem, "close_session", staticmethod(close))
    forget_connections()
    yield
    forget_connections()


def forget_connections() -> None:
    remote._options.cache_clear()
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def upload(s3_environment: None) -> Callable[[Path], str]:  # noqa: ARG001 - it needs credentials
    """Function that copies a folder to S3 and returns its URL."""
    s3 = s3fs.S3FileSystem(use_listings_cache=False)

    def copy(folder: Path) -> str:
        bucket = f"lab-{next(NUMBERS)}"
        s3.mkdir(bucket)
        for path in filter(Path.is_file, folder.rglob("*")):
            s3.pipe(f"{bucket}/archive/{path.relative_to(folder)}", path.read_bytes())
        return f"s3://{bucket}/archive"

    return copy


def content_of(path: remote.RemotePath) -> bytes:
    with remote.local_file(path) as copy:
        return copy.read_bytes()


def todframes(*arguments: object, **environment: str) -> tuple[int, str, str]:
    """Run a command in a process of its own. Returns its exit status, standard output and standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "todframes", *map(str, arguments)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    return done.returncode, done.stdout, done.stderr


def thresholds_and_scores(result: tod.Result) -> object:
    """The thresholds, and all numbers of each trial; not the times that they took."""
    fits = [(fit.group, fit.threshold, fit.threshold_ci95) for fit in result.thresholds]
    return fits, [{k: v for k, v in row.items() if k != "run_time_s"} for row in result.trials.records]


@pytest.mark.slow
def test_scores_on_servers_are_those_of_the_folder(make_dataset, upload, web) -> None:
    """With any number of processes; nothing is printed when the connections are closed."""
    made = make_dataset(contrasts=(0.01, 0.05, 0.2), side_px=64)
    here = tod.score(made.path, examples=False)
    for url in (upload(made.path), f"{web.url}/dataset"):
        for workers in (1, 2):
            there = tod.score(url, examples=False, workers=workers)
            assert thresholds_and_scores(there) == thresholds_and_scores(here)
            assert there.dataset_path == url


@pytest.mark.slow
def test_secrets_are_in_no_output(make_dataset, upload, tmp_path) -> None:
    url, out = upload(make_dataset(contrasts=(0.01, 0.05, 0.2)).path), tmp_path / "out"
    status, printed, remarks = todframes("score", url, "--json", "-o", out)
    assert status == 0
    assert json.loads(printed)["dataset"]["path"] == url
    assert "warning: " in remarks and remarks.count("\n") == 1
    written = b"".join(path.read_bytes() for path in out.iterdir())
    assert url.encode() in written
    for secret in (KEY, SECRET):
        assert secret not in printed + remarks
        assert secret.encode() not in written


@pytest.mark.parametrize(
    ("url", "environment", "problem"),
    [
        ("s3://no-such-bucket/archive", {}, "no such file"),
        ("s3://{bucket}/archive", {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, "cannot connect to the server"),
        ("s3://{bucket}/archive", {"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": ""}, "found no credentials"),
        ("s3://{bucket}/archive", {"AWS_PROFILE": "nobody"}, "AWS_PROFILE names a profile that does not exist"),
        ("s3://Not_A_Bucket!/archive", {}, "the name of the bucket is not valid"),
        ("http://127.0.0.1:9/archive", {}, "cannot connect to the server"),
    ],
)
@pytest.mark.slow
def test_a_failure_is_one_line(make_dataset, upload, url, environment, problem) -> None:
    bucket = upload(make_dataset().path).split("/")[2]
    url = url.format(bucket=bucket)
    status, out, err = todframes("score", url, **environment)
    assert status > 0 and out == ""
    assert err.startswith(f"error: {url}/dataset.toml: {problem}")
    assert err.count("\n") == 1 and KEY not in err and SECRET not in err


@pytest.mark.parametrize(
    ("failures", "problem"),
    [
        ([FORBIDDEN], "access denied"),
        ([BROKEN] * 9, "cannot be read (OSError)"),
        ([servers.silent] * 9, "the server did not answer in time"),
    ],
)
@pytest.mark.usefixtures("s3_environment")
@pytest.mark.slow
def test_s3_that_fails_is_one_line_without_its_words(make_dataset, web, monkeypatch, failures, problem) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", web.url)
    monkeypatch.setattr(remote, "READ_S", 0.2)
    make_dataset()
    web.failing["dataset/dataset.toml"] = iter(failures)
    url = "s3://dataset/dataset.toml"
    with pytest.raises(RemoteError) as caught:
        content_of(remote.RemotePath(url))
    assert str(caught.value).startswith(f"{url}: {problem}")
    assert KEY not in str(caught.value) and SECRET not in str(caught.value)


@pytest.mark.parametrize(
    ("failures", "problem"),
    [
        ([FORBIDDEN], "access denied"),
        ([BROKEN], "cannot be read (ClientResponseError, 500)"),
        ([servers.silent] * 3, "the server did not answer in time"),
        ([servers.cut] * 3, "the server did not answer in time, or closed the connection"),
    ],
)
def test_a_web_server_that_fails_is_one_line(make_dataset, web, monkeypatch, failures, problem) -> None:
    monkeypatch.setattr(remote, "READ_S", 0.2)
    monkeypatch.setattr(remote, "WAIT_S", 0.01)
    forget_connections()
    data = load_dataset(f"{web.url}/{make_dataset().path.name}")
    frame = data.trials[0].frames[0]
    web.failing[f"dataset/{frame.path}"] = iter(failures)
    with pytest.raises(RemoteError) as caught:
        data.open(frame)
    assert str(caught.value).startswith(f"{data.path}/{frame.path}: {problem}")


@pytest.mark.usefixtures("s3_environment")
@pytest.mark.parametrize("scheme", ["http", "s3"])
@pytest.mark.slow
def test_a_connection_that_breaks_is_tried_again(make_dataset, web, monkeypatch, scheme) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", web.url)
    monkeypatch.setattr(remote, "WAIT_S", 0.01)
    made = make_dataset()
    path = remote.RemotePath("s3://dataset" if scheme == "s3" else f"{web.url}/dataset") / "manifest.csv"
    web.failing["dataset/manifest.csv"] = iter([servers.cut] * 2)
    assert content_of(path) == made.manifest_file.read_bytes()
    assert web.asked["GET", "dataset/manifest.csv"] == 3


MOVED = "redirects to another server, scheme or port"
TOO_LONG = "longer than 1 MB, the limit for such files"
NO_LENGTH = "does not state how long the file is"
COMPRESSED = "the server sends it compressed"
LATE = "did not arrive within 300 s"
MISBEHAVING: dict[str, tuple[servers.Answer, str]] = {
    "endless chunks": (servers.endless_chunks, NO_LENGTH),
    "endless until it closes": (servers.endless_until_close, NO_LENGTH),
    "ten gigabytes": (servers.ten_gigabytes, TOO_LONG),
    "gzip bomb": (servers.gzip_bomb, COMPRESSED),
    "gzip bomb called deflate": (partial(servers.gzip_bomb, encoding="deflate"), COMPRESSED),
    "endless trailers": (servers.endless_trailers, NO_LENGTH),
    "endless continue": (servers.endless_continue, LATE),
    "a byte every 5 s": (servers.slow_body, LATE),
    "a byte of a header every 2 s": (servers.slow_headers, LATE),
    "cut without a length": (servers.cut_without_length, NO_LENGTH),
    "longer length": (servers.longer_length, "closed the connection"),
    "text called gzip": (servers.no_gzip, COMPRESSED),
    "a part": (servers.part, "found status 206 of HTTP, expected 200"),
    "status 203": (partial(servers.status, line="203 Other"), "found status 203 of HTTP, expected 200"),
    "moved endlessly": (partial(servers.moved, place="?endless"), "TooManyRedirects, 302|closed the connection"),
    **{
        f"moved to {place}": (partial(servers.moved, place=place), MOVED)
        for place in (
            *("http://127.0.0.1:PORT/secret.csv", "http://localhost:OWN/secret.csv"),
            *("https://127.0.0.1:OWN/x", "file:///etc/passwd"),
        )
    },
}


@pytest.fixture
def neighbour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[servers.Server]:
    """Another server than that of the dataset, which keeps a secret; the time limits are short."""
    (tmp_path / "secret.csv").write_text(f"{servers.SECRET},1\n")
    monkeypatch.setattr(remote, "WHOLE_S", 2)
    monkeypatch.setattr(remote, "WAIT_S", 0.01)
    monkeypatch.setattr(servers, "BOMB", servers.bomb(64))
    forget_connections()
    with servers.Server(tmp_path) as server:
        monkeypatch.setattr(servers, "NEIGHBOUR_PORT", server.port)
        yield server


@pytest.mark.parametrize(("answer", "message"), MISBEHAVING.values(), ids=MISBEHAVING)
@pytest.mark.slow
def test_what_a_web_server_sends_has_limits(make_dataset, tmp_path, neighbour, answer, message) -> None:
    """Of size and time, and no part is taken for the whole; what is elsewhere is not asked for."""
    make_dataset()
    with servers.Server(tmp_path, {"dataset.toml": repeat(answer)}) as server:
        started = time.monotonic()
        with pytest.raises((SettingsError, RemoteError), match=message) as caught:
            load_dataset(f"{server.url}/dataset")
        assert time.monotonic() - started < 20.0
    assert servers.SECRET not in str(caught.value)
    assert not neighbour.asked


@pytest.mark.usefixtures("neighbour", "s3_environment")
@pytest.mark.parametrize(
    "name",
    [
        *("endless chunks", "ten gigabytes", "cut without a length"),
        *("a byte of a header every 2 s", "a byte every 5 s"),
    ],
)
@pytest.mark.slow
def test_what_s3_sends_has_limits(make_dataset, tmp_path, monkeypatch, name) -> None:
    make_dataset()
    answer, message = MISBEHAVING[name]
    with servers.Server(tmp_path, {"dataset.toml": repeat(answer)}) as server:
        monkeypatch.setenv("AWS_ENDPOINT_URL", server.url)
        monkeypatch.setattr(remote, "WHOLE_S", 8)  # to make a client of S3 takes seconds on a busy machine
        with pytest.raises((SettingsError, RemoteError), match=message):
            load_dataset("s3://dataset")


@pytest.mark.usefixtures("neighbour")
def test_redirections_on_the_same_server_are_followed(make_dataset, tmp_path) -> None:
    made = make_dataset()
    with servers.Server(tmp_path, {"manifest.csv": repeat(servers.moved_here)}) as server:
        path = remote.RemotePath(f"{server.url}/dataset/manifest.csv")
        assert content_of(path) == made.manifest_file.read_bytes()


def test_a_frame_that_is_too_long_is_skipped(make_dataset, tmp_path) -> None:
    made = make_dataset(contrasts=(0.01, 0.05, 0.2))
    name = made.rows[1]["frame"]
    with servers.Server(tmp_path, {name: repeat(servers.ten_gigabytes)}) as server:
        url = f"{server.url}/dataset"
        skipped = tod.score(url, on_error="skip", examples=False).skipped
    problem = f"{url}/{name}: cannot be opened: longer than 512 MB, the limit for such files"
    assert skipped == ({"frame": name, "error": problem},)


def test_an_address_of_ipv6(make_dataset, tmp_path) -> None:
    make_dataset()
    try:
        server = servers.Server(tmp_path, host="::1")
    except OSError:
        pytest.skip("this machine has no IPv6")
    with server:
        assert load_dataset(f"{server.url}/dataset").n_frames == 8


def test_an_opening_is_one_request_and_connections_are_kept(make_dataset, web) -> None:
    """Header, checksum and pixels come from the same bytes."""
    made = make_dataset()
    made.rows[0]["sha256"] = tod.frames.files.frame_sha256(made.frame(0))
    made.save()
    data = load_dataset(f"{web.url}/dataset")
    frame, before = data.trials[0].frames[0], web.n_connections
    for _ in range(5):
        with data.open(frame, verify=True) as file:
            assert file.read().stored.shape == (file.header.height, file.header.width, 1)
    assert web.asked["GET", f"dataset/{frame.path}"] == 5
    assert {method for method, _ in web.asked} == {"GET"}
    assert web.n_connections <= before + 1
    assert data.has_frame(frame)  # no request: a web server does not list folders


def test_names_are_quoted_on_the_web(make_dataset, web) -> None:
    made = make_dataset()
    name = "frames/a b?c#%2e é.exr"
    made.frame(0).rename(made.path / name)
    made.rows[0]["frame"] = name
    made.save()
    data = load_dataset(f"{web.url}/dataset")
    with data.open(data.trials[0].frames[0]) as file:
        assert file.header == FrameFile(made.path / name).header


@pytest.mark.slow
def test_s3_asks_once_for_each_frame_and_once_for_its_folder(make_dataset, upload, monkeypatch) -> None:
    asked: Counter[str] = Counter()
    call = s3fs.S3FileSystem._call_s3

    def counted(self: object, method: str, *kinds: object, **more: object) -> object:
        asked[f"{method} {more.get('Key')}"] += 1
        return call(self, method, *kinds, **more)

    data = load_dataset(upload(make_dataset().path))
    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", counted)
    frames = [frame for trial in data.trials for frame in trial.frames]
    assert all(data.has_frame(frame) for frame in frames)
    assert len({data.content_id(frame) for frame in frames}) == len(frames)
    for frame in frames:
        data.open(frame).__exit__()
    expected = {f"get_object archive/{frame.path}": 1 for frame in frames}
    assert asked == Counter(expected | {"list_objects_v2 None": 1})


@pytest.mark.slow
def test_folders_of_s3_are_listed_with_tags(make_dataset, upload) -> None:
    data = load_dataset(upload(make_dataset().path))
    listed = remote.list_folder(data.path / "frames")
    assert {f"frames/{name}" for name in listed} == {trial.frames[0].path for trial in data.trials}
    assert listed == {name: remote.entity_tag(data.path / "frames" / name) for name in listed}
    assert set(remote.list_folder(data.path)) == {"dataset.toml", "manifest.csv"}
    assert remote.list_folder(data.path / "none") == {}


@pytest.mark.parametrize("tag", ['"{}"', 'W/"{}"', ""])
def test_ids_on_the_web_are_of_strong_tags_or_of_bytes(make_dataset, web, tag) -> None:
    made = make_dataset()
    web.tag = tag
    data = load_dataset(f"{web.url}/dataset")
    first = data.trials[0].frames[0]
    expected = data.content_id(first)
    assert ("dataset/frames" in expected) == (tag == '"{}"')
    assert web.asked["GET", f"dataset/{first.path}"] == (0 if tag == '"{}"' else 1)
    with data.open(first):
        assert data.content_id(first, is_read=True) == expected
    made.frame(0).write_bytes(made.frame(1).read_bytes())
    assert data.content_id(first) != expected

"""Datasets behind URLs, on the memory file system of fsspec; test_remote_servers.py has S3 and web servers.

The oracle is the same dataset in a folder: numbers are equal to the last digit.
"""

from __future__ import annotations

import errno
import json
import pickle
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from conftest import error_line

import todframes as tod
from todframes.base import remote
from todframes.base.errors import DataError, FrameError, OutputError, RemoteError, SettingsError
from todframes.base.remote import RemotePath, location
from todframes.frames.dataset import FrameReference, dataset_warnings, load_dataset
from todframes.frames.dataset_files import write_sha256
from todframes.frames.files import FrameFile, frame_sha256, write_frame

fsspec = pytest.importorskip("fsspec", reason="URLs are read by fsspec")
NUMBERS = count()
SECRET = "topsecret"


@pytest.fixture
def upload() -> Iterator[Callable[[Path], str]]:
    """Function that copies a folder to the memory file system and returns its URL."""
    memory, uploaded = fsspec.filesystem("memory"), []

    def copy(folder: Path) -> str:
        name = f"/lab/archive {next(NUMBERS)}"
        for path in filter(Path.is_file, folder.rglob("*")):
            memory.pipe(f"{name}/{path.relative_to(folder)}", path.read_bytes())
        uploaded.append(name)
        return f"memory:/{name}"

    yield copy
    for name in uploaded:
        memory.rm(name, recursive=True)


def numbers(result: tod.Result) -> object:
    """All that a result holds but the place of its dataset, and the times and the memory that it took."""

    left_out = ("run_time_s", "cpu_s", "cpu_ms_per_frame", "memory_mb", "saves_s", "path", "call")

    def timeless(value: object) -> object:
        if isinstance(value, dict):
            return {name: timeless(one) for name, one in value.items() if name not in left_out}
        return [timeless(one) for one in value] if isinstance(value, list) else value

    rows = [] if result.trials is None else result.trials.records
    return timeless(json.loads(result.to_json())), timeless([dict(row) for row in rows])


def with_references(made):
    """The dataset with a display file, a LUT, and the same frame without noise for every row."""
    (made.path / "lut.csv").write_text("code_value,luminance_cd_m2\n0,0\n0.5,50\n1,100\n")
    table = {name: value for name, value in made.toml.pop("display").items() if name != "white_luminance_cd_m2"}
    table |= {"eotf": "lut", "lut": "lut.csv"}
    lines = [f"{name} = {json.dumps(value)}" for name, value in table.items()]
    (made.path / "monitor.toml").write_text("\n".join(["schema = 1", "[display]", *lines, ""]))
    made.toml = {"schema": 1, "display": "monitor.toml", **made.toml}
    for row in made.rows:
        row["reference_frame"] = row["frame"]
    made.save()
    return made


@pytest.mark.parametrize("suffix", [".exr", ".png"])
def test_a_score_has_the_numbers_of_the_folder(make_dataset, upload, suffix) -> None:
    made = make_dataset(suffix=suffix, contrasts=(0.01, 0.05, 0.2))
    for row in made.rows:
        row["sha256"] = frame_sha256(made.path / row["frame"])
    made.save()
    here, there = (tod.score(place, examples=False, locate=True) for place in (made.path, upload(made.path)))
    assert numbers(here) == numbers(there)
    assert there.dataset_path is not None and there.dataset_path.startswith("memory://lab/archive")


def test_displays_luts_and_reference_frames_are_read_there(make_dataset, upload) -> None:
    made = with_references(make_dataset(suffix=".png"))
    fit = tod.FitSettings(resamples=80)
    here, there = (
        tod.compare(place, ["gamma"], fit=fit, examples=False) for place in (made.path, upload(made.path))
    )
    assert numbers(here) == numbers(there)
    assert there.algorithms[1].psnr_db is not None


@pytest.mark.parametrize(("name", "pixel_type"), [("a.exr", "half"), ("a.exr", "float"), ("a.png", "uint16")])
def test_a_frame_in_memory_is_decoded_as_its_file(tmp_path, name, pixel_type) -> None:
    """In many threads at once, bands and rectangles too; a path that would be wrong is never opened."""
    values = np.random.default_rng(1).random((300, 200, 3)).astype(np.float32)
    write_frame(tmp_path / name, values, pixel_type=pixel_type, attributes={"todframes:seed": "7"})
    content = (tmp_path / name).read_bytes()

    def decoded(**kwargs: object) -> tuple[object, ...]:
        with FrameFile(tmp_path / name, **kwargs) as file:
            part = file.read(rows=(20, 31), columns=(3, 9))
            return file.header, file.read().stored.tobytes(), part.stored.tobytes()

    expected = decoded()
    (tmp_path / name).unlink()
    with ThreadPoolExecutor(8) as pool:
        assert all(found == expected for found in pool.map(lambda _: decoded(content=content), range(24)))


@pytest.mark.parametrize("damage", ["none", "half", "text", "checksum", "missing"])
def test_no_copy_is_left(tmp_path, monkeypatch, damage) -> None:
    """Whether the frame could be decoded or not; messages name the URL."""
    write_frame(tmp_path / "a.exr", np.full((64, 64), 0.5))
    content, temporary = (tmp_path / "a.exr").read_bytes(), tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    path = RemotePath(f"memory://lab/a {next(NUMBERS)}.exr")
    bytes_of = {"half": content[:150], "text": b"no frame"}
    if damage != "missing":
        fsspec.filesystem("memory").pipe(path.url, bytes_of.get(damage, content))
    if damage == "none":
        with FrameFile(path):
            assert len(list(temporary.iterdir())) == 1
    else:
        with pytest.raises(FrameError, match=r"^memory://lab/a \d+\.exr: ") as caught:
            FrameFile(path, sha256="0" * 64 if damage == "checksum" else None)
        assert "temporary" not in str(caught.value)
        assert caught.value.path == path
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("is_full", [True, False])
def test_a_temporary_folder_that_cannot_take_a_copy_is_named(monkeypatch, is_full) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    fsspec.filesystem("memory").pipe("memory://lab/a.exr", b"a")
    monkeypatch.setattr(*((remote, "_copy") if is_full else (tempfile, "TemporaryDirectory")), fails)
    with pytest.raises(RemoteError, match=r"cannot be copied to the folder for temporary files \(No space left"):
        FrameFile(RemotePath("memory://lab/a.exr"))


@pytest.mark.parametrize(
    "url",
    [
        f"s3://key:{SECRET}@lab/archive",
        f"s3://key:{SECRET}/with+slash@lab/archive",
        f"https://user:{SECRET}@host:8080/archive",
        f"https://host/archive?X-Amz-Signature={SECRET}",
        f"https://host/archive#{SECRET}",
        f"simplecache::s3://key:{SECRET}@lab/archive",
        f"sftp://{SECRET}@host:22/archive",
        f"http://{SECRET}@[::1]:8080/archive",
        f"https://host/archive;token={SECRET}",
        f"https:/user:{SECRET}@host/archive",
        f"http://[::1]::s3://{SECRET}@lab/archive",
    ],
)
def test_a_url_with_a_secret_is_refused_unseen(todframes, url) -> None:
    for command in ("score", "validate"):
        err = error_line(todframes(command, url), 1)
        assert err.startswith("error: dataset: found a URL ") and SECRET not in err
    with pytest.raises(DataError, match="found a URL ") as caught:
        tod.score(url)
    assert SECRET not in str(caught.value)
    with pytest.raises(DataError, match=r"found (a URL of|a Path made from a URL)") as caught:
        tod.score(Path(url))
    assert SECRET not in str(caught.value)
    for command in ("naked-eye --contrast 1 -o", "fit", "noise", "calibrate", "score x --observer-settings"):
        status, out, err = todframes(*command.split(), url, *(["x"] if command == "calibrate" else []))
        assert status > 0 and out == "" and err.count("\n") == 1
        assert SECRET not in err


def test_messages_show_urls_without_secrets() -> None:
    for shown in (
        "http://host:8080/a@b/x.png: no such file; copy it there",
        "s3://lab/a?b;c/x.exr: cannot be read",
        "abfs://box@account.dfs.core.windows.net/x",
        "C:/data/x.png",
    ):
        assert str(DataError(shown)) == shown
    for hidden, shown in (
        (f"https://{SECRET}@host/x: no such file", "https://…@host/x: no such file"),
        (f"s3://key:{SECRET}/with+slash@lab/x: no", "s3://…@lab/x: no"),
        (f"/data/https:/host/x?a={SECRET}: no such file", "/data/https:/host/x… no such file"),
        (f"found 'https://host/x;{SECRET}', expected", "found 'https://host/x… expected"),
    ):
        assert str(FrameError("x", hidden)) == f"x: {shown}"


def test_what_is_a_url() -> None:
    assert location("s3://lab/archive/") == RemotePath("s3://lab/archive")
    assert location("HTTP://host:8080/a@b") == RemotePath("http://host:8080/a@b")
    assert location("abfs://box@account.dfs.core.windows.net/x").name == "x"
    assert location("http://[::1]:8080/a@b") == RemotePath("http://[::1]:8080/a@b")
    assert location("http://host/a:b@c") == RemotePath("http://host/a:b@c")
    assert location("file:///data/a%20b") == Path("/data/a b")
    assert location("data/a:b") == Path("data/a:b")
    assert location(Path("data")) == Path("data")
    with pytest.raises(DataError, match="found a URL of nothing"):
        location("s3:///")


def test_names_are_joined_as_the_scheme_writes_them() -> None:
    folder = RemotePath("s3://lab/archive")
    assert str(folder / "./frames//a b?.exr") == "s3://lab/archive/frames/a b?.exr"
    assert (folder / "frames/a.exr").parent == folder / "frames"
    assert str(RemotePath("https://host/x") / "frames/a b?%2e.exr") == "https://host/x/frames/a%20b%3F%252e.exr"


@pytest.mark.parametrize("name", ["../x.png", "/etc/passwd", "s3://other/x", "frames/../../x", "a::b", "."])
def test_nothing_leads_out_of_the_dataset(make_dataset, upload, name) -> None:
    made = make_dataset(suffix=".png")
    made.rows[1]["frame"] = name
    made.rows[2]["reference_frame"] = name
    made.save()
    bad = load_dataset(upload(made.path)).bad_rows
    assert len(bad) == 2
    assert all(f"{name} lies outside of the dataset" in one.error for one in bad)
    made.toml["display"] |= {"eotf": "lut", "lut": name, "white_luminance_cd_m2": None}
    del made.toml["display"]["white_luminance_cd_m2"]
    made.save()
    with pytest.raises(SettingsError, match="lies outside of the dataset"):
        load_dataset(upload(made.path))


def test_a_dataset_travels_without_connections_or_listings(make_dataset, upload) -> None:
    made = make_dataset()
    data = load_dataset(upload(made.path))
    before = len(pickle.dumps(data))
    assert all(data.has_frame(frame) for trial in data.trials for frame in trial.frames)
    copied = pickle.loads(pickle.dumps(replace(data, trials=data.trials)))
    assert len(pickle.dumps(data)) == before
    assert copied == data
    with copied.open(copied.trials[0].frames[0]) as file:
        assert file.header.height == 48


def test_content_ids_change_with_the_bytes(make_dataset, upload) -> None:
    """The same text before a frame is read and after, for files, in memory and behind URLs."""
    made = make_dataset()
    url = upload(made.path)
    for place in (made.path, url):
        data = load_dataset(place)
        first, second = (data.trials[k].frames[0] for k in (0, 1))
        ids = [data.content_id(first), data.content_id(second)]
        assert ids[0] != ids[1]
        with data.open(first, verify=True), data.open(second, verify=True):
            assert [data.content_id(one, is_read=True) for one in (first, second)] == ids
    assert ids[0] == frame_sha256(made.frame(0))
    fsspec.filesystem("memory").pipe(f"{url}/{first.path}", made.frame(1).read_bytes())
    assert load_dataset(url).content_id(first) == ids[1]
    with pytest.raises(FrameError, match="cannot be read: No such file"):
        data.content_id(FrameReference("frames/none.exr", None, None))


def test_ids_of_arrays() -> None:
    shown = {"orientation": "up", "level": 0.5, "size_mrad": 1.0}
    display = tod.Display(
        eotf="linear", white_luminance_cd_m2=1.0, pixel_pitch_mrad=0.3, background_luminance_cd_m2=1.0
    )
    from todframes.frames.memory import memory_dataset

    frames = [np.zeros((8, 8)), np.zeros((4, 16)), np.zeros((8, 8), np.float32), np.ones((8, 8)), np.zeros((8, 8))]
    data = memory_dataset(frames, display=display, **shown)
    ids = [data.content_id(trial.frames[0]) for trial in data.trials]
    assert len(set(ids)) == 4 and ids[0] == ids[4]


def test_a_frame_that_vanishes_is_skipped_or_named(make_dataset, upload) -> None:
    made = make_dataset(contrasts=(0.02, 0.2))
    url = upload(made.path)
    data = load_dataset(url)
    gone = data.trials[3].frames[0]
    assert data.has_frame(gone)
    fsspec.filesystem("memory").rm(f"{url}/{gone.path}")
    message = f"{url}/{gone.path}: cannot be opened: No such file or directory"
    with pytest.raises(FrameError, match=re.escape(message)):
        tod.score(data)
    assert not load_dataset(url).has_frame(gone)
    skipped = tod.score(data, on_error="skip", examples=False).skipped
    assert skipped == ({"frame": gone.path, "error": message},)


def test_a_lost_connection_ends_the_run_even_if_bad_frames_are_skipped(make_dataset, upload, monkeypatch) -> None:
    made = make_dataset()
    data = load_dataset(upload(made.path))
    copy, calls = remote._copy, []

    def failing(url: str, *more: object) -> None:
        if url.endswith(made.rows[5]["frame"]):
            calls.append(url)
            raise ConnectionResetError(SECRET)
        copy(url, *more)

    monkeypatch.setattr(remote, "_copy", failing)
    monkeypatch.setattr(remote, "WAIT_S", 0.0)
    with pytest.raises(RemoteError, match="cannot connect to the server") as caught:
        tod.score(data, on_error="skip")
    assert str(caught.value).startswith(f"{data.path}/{made.rows[5]['frame']}: ")
    assert SECRET not in str(caught.value)
    assert len(calls) == remote.ATTEMPTS


def test_checksums_are_missed_and_cannot_be_added(make_dataset, upload, todframes) -> None:
    url = upload(make_dataset().path)
    status, _, err = todframes("validate", url)
    assert status == 0 and "8 of 8 frames are EXR without a sha256" in err
    assert "validate FOLDER --add-sha256` on a local copy" in err
    err = error_line(todframes("validate", url, "--add-sha256"))
    assert err.startswith(f"error: {url}/manifest.csv: cannot be written, it is behind a URL")
    with pytest.raises(OutputError, match="cannot be written, it is behind a URL"):
        write_sha256(load_dataset(url), {"frames/x.exr": "0" * 64})


def test_only_names_tell_which_frames_have_checksums(make_dataset, upload, monkeypatch) -> None:
    """Only a few headers are read for the warnings: with a million frames all would be a million requests."""
    exr, png = (load_dataset(upload(make_dataset(s, suffix=s, repeats=5).path)) for s in (".exr", ".png"))
    opened, copy = [], remote._copy
    monkeypatch.setattr(remote, "_copy", lambda url, *more: opened.append(url) or copy(url, *more))
    assert [one.found for one in dataset_warnings(exr, exr.trials)] == [40]
    assert dataset_warnings(png, png.trials) == []
    assert len(opened) == 2 * 20  # every second of 40


@pytest.mark.parametrize(
    ("url", "status", "problem"),
    [
        ("nosuch://lab/archive", 1, "no file system is known as nosuch://"),
        ("memory://lab/none", 2, "no such file"),
    ],
)
def test_what_cannot_be_reached_is_one_line(todframes, url, status, problem) -> None:
    assert error_line(todframes("score", url), status).startswith(f"error: {url}/dataset.toml: {problem}")


@pytest.mark.parametrize(
    ("scheme", "remedy"),
    [
        ("s3", "pip install 'todframes[remote]'"),
        ("https", "pip install 'todframes[remote]'"),
        ("gs", "Please install gcsfs to access Google Storage"),
    ],
)
def test_a_package_that_is_missing_is_named(todframes, monkeypatch, scheme, remedy) -> None:
    def missing(_: str) -> object:
        raise ImportError("Please install gcsfs to access Google Storage")

    monkeypatch.setattr(fsspec, "get_filesystem_class", missing)
    err, where = (
        error_line(todframes("score", f"{scheme}://lab/archive"), 1),
        f"{scheme}://lab/archive/dataset.toml",
    )
    assert err == f"error: {where}: needs a package for {scheme}:// that is not installed: {remedy}\n"


def test_without_fsspec_there_is_one_line_too(todframes, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    status, _, err = todframes("validate", "s3://lab/archive")
    assert status == 1 and err.endswith("that is not installed: pip install 'todframes[remote]'\n")

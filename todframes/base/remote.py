"""Files of a dataset behind a URL: their names, and copies of them in a temporary folder, made by fsspec.

fsspec is imported when the first URL is read. Credentials come from the environment alone. Errors are worded here:
those of fsspec and its file systems may quote requests, which may hold secrets.
"""

from __future__ import annotations

import errno
import functools
import os
import posixpath
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from todframes.base.errors import DataError, RemoteError
from todframes.base.safe_text import without_secrets

WEB, S3 = ("http", "https"), ("s3", "s3a")
FRAME_FILE_MB = 512
"""Largest size of a frame's file that is received, in units of 2**20 bytes."""
CONNECT_S, READ_S, WHOLE_S = 5, 15, 300
"""Longest time until a server accepts a connection, between two pieces of its answer, and until its end."""
ATTEMPTS, WAIT_S = 3, 0.3
"""Number of attempts of a request, and time before the second one in seconds; it is longer before the third."""

NO_CONNECTION = (
    "cannot connect to the server; is the network up, and the address right (for s3:// elsewhere than at Amazon: "
    "AWS_ENDPOINT_URL)?"
)
LOST = "the server did not answer in time, or closed the connection; try again"
WORDS = {
    "NoCredentialsError": "found no credentials, expected them in the environment: for s3:// AWS_ACCESS_KEY_ID "
    "and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE; for public data FSSPEC_S3_ANON=true",
    "ProfileNotFound": "AWS_PROFILE names a profile that does not exist",
    "ParamValidationError": "the name of the bucket is not valid",
    "PermissionError": "access denied; check the credentials in the environment and their rights (without the "
    "right to list folders, a missing file is answered so too)",
    **dict.fromkeys(("ServerTimeoutError", "ConnectTimeoutError", "ReadTimeoutError"), LOST),
    **dict.fromkeys(("ServerDisconnectedError", "ConnectionClosedError", "ClientPayloadError"), LOST),
    **dict.fromkeys(("ConnectionError", "ClientConnectorError"), NO_CONNECTION),
    "TimeoutError": f"the file did not arrive within {WHOLE_S} s, the limit; copy the dataset to a folder",
}
"""Words for an exception, by the name of its class or of a base class."""


@dataclass(frozen=True, slots=True)
class RemotePath:
    """A file or folder behind a URL, with as much of the interface of `Path` as readers of datasets need. The URL
    has no password and no query (`location` refuses them), so messages and results may show it.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> RemotePath:
        name = posixpath.normpath(name)
        return RemotePath(f"{self.url}/{quote(name) if self.scheme in WEB else name}")

    @property
    def scheme(self) -> str:
        """Name of the file system: "s3" of `s3://lab/archive`."""
        return self.url.partition("://")[0]

    @property
    def parent(self) -> RemotePath:
        """Folder that the file is in."""
        return RemotePath(self.url.rpartition("/")[0])

    @property
    def name(self) -> str:
        """Last part of the URL."""
        return self.url.rpartition("/")[2]


Location = Path | RemotePath


def location(name: str | os.PathLike[str] | RemotePath) -> Location:
    """Return the local path, or the URL, that a text names. DataError if a URL holds a user name, a password, a
    parameter or a query, or names several file systems; it does not show the URL, which may hold a secret.
    """
    if isinstance(name, RemotePath):
        return name
    if not isinstance(name, str) or not re.match(r"[A-Za-z][A-Za-z0-9+.:-]*://", name):
        path = Path(name)
        if re.match(r"[A-Za-z][A-Za-z0-9+.:-]+:/[^/]", str(path)) and not path.exists():
            found = "a URL with one slash" if isinstance(name, str) else "a Path made from a URL"
            raise DataError(f"dataset: found {found}, expected the URL as a text, with ://")
        return path
    scheme, _, rest = name.partition("://")
    scheme = scheme.lower()
    without_ipv6 = re.sub(r"\[[0-9A-Fa-f:.]*\]", "", name)
    if "::" in without_ipv6:
        raise DataError("dataset: found a URL of several file systems chained by '::', expected a single one")
    if without_secrets(without_ipv6) != without_ipv6 or re.search("[?#;]", rest):
        raise DataError(
            f"dataset: found a URL of {scheme}:// with a user name, password, parameter, query or fragment (what "
            "follows ; ? or #), expected none: it may be a secret, and credentials come from the environment"
        )
    if scheme in ("file", "local"):
        return Path(unquote(rest))
    if not rest.strip("/"):
        raise DataError(f"{scheme}://: found a URL of nothing, expected {scheme}://… and the folder of a dataset")
    return RemotePath(f"{scheme}://{rest.rstrip('/')}")


@contextmanager
def local_file(path: Location, *, most_mb: int = FRAME_FILE_MB) -> Iterator[Path]:
    """Yield the local path of a file; of one behind a URL, that of a copy, which is removed at the end. OSError if
    there is none, or it is longer than `most_mb` · 2**20 bytes; RemoteError if it cannot be copied for another
    reason.
    """
    if isinstance(path, Path):
        yield path
        return
    import tempfile

    try:
        folder = tempfile.TemporaryDirectory(prefix="todframes-")
    except OSError as error:
        raise _no_copy(path, error) from None
    with folder as name:
        copy = Path(name) / "copy"
        _ask(path, functools.partial(_copy, path.url, copy, most_mb))
        yield copy


def list_folder(folder: RemotePath) -> dict[str, str | None] | None:
    """Return the entity tags of the files of a folder by name; None if it cannot be listed. Raises RemoteError if
    the server cannot be reached. A folder that is missing has no files.
    """

    def listed(file_system: Any, **_: Any) -> Any:  # a million names may take longer than a file
        try:
            return file_system.ls(folder.url, detail=True)
        except FileNotFoundError:
            return []
        except (PermissionError, NotImplementedError):
            return None

    files = None if folder.scheme in WEB else _ask(folder, listed)
    if files is None:
        return None
    return {file["name"].rpartition("/")[2]: _tag(file) for file in files if file["type"] != "directory"}


def entity_tag(path: RemotePath) -> str | None:
    """Return the entity tag of a file, which changes when its bytes do; None if it has none, or is missing. Raises
    RemoteError if the server cannot be reached.
    """
    try:
        return _tag(_ask(path, lambda file_system, **limits: file_system.info(path.url, **limits)))
    except FileNotFoundError:
        return None  # fsspec raises it for all failures of a web server; reading the file distinguishes them


def _tag(about: Mapping[str, Any]) -> str | None:
    """Return the entity tag in what a file system states about a file, unless it may stay when bytes change."""
    tag = str(about.get("ETag") or "W/")
    return None if tag.startswith("W/") else tag


def _copy(url: str, copy: Path, most_mb: int, file_system: Any, **limits: Any) -> None:
    """Copy a whole file whose size the server states before it; raise an exception if it is too long."""
    from fsspec.callbacks import Callback

    def check(size: int | None, n_bytes: int) -> None:
        if not n_bytes:  # before its first byte, s3fs would leave the connection open
            return
        if size is None:
            raise RemoteError(
                "the server does not state how long the file is, so a part of it would pass for the whole"
            )
        if max(size, n_bytes) > most_mb * 2**20:
            raise OSError(errno.EFBIG, f"longer than {most_mb} MB, the limit for such files")

    progress = Callback(hooks={"limit": check})
    file_system.get_file(url, str(copy), callback=progress, **limits)
    if not copy.is_file():
        raise FileNotFoundError
    n_bytes = copy.stat().st_size
    check(n_bytes, n_bytes)  # some file systems do not report progress
    if progress.size not in (None, n_bytes):
        raise RemoteError(f"found {n_bytes} bytes, expected {progress.size}, as the server states")


def _ask(path: RemotePath, request: Callable[..., Any]) -> Any:
    """Return the answer to a request: a function of the file system, tried again if the connection fails."""
    try:
        from fsspec import get_filesystem_class

        kind = get_filesystem_class(path.scheme)
    except ImportError as error:
        remedy = "pip install 'todframes[remote]'" if path.scheme in (*S3, *WEB) else error
        raise RemoteError(
            f"{path}: needs a package for {path.scheme}:// that is not installed: {remedy}"
        ) from None
    except ValueError:
        raise RemoteError(
            f"{path}: no file system is known as {path.scheme}://, expected s3:// or https://"
        ) from None
    limits = {"timeout": WHOLE_S} if kind.async_impl else {}
    attempt = 1
    while True:
        try:
            options = kind._get_kwargs_from_urls(path.url) | _options(path.scheme)
            file_system = kind(use_listings_cache=False, **options)
            if path.scheme in S3:
                file_system.retries = 1  # it would continue a file that may have changed
            return request(file_system, **limits)
        except Exception as error:
            problem = _problem(path, error)
            if attempt == ATTEMPTS or not str(problem).endswith((NO_CONNECTION, LOST)):
                raise problem from None
        time.sleep(attempt * WAIT_S)
        attempt += 1


@functools.cache
def _options(scheme: str) -> dict[str, Any]:
    """Return options of a file system: limits of time, and for web servers those of redirections and answers."""
    if scheme in S3:
        config: dict[str, Any] = {"connect_timeout": CONNECT_S, "read_timeout": READ_S}
        config["retries"] = {"mode": "standard", "total_max_attempts": 2}
        return {"max_concurrency": 1, "config_kwargs": config}
    if scheme not in WEB:
        return {}
    import aiohttp

    async def check_redirect(_session: Any, _context: Any, asked: Any) -> None:
        source, target = asked.url, asked.url.join(type(asked.url)(asked.response.headers["Location"]))
        if (target.scheme, target.host, target.port) != (source.scheme, source.host, source.port):
            raise RemoteError(
                "the server redirects to another server, scheme or port, expected the file itself; give that URL"
            )

    async def check_answer(answer: Any) -> None:
        answer.raise_for_status()
        if answer.status != 200:
            raise RemoteError(f"found status {answer.status} of HTTP, expected 200 and the whole file")
        if answer.headers.get("Content-Encoding", "identity").lower() != "identity":
            raise RemoteError("the server sends it compressed, expected the file itself")

    trace = aiohttp.TraceConfig()
    trace.on_request_redirect.append(check_redirect)
    client = {
        "headers": {"Accept-Encoding": "identity"},
        "auto_decompress": False,
        "raise_for_status": check_answer,
        "timeout": aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_S, sock_read=READ_S),
        "trace_configs": [trace],
    }
    return {"encoded": True, "client_kwargs": client}


def _problem(path: RemotePath, error: Exception) -> OSError:
    """Return the error of this package, or of Python, for an exception of a file system."""
    if isinstance(error, RemoteError):
        return RemoteError(f"{path}: {error}")
    status = getattr(error, "status", None)
    if isinstance(error, FileNotFoundError) or status in (404, 410):
        return FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
    if isinstance(error, OSError) and error.errno == errno.EFBIG:
        return error
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return _no_copy(path, error)
    names = [kind.__name__ for cause in (error.__cause__, error) for kind in type(cause).__mro__]
    if status in (401, 403):
        names = ["PermissionError"]
    problem = next((WORDS[name] for name in names if name in WORDS), None)
    if problem is None:  # nothing that the server says is shown
        shown = type(error).__name__ + (f", {status}" if status else "")
        problem = f"cannot be read ({shown})"
    return RemoteError(f"{path}: {problem}")


def _no_copy(path: RemotePath, error: OSError) -> RemoteError:
    return RemoteError(
        f"{path}: cannot be copied to the folder for temporary files ({error.strerror}); free it, or give another "
        "in TMPDIR"
    )
